//! Data sets: trajectories from bags, split and described.
//!
//! 1. [`stream`]: the frames of one trajectory, in memory, cut where frames are missing.
//! 2. [`load`]: the streams of all bags, in memory while they fit; [`trajectory`] is one of them.
//! 3. [`frame_store`]: streams that do not fit stay on disk and are read block by block, with a cache.
//! 4. [`split`]: training, validation and test part, by stream, so that no trajectory is in two parts.
//! 5. [`statistics`]: range, mean and standard deviation of each feature over the training part.
//! 6. [`simulate`]: simulated scenes as a data set: one bag each, in a folder that can be resumed.
//! 7. [`quantities`]: the sources of a stream's stiffness and gravity.
//! 8. [`memory`]: available memory.
//! 9. [`test_streams`]: small data sets for tests.
//!
//! Results computed from a data set are bit-identical whether its frames are in memory or on disk.

mod frame_store;
mod load;
mod memory;
mod quantities;
pub mod simulate;
mod split;
mod statistics;
mod stream;
pub mod test_streams;
#[cfg(test)]
mod tests;
mod trajectory;

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

use rayon::prelude::*;
use sha2::{Digest, Sha256};

pub use frame_store::{CacheUsage, FrameStore};
pub use load::{StreamsFound, survey_streams};
pub use memory::available_memory;
pub use quantities::{quantity_of_stream, stated_by, stiffness_of};
pub use split::Part;
pub use statistics::Bounds;
pub use stream::Stream;
pub use trajectory::Trajectory;

use eddy_bag::{
    BagError,
    custom_data::{Quantity, STIFFNESS},
};
use eddy_frames::{Material, State};
use eddy_inference::{
    checkpoint::Normalization,
    kernels::spacing::{median, spacing},
};
use eddy_messages::UnusableFrame;
use statistics::Statistics;

/// The topic that holds the truth.
pub const TRUTH_TOPIC: &str = "/particles";
/// The topic that holds pressure and energy of its particles.
pub const FIELDS_TOPIC: &str = "/particles/fields";

/// Trajectories, split into parts and described by statistics.
#[derive(Clone, Debug)]
pub struct Dataset {
    /// Training part: the first 80 % of the stream ids.
    pub train: Vec<Trajectory>,
    /// Validation part, which selects the best epoch: the next 10 %.
    pub validation: Vec<Trajectory>,
    /// Test part: the rest.
    pub test: Vec<Trajectory>,
    /// Statistics of the training part.
    pub normalization: Normalization,
    /// Distance between neighbouring particles in the first frames of the training part: the median over streams of
    /// each stream's median (domain lengths), so that a compressed stream does not matter.
    pub spacing: f32,
    /// SHA-256 over every stream, hexadecimal.
    pub digest: String,
    /// The streams that were skipped: the first unusable frame of each.
    pub skipped: Vec<UnusableFrame>,
}

/// How to load streams.
#[derive(Clone, Copy, Debug)]
pub struct LoadOptions {
    /// Frames that take more memory than this in total (bytes) stay on disk and are read on demand, with at most that many bytes
    /// in memory.
    pub memory: u64,
    /// Whether streams with an unusable frame are skipped instead of refused.
    pub skip_streams: bool,
}

impl LoadOptions {
    /// With at most this much memory (bytes), and no unusable frame.
    pub fn within(memory: u64) -> Self {
        Self { memory, skip_streams: false }
    }
}

/// Streams of bags.
#[derive(Debug)]
pub struct Loaded {
    /// The usable streams, ordered by id and bag.
    pub streams: Vec<Trajectory>,
    /// The streams that were skipped: the first unusable frame of each.
    pub skipped: Vec<UnusableFrame>,
}

