//! From bags to what networks learn from.
//!
//! 1. [`stream`]: the frames of one trajectory, in memory, cut where frames are missing.
//! 2. [`load`]: the streams of all bags, in memory while they fit; [`trajectory`] is one of them.
//! 3. [`shelf`]: streams that do not fit stay on disk and are read again block by block.
//! 4. [`split`]: training, validation and test part, by stream, so that no trajectory is in two.
//! 5. [`statistics`]: range, mean and deviation of each feature, over the training part only.
//! 6. [`simulate`]: simulated scenes as a data set: one bag each in a folder that can be resumed.
//! 7. [`memory`]: how much memory is free.
//!
//! Everything that is computed from a set is the same, bit for bit, wherever its frames are.

mod load;
mod memory;
mod shelf;
pub mod simulate;
mod split;
mod statistics;
mod stream;
mod trajectory;

use std::path::PathBuf;

use rayon::prelude::*;
use sha2::{Digest, Sha256};

pub use memory::available_memory;
pub use shelf::{Residency, Shelf};
pub use split::Part;
pub use statistics::Bounds;
pub use stream::{State, Stream};
pub use trajectory::Trajectory;

use eddy_bag::BagError;
use eddy_frames::Material;
use eddy_inference::{
    checkpoint::Normalization,
    kernels::spacing::{median, spacing},
};
use statistics::Statistics;

/// The topic that holds the truth.
pub const TRUTH_TOPIC: &str = "/particles";

/// Trajectories, split and described.
#[derive(Clone, Debug)]
pub struct Dataset {
    /// What weights are fitted to: the first 80 % of the stream ids.
    pub train: Vec<Trajectory>,
    /// What the best epoch is chosen by: the next 10 %.
    pub validation: Vec<Trajectory>,
    /// What nobody has seen: the rest.
    pub test: Vec<Trajectory>,
    /// Statistics of the training part.
    pub normalization: Normalization,
    /// Distance between neighbouring particles in the first frames of the training part: the median over
    /// its streams of their medians (domain lengths). One stream alone may have been pressed together.
    pub spacing: f32,
    /// SHA-256 over every stream, hexadecimal.
    pub digest: String,
}

/// Why bags are no data set.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// A bag cannot be read.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// There are too few trajectories to split.
    #[error(
        "{}: found {found} streams, expected at least 2: one to learn from and one to validate on",
        list(paths)
    )]
    TooFew {
        /// What was searched.
        paths: Vec<PathBuf>,
        /// How many streams it holds.
        found: usize,
    },
    /// Streams that do not belong together.
    #[error("{}: stream {stream}: {field}: found {found}, expected {expected} as in the first stream", path.display())]
    Mixed {
        /// The bag.
        path: PathBuf,
        /// The stream.
        stream: u64,
        /// What differs.
        field: &'static str,
        /// Its value there.
        found: String,
        /// Its value in the first stream.
        expected: String,
    },
    /// A stream on disk is not what it was when the set was loaded.
    #[error("{}: stream {stream}: found other frames, expected those it had when it was read first", path.display())]
    Changed {
        /// The bag.
        path: PathBuf,
        /// The stream.
        stream: u64,
    },
}

fn list(paths: &[PathBuf]) -> String {
    paths.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
}

