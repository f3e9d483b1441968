//! The streams of bags: their properties, found in a first pass, and their frames.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use super::error::ExchangeError;
use eddy_bag::{BagReader, find_bags};
use eddy_frames::{AnyFrame, Domain, Frame, Material, Stamp, decimal, distance};

/// Called after each frame; `false` stops the operation with [`ExchangeError::Interrupted`].
pub type Progress<'a> = dyn FnMut() -> bool + 'a;

/// Selects frames of bags.
#[derive(Clone, Debug, Default)]
pub struct FrameSelection {
    /// Bags, or directories of bags.
    pub bags: Vec<PathBuf>,
    /// The topic of the frames.
    pub topic: String,
    /// Only the stream with this id; all if `None`.
    pub stream: Option<u64>,
    /// The first frames of each stream, which must have as many; all if `None`.
    pub frames: Option<usize>,
}

impl FrameSelection {
    /// The number of dimensions of the first frame, as all must have.
    ///
    /// # Errors
    /// [`ExchangeError::Bag`] when the first bag cannot be read, does not have the topic, or begins with an invalid frame.
    pub fn dimension(&self) -> Result<usize, ExchangeError> {
        // There is at least one.
        let bag = &find_bags(&self.bags)?[0];
        let first = BagReader::open(bag)?.frames_of(&self.topic)?.next().transpose()?;
        Ok(if let Some(AnyFrame::Three(_)) = first { 3 } else { 2 })
    }
}

/// One stream of one bag.
#[derive(Clone, Debug)]
pub struct Track<const D: usize = 2> {
    /// The bag.
    pub bag: PathBuf,
    /// Id of the stream.
    pub stream: u64,
    /// Number of selected frames.
    pub frames: usize,
    /// Stamp of the first frame.
    pub first: Stamp,
    /// Stamp of the last frame.
    pub last: Stamp,
    /// Time between two frames (s), from the first frame.
    pub dt: f32,
    /// Domain of the first frame.
    pub domain: Domain<D>,
    /// Materials of the first frame, `[N]`.
    pub material: Vec<Material>,
    /// Whether the materials differ between frames.
    pub material_varies: bool,
    /// Maximum over all frames of the 99th percentile of the speed (domain lengths per second).
    pub top_speed: f32,
    /// For each field that changes, the value at the first change and the value of the first frame.
    changes: BTreeMap<&'static str, (String, String)>,
    /// Sequence number of the last frame.
    sequence: u64,
}

/// Percentile for the top speed of a frame: single fast particles do not determine the color scale.
const TOP_SPEED_SHARE: f64 = 0.99;

impl<const D: usize> Track<D> {
    fn begin(bag: &Path, frame: &Frame<D>) -> Self {
        Self {
            bag: bag.into(),
            stream: frame.stream,
            frames: 1,
            first: frame.stamp,
            last: frame.stamp,
            dt: frame.dt,
            domain: frame.domain,
            material: frame.material.clone(),
            material_varies: false,
            top_speed: top_speed(frame),
            changes: BTreeMap::new(),
            sequence: frame.sequence,
        }
    }

    fn follow(&mut self, frame: &Frame<D>) {
        let at = |what: String| format!("{what} at sequence {}", frame.sequence);
        let mut differ = |field, found: String, expected: String| {
            self.changes.entry(field).or_insert((at(found), expected));
        };
        if frame.len() != self.material.len() {
            differ("particles", frame.len().to_string(), self.material.len().to_string());
        }
        if frame.dt != self.dt {
            differ("dt", format!("{} s", decimal(frame.dt)), format!("{} s", decimal(self.dt)));
        }
        if frame.domain != self.domain {
            differ("domain", frame.domain.to_string(), self.domain.to_string());
        }
        if self.sequence.checked_add(1) != Some(frame.sequence) {
            let found = format!("{} after {}", frame.sequence, self.sequence);
            self.changes.entry("sequence").or_insert((found, "consecutive numbers".into()));
        }
        self.material_varies |= frame.material != self.material;
        self.top_speed = self.top_speed.max(top_speed(frame));
        self.sequence = frame.sequence;
        self.last = frame.stamp;
        self.frames += 1;
    }

    /// Number of particles in the first frame.
    pub fn particles(&self) -> usize {
        self.material.len()
    }

