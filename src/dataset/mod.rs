//! From bags to what networks learn from.
//!
//! 1. [`stream`]: the frames of one trajectory, in memory, cut where frames are missing.
//! 2. [`split`]: training, validation and test part, by stream, so that no trajectory is in two.
//! 3. [`statistics`]: range, mean and deviation of each feature, over the training part only.

mod split;
mod statistics;
mod stream;

use std::path::PathBuf;

use sha2::{Digest, Sha256};

pub use split::Part;
pub use stream::{State, Stream};

use crate::{bag::BagError, checkpoint::Normalization};

/// The topic that holds the truth.
pub const TRUTH_TOPIC: &str = "/particles";

/// Trajectories, split and described.
#[derive(Clone, Debug)]
pub struct Dataset {
    /// What weights are fitted to: the first 80 % of the stream ids.
    pub train: Vec<Stream>,
    /// What the best epoch is chosen by: the next 10 %.
    pub validation: Vec<Stream>,
    /// What nobody has seen: the rest.
    pub test: Vec<Stream>,
    /// Statistics of the training part.
    pub normalization: Normalization,
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
}

fn list(paths: &[PathBuf]) -> String {
    paths.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
}

impl Dataset {
    /// Reads every stream of the topic `/particles` of the bags at `paths` and splits them.
    ///
    /// # Errors
    /// [`DatasetError`] when a bag cannot be read, holds no frames, or streams differ in `dt` or domain.
    pub fn load(paths: &[PathBuf]) -> Result<Self, DatasetError> {
        let streams = load_streams(paths)?;
        let digest = digest(&streams);
        let ids = split::distinct_ids(&streams);
        if ids.len() < 2 {
            return Err(DatasetError::TooFew { paths: paths.to_vec(), found: ids.len() });
        }
        let (mut train, mut validation, mut test) = (Vec::new(), Vec::new(), Vec::new());
        for stream in streams {
            match split::part_of(&ids, &stream) {
                Part::Train => train.push(stream),
                Part::Validation => validation.push(stream),
                Part::Test => test.push(stream),
            }
        }
        let normalization = statistics::normalization(&train);
        Ok(Self { train, validation, test, normalization, digest })
    }
}

/// Every stream of the topic `/particles` of the bags at `paths`, in the order of id and bag.
///
/// # Errors
/// As [`Dataset::load`]; a single stream is enough here.
pub fn load_streams(paths: &[PathBuf]) -> Result<Vec<Stream>, DatasetError> {
    let mut streams = Vec::new();
    for path in crate::bag::find_bags(paths)? {
        streams.extend(stream::read(&path, TRUTH_TOPIC)?);
    }
    streams.sort_by(|a, b| {
        (a.id, &a.source, a.first_sequence).cmp(&(b.id, &b.source, b.first_sequence))
    });
    if let Some(first) = streams.first() {
        for stream in &streams {
            alike(first, stream)?;
        }
    }
    Ok(streams)
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
pub fn test_part(streams: &[Stream]) -> Vec<Stream> {
    let ids = split::distinct_ids(streams);
    streams.iter().filter(|stream| split::part_of(&ids, stream) == Part::Test).cloned().collect()
}

/// SHA-256 over ids, materials and states of all streams, hexadecimal.
pub fn digest(streams: &[Stream]) -> String {
    let mut hasher = Sha256::new();
    for stream in streams {
        stream.update(&mut hasher);
    }
    format!("{:x}", hasher.finalize())
}