impl Dataset {
    /// Reads every stream of the topic `/particles` of the bags at `paths` and splits them. Frames
    /// that take more than `memory` bytes together stay on disk and are read again when they are
    /// needed; at most that many bytes of them are in memory at a time.
    ///
    /// `progress` is called after every frame with how many were read and how many there are.
    ///
    /// # Errors
    /// [`DatasetError`] when a bag cannot be read, holds no frames, or streams differ in `dt` or domain.
    pub fn load(
        paths: &[PathBuf],
        memory: u64,
        progress: &mut (dyn FnMut(u64, u64) + Send),
    ) -> Result<Self, DatasetError> {
        let streams = load::load(paths, memory, progress)?;
        let ids = split::distinct_ids(streams.iter().map(|stream| stream.id));
        if ids.len() < 2 {
            return Err(DatasetError::TooFew { paths: paths.to_vec(), found: ids.len() });
        }
        let mut hasher = Sha256::new();
        let mut statistics = Statistics::new();
        let (mut train, mut validation, mut test) = (Vec::new(), Vec::new(), Vec::new());
        for stream in streams {
            let part = Part::of(&ids, stream.id);
            begin_digest(&mut hasher, stream.id, stream.dt, &stream.material);
            stream.visit(0..stream.frames, |state| {
                add_to_digest(&mut hasher, state);
                if part == Part::Train {
                    statistics.add(state);
                }
            })?;
            match part {
                Part::Train => train.push(stream),
                Part::Validation => validation.push(stream),
                Part::Test => test.push(stream),
            }
        }
        let (normalization, digest) = (statistics.normalization(), in_words(hasher));
        let spacing = median(train.par_iter().map(|stream| spacing(&stream.rest)).collect());
        Ok(Self { train, validation, test, normalization, spacing, digest })
    }

    /// Fingerprints of the streams that weights are fitted to and chosen by.
    ///
    /// # Errors
    /// As [`Trajectory::visit`].
    pub fn seen(&self) -> Result<Vec<String>, DatasetError> {
        self.train.iter().chain(&self.validation).map(Trajectory::fingerprint).collect()
    }

    /// Where the frames are, unless they are in memory.
    pub fn shelf(&self) -> Option<&Shelf> {
        self.train.first()?.shelf().map(AsRef::as_ref)
    }
}

/// Every stream of the topic `/particles` of the bags at `paths`, in the order of id and bag. Frames
/// that take more than `memory` bytes together stay on disk, as in [`Dataset::load`].
///
/// `progress` is called after every frame with how many were read and how many there are.
///
/// # Errors
/// As [`Dataset::load`]; a single stream is enough here.
pub fn load_trajectories(
    paths: &[PathBuf],
    memory: u64,
    progress: &mut (dyn FnMut(u64, u64) + Send),
) -> Result<Vec<Trajectory>, DatasetError> {
    load::load(paths, memory, progress)
}

fn alike(first: &Stream, stream: &Stream) -> Result<(), DatasetError> {
    let mixed = |field, found: String, expected: String| {
        Err(DatasetError::Mixed {
            path: stream.source.clone(),
            stream: stream.id,
            field,
            found,
            expected,
        })
    };
    if stream.dt != first.dt {
        return mixed("dt", format!("{} s", stream.dt), format!("{} s", first.dt));
    }
    if stream.domain != first.domain {
        return mixed("domain", format!("{:?}", stream.domain), format!("{:?}", first.domain));
    }
    Ok(())
}

/// The streams among `streams` that a training on all of them sets aside.
pub fn test_part(streams: &[Trajectory]) -> Vec<Trajectory> {
    let ids = split::distinct_ids(streams.iter().map(|stream| stream.id));
    streams.iter().filter(|stream| Part::of(&ids, stream.id) == Part::Test).cloned().collect()
}

/// SHA-256 over ids, materials and states of all streams, hexadecimal. `look` sees every state on
/// the way.
///
/// # Errors
/// As [`Trajectory::visit`].
pub fn digest(
    streams: &[Trajectory],
    mut look: impl FnMut(&State),
) -> Result<String, DatasetError> {
    let mut hasher = Sha256::new();
    for stream in streams {
        begin_digest(&mut hasher, stream.id, stream.dt, &stream.material);
        stream.visit(0..stream.frames, |state| {
            add_to_digest(&mut hasher, state);
            look(state);
        })?;
    }
    Ok(in_words(hasher))
}

fn begin_digest(hasher: &mut Sha256, id: u64, dt: f32, material: &[Material]) {
    hasher.update(id.to_le_bytes());
    hasher.update(dt.to_le_bytes());
    hasher.update(material.iter().map(|&m| m as u8).collect::<Vec<_>>());
}

fn add_to_digest(hasher: &mut Sha256, state: &State) {
    for x in state.position.iter().chain(&state.velocity).flatten() {
        hasher.update(x.to_le_bytes());
    }
}

fn in_words(hasher: Sha256) -> String {
    format!("{:x}", hasher.finalize())
}