    /// Checks that none of `fields` (`particles`, `dt`, `domain`, `sequence`) changes; `rule` is the requirement of
    /// the format.
    pub(super) fn check_constant(
        &self,
        fields: &[&'static str],
        rule: &'static str,
    ) -> Result<(), ExchangeError> {
        let changed = fields.iter().find_map(|field| self.changes.get_key_value(field));
        match changed {
            None => Ok(()),
            Some((field, (found, expected))) => {
                Err(self.unsuitable(field, found.clone(), expected.clone(), rule))
            }
        }
    }

    pub(super) fn unsuitable(
        &self,
        field: &'static str,
        found: String,
        expected: String,
        rule: &'static str,
    ) -> ExchangeError {
        let (bag, stream) = (self.bag.clone(), self.stream);
        ExchangeError::Unsuitable { bag, stream, field, found, expected, rule }
    }

    /// Base of file names: `stream_0007`.
    pub fn name(&self) -> String {
        format!("stream_{:04}", self.stream)
    }
}

fn top_speed<const D: usize>(frame: &Frame<D>) -> f32 {
    let mut speeds: Vec<f32> = frame.velocity.iter().map(|&v| distance(v, [0.0; D])).collect();
    let rank = ((speeds.len() - 1) as f64 * TOP_SPEED_SHARE) as usize;
    *speeds.select_nth_unstable_by(rank, f32::total_cmp).1
}

/// The streams of bags, whose frames have `D` dimensions.
#[derive(Clone, Debug)]
pub struct Streams<const D: usize = 2> {
    topic: String,
    /// Sorted by id.
    tracks: Vec<Track<D>>,
}

impl<const D: usize> Streams<D> {
    /// Reads every selected frame once.
    ///
    /// # Errors
    /// [`ExchangeError::Bag`] when a bag cannot be read, does not have the topic, or has an invalid frame or one of another dimension; [`ExchangeError::NoStream`], [`ExchangeError::SameStream`],
    /// [`ExchangeError::TooShort`], [`ExchangeError::Interrupted`].
    pub fn find(
        selection: &FrameSelection,
        progress: &mut Progress<'_>,
    ) -> Result<Self, ExchangeError> {
        let mut tracks: BTreeMap<u64, Track<D>> = BTreeMap::new();
        let mut present = BTreeMap::new();
        for bag in find_bags(&selection.bags)? {
            for frame in BagReader::open(&bag)?.frames_of::<Frame<D>>(&selection.topic)? {
                let frame = frame?;
                if !progress() {
                    return Err(ExchangeError::Interrupted);
                }
                present.entry(frame.stream).or_insert(());
                if selection.stream.is_some_and(|stream| stream != frame.stream) {
                    continue;
                }
                let Some(track) = tracks.get_mut(&frame.stream) else {
                    tracks.insert(frame.stream, Track::begin(&bag, &frame));
                    continue;
                };
                if track.bag != bag {
                    return Err(ExchangeError::SameStream {
                        stream: frame.stream,
                        first: track.bag.clone(),
                        second: bag,
                    });
                }
                if selection.frames.is_none_or(|frames| track.frames < frames) {
                    track.follow(&frame);
                }
            }
        }
        if let Some(wanted) = selection.stream.filter(|_| tracks.is_empty()) {
            let found = present.keys().map(u64::to_string).collect::<Vec<_>>().join(", ");
            return Err(ExchangeError::NoStream { found, wanted });
        }
        let tracks: Vec<Track<D>> = tracks.into_values().collect();
        if let Some(wanted) = selection.frames
            && let Some(track) = tracks.iter().find(|track| track.frames < wanted)
        {
            let (bag, stream) = (track.bag.clone(), track.stream);
            return Err(ExchangeError::TooShort { bag, stream, found: track.frames, wanted });
        }
        Ok(Self { topic: selection.topic.clone(), tracks })
    }

    /// The streams, sorted by id.
    pub fn tracks(&self) -> &[Track<D>] {
        &self.tracks
    }

    /// The stream with this id.
    pub(super) fn track(&self, stream: u64) -> Option<&Track<D>> {
        self.tracks.iter().find(|track| track.stream == stream)
    }

    /// Total number of frames.
    pub fn frames(&self) -> usize {
        self.tracks.iter().map(|track| track.frames).sum()
    }

    /// The topic of the frames.
    pub(super) fn topic(&self) -> &str {
        &self.topic
    }

    /// The frames of one stream, in order.
    ///
    /// # Errors
    /// [`ExchangeError::Bag`], also from the iterator.
    pub fn frames_of(
        &self,
        track: &Track<D>,
    ) -> Result<impl Iterator<Item = Result<Frame<D>, ExchangeError>> + use<D>, ExchangeError> {
        let (stream, frames) = (track.stream, track.frames);
        let of_stream = BagReader::open(&track.bag)?
            .frames_of::<Frame<D>>(&self.topic)?
            .filter(move |frame| frame.as_ref().map_or(true, |frame| frame.stream == stream));
        Ok(of_stream.take(frames).map(|frame| Ok(frame?)))
    }

    /// Calls `each` for every frame of one stream, in order.
    ///
    /// # Errors
    /// Those of `each`, [`ExchangeError::Bag`] and [`ExchangeError::Interrupted`].
    pub(super) fn read(
        &self,
        track: &Track<D>,
        progress: &mut Progress<'_>,
        mut each: impl FnMut(Frame<D>) -> Result<(), ExchangeError>,
    ) -> Result<(), ExchangeError> {
        for frame in self.frames_of(track)? {
            each(frame?)?;
            if !progress() {
                return Err(ExchangeError::Interrupted);
            }
        }
        Ok(())
    }
}
