//! One trajectory of a data set: what is known of it, and a way to its frames, wherever they are.

use std::{ops::Range, path::PathBuf, sync::Arc};

use sha2::{Digest, Sha256};

use super::{
    DatasetError, Shelf, State, Stream, add_to_digest, begin_digest, in_words, statistics::Bounds,
};
use eddy_frames::{Domain, Material, Stamp};

/// Consecutive frames of one simulated trajectory, in memory or on disk.
#[derive(Clone, Debug)]
pub struct Trajectory {
    /// The stream's number in its bag: the scene id for simulated data.
    pub id: u64,
    /// The bag it is from.
    pub source: PathBuf,
    /// Time between two frames (s).
    pub dt: f32,
    /// The box that holds the particles.
    pub domain: Domain,
    /// Materials, `[N]`, the same in every frame.
    pub material: Vec<Material>,
    /// Sequence number of the first frame.
    pub first_sequence: u64,
    /// Stamp of the first frame.
    pub first_stamp: Stamp,
    /// How many frames it has.
    pub frames: usize,
    /// Where its particles have been (domain lengths).
    pub bounds: Bounds,
    /// Positions in the first frame, `[N]`: the shape that solids are taken to rest in.
    pub rest: Arc<Vec<[f32; 2]>>,
    place: Place,
}

/// Where frames are.
#[derive(Clone, Debug)]
enum Place {
    Memory(Arc<Vec<State>>),
    /// On disk: number of the stream on the shelf.
    Disk(Arc<Shelf>, usize),
}

impl Trajectory {
    /// A stream that is `number` on the shelf; of its states, none need be there.
    pub(super) fn on_shelf(
        stream: Stream,
        frames: usize,
        bounds: Bounds,
        rest: Vec<[f32; 2]>,
        shelf: &Arc<Shelf>,
        number: usize,
    ) -> Self {
        Self::placed(stream, frames, bounds, rest, Place::Disk(shelf.clone(), number))
    }

    fn placed(
        stream: Stream,
        frames: usize,
        bounds: Bounds,
        rest: Vec<[f32; 2]>,
        place: Place,
    ) -> Self {
        let Stream { id, source, dt, domain, material, first_sequence, first_stamp, .. } = stream;
        Self {
            id,
            source,
            dt,
            domain,
            material,
            first_sequence,
            first_stamp,
            frames,
            bounds,
            rest: Arc::new(rest),
            place,
        }
    }

    /// The shelf its frames are on, unless they are in memory.
    pub fn shelf(&self) -> Option<&Arc<Shelf>> {
        match &self.place {
            Place::Memory(_) => None,
            Place::Disk(shelf, _) => Some(shelf),
        }
    }

    /// Looks at some of its frames, one after the other.
    ///
    /// # Errors
    /// [`DatasetError::Bag`], [`DatasetError::Changed`] when frames on disk cannot be read again.
    ///
    /// # Panics
    /// When the range goes beyond its frames.
    pub fn visit(
        &self,
        frames: Range<usize>,
        mut look: impl FnMut(&State),
    ) -> Result<(), DatasetError> {
        match &self.place {
            Place::Memory(states) => states[frames].iter().for_each(look),
            Place::Disk(shelf, number) => shelf.visit(*number, frames, &mut look)?,
        }
        Ok(())
    }

    /// What tells it from other streams, whatever its number and its bag: the beginning of the SHA-256 over its
    /// interval, its materials and its first two frames, 16 hexadecimal digits. With one frame alone, a scene in water
    /// and the same scene in honey would be one.
    ///
    /// # Errors
    /// As [`Trajectory::visit`].
    pub fn fingerprint(&self) -> Result<String, DatasetError> {
        let mut hasher = Sha256::new();
        begin_digest(&mut hasher, 0, self.dt, &self.material);
        self.visit(0..self.frames.min(2), |state| add_to_digest(&mut hasher, state))?;
        let mut digits = in_words(hasher);
        digits.truncate(16);
        Ok(digits)
    }

    /// Some of its frames as a stream of their own.
    ///
    /// # Errors
    /// As [`Trajectory::visit`].
    ///
    /// # Panics
    /// As [`Trajectory::visit`].
    pub fn cut(&self, frames: Range<usize>) -> Result<Stream, DatasetError> {
        let start = frames.start;
        let mut states = Vec::with_capacity(frames.len());
        self.visit(frames, |state| states.push(state.clone()))?;
        Ok(Stream {
            id: self.id,
            source: self.source.clone(),
            dt: self.dt,
            domain: self.domain,
            material: self.material.clone(),
            first_sequence: self.first_sequence + start as u64,
            first_stamp: self.first_stamp.advance(self.dt, start as u32),
            states,
        })
    }
}

impl From<Stream> for Trajectory {
    /// A stream in memory.
    fn from(mut stream: Stream) -> Self {
        let states = std::mem::take(&mut stream.states);
        let mut bounds = Bounds::default();
        states.iter().for_each(|state| bounds.widen(state));
        let rest = states.first().map(|state| state.position.clone()).unwrap_or_default();
        Self::placed(stream, states.len(), bounds, rest, Place::Memory(Arc::new(states)))
    }
}