/// Why bags cannot be used as a data set.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// A bag cannot be read.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// There are too few trajectories to split.
    #[error(
        "{}: number of streams: found {found}, expected at least 2: one for training and one for validation",
        list(paths)
    )]
    TooFew {
        /// The searched paths.
        paths: Vec<PathBuf>,
        /// Number of streams.
        found: usize,
    },
    /// A frame is invalid, implausible, or of another setup than the others.
    #[error(transparent)]
    Unusable(Box<UnusableFrame>),
    /// The stiffness of a stream is not known.
    #[error(
        "{}: stream {stream}: stiffness: found nothing, expected {STIFFNESS} in custom_data of metadata.yaml, or manifest.json of `eddy simulate` with this scene beside the bag",
        path.display()
    )]
    Stiffness {
        /// The bag.
        path: PathBuf,
        /// The stream.
        stream: u64,
    },
    /// A quantity in the metadata of a bag is not a number in its range.
    #[error(
        "{}/metadata.yaml: custom_data.{}: found {found:?}, expected {}",
        path.display(), quantity.key(), quantity.expected()
    )]
    Stated {
        /// The bag.
        path: PathBuf,
        /// The quantity.
        quantity: Quantity,
        /// The value.
        found: String,
    },
    /// A stream on disk has changed since the data set was loaded.
    #[error("{}: stream {stream}: its frames have changed since they were first read", path.display())]
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
    /// Reads every stream of the topic `/particles` of the bags at `paths` and splits them.
    ///
    /// `progress` is called after every frame with the numbers of frames read and in total.
    ///
    /// # Errors
    /// [`DatasetError`] when a bag cannot be read or holds no frames, when a frame is unusable (of all streams, if they are to
    /// be skipped), or when there are too few streams.
    pub fn load(
        paths: &[PathBuf],
        options: LoadOptions,
        progress: &mut (dyn FnMut(u64, u64) + Send),
    ) -> Result<Self, DatasetError> {
        let Loaded { streams, skipped } = load::load(paths, options, progress)?;
        let numbers = split_numbers(&streams);
        let ids = split::distinct_ids(numbers.iter().copied());
        if ids.len() < 2 {
            return Err(DatasetError::TooFew { paths: paths.to_vec(), found: ids.len() });
        }
        let mut hasher = Sha256::new();
        let mut statistics = Statistics::new();
        let (mut train, mut validation, mut test) = (Vec::new(), Vec::new(), Vec::new());
        for (stream, number) in streams.into_iter().zip(numbers) {
            let part = Part::of(&ids, number);
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
        let (normalization, digest) = (statistics.normalization(), hex(hasher));
        let spacing = median(train.par_iter().map(|stream| spacing(&stream.rest)).collect());
        Ok(Self { train, validation, test, normalization, spacing, digest, skipped })
    }

    /// Fingerprints of the streams of the training and validation parts.
    ///
    /// # Errors
    /// As [`Trajectory::visit`].
    pub fn seen(&self) -> Result<Vec<String>, DatasetError> {
        self.train.iter().chain(&self.validation).map(Trajectory::fingerprint).collect()
    }

    /// The smallest and the largest stiffness of the training part (density x velocity^2), if all of its streams state it.
    pub fn stated_stiffness(&self) -> Option<[f32; 2]> {
        let all: Option<Vec<f32>> = self.train.iter().map(|stream| stream.stiffness).collect();
        let all = all.filter(|all| !all.is_empty())?;
        let extreme = |most: fn(f32, f32) -> f32| all.iter().copied().reduce(most);
        Some([extreme(f32::min)?, extreme(f32::max)?])
    }

    /// The store of frames on disk, unless they are in memory.
    pub fn frame_store(&self) -> Option<&FrameStore> {
        self.train.first()?.frame_store().map(AsRef::as_ref)
    }
}

/// Every stream of the topic `/particles` of the bags at `paths`.
///
/// `progress` is called after every frame with the numbers of frames read and in total.
///
/// # Errors
/// As [`Dataset::load`], but a single stream is sufficient.
pub fn load_trajectories(
    paths: &[PathBuf],
    options: LoadOptions,
    progress: &mut (dyn FnMut(u64, u64) + Send),
) -> Result<Loaded, DatasetError> {
    load::load(paths, options, progress)
}

/// The streams that training on all of `streams` would put into the test part.
pub fn test_part(streams: &[Trajectory]) -> Vec<Trajectory> {
    let numbers = split_numbers(streams);
    let ids = split::distinct_ids(numbers.iter().copied());
    let is_test = |(_, number): &(&Trajectory, u64)| Part::of(&ids, *number) == Part::Test;
    streams.iter().zip(numbers).filter(is_test).map(|(stream, _)| stream.clone()).collect()
}

/// The number by which each stream is put into a part: its id, so that the pieces of a trajectory that was cut stay
/// together. Scenes from files without an `id` all have the same one; then the bags are numbered.
fn split_numbers(streams: &[Trajectory]) -> Vec<u64> {
    let ids: BTreeSet<u64> = streams.iter().map(|stream| stream.id).collect();
    if ids.len() > 1 {
        return streams.iter().map(|stream| stream.id).collect();
    }
    let bags: BTreeSet<&Path> = streams.iter().map(|stream| stream.source.as_path()).collect();
    let number = |stream: &Trajectory| bags.iter().position(|bag| *bag == stream.source);
    streams.iter().map(|stream| number(stream).unwrap_or_default() as u64).collect()
}

/// SHA-256 over ids, materials and states of all streams, hexadecimal. `look` is called with every state.
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
    Ok(hex(hasher))
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

fn hex(hasher: Sha256) -> String {
    format!("{:x}", hasher.finalize())
}

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
