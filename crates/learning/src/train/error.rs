//! Why a network cannot be trained, or training cannot continue.

use std::{io, path::PathBuf};

use indicatif::HumanBytes;

use eddy_dataset::DatasetError;
use eddy_evaluation::EvalError;
use eddy_inference::{checkpoint::CheckpointError, engine::ModelError};

/// What nothing does in streams where a feature is the same for all particles in all frames.
fn lacking(feature: &str) -> &'static str {
    match feature {
        "x" => "is anywhere else horizontally",
        "y" => "is anywhere else vertically",
        "vx" => "moves horizontally",
        _ => "moves vertically",
    }
}

/// Why a network cannot be trained, or training cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// The GPU, or a library it needs.
    #[cfg(feature = "cuda")]
    #[error(transparent)]
    Cuda(#[from] eddy_cuda::CudaError),
    /// A gradient is not finite although the loss is.
    #[error(
        "epoch {epoch}, batch {batch}: the gradient is not finite (windows {windows}); try a smaller learning rate or a shorter unroll"
    )]
    GradientNotFinite {
        /// The epoch, from 1.
        epoch: u32,
        /// The batch in it, from 1.
        batch: usize,
        /// Stream and first frame of each window.
        windows: String,
    },
    /// The threads of the validation cannot be started.
    #[error("threads: {0}")]
    Threads(rayon::ThreadPoolBuildError),
    /// A setting is out of range.
    #[error("{field}: found {found}, expected {expected}")]
    Setting {
        /// The setting's name in the file.
        field: &'static str,
        /// Its value.
        found: String,
        /// The expected value.
        expected: &'static str,
    },
    /// All training streams are shorter than a window.
    #[error(
        "training streams: the longest has {found} frames, expected at least {expected}: {warm_up} observed and {unroll} predicted"
    )]
    TooShort {
        /// Frames of the longest stream.
        found: usize,
        /// Frames of a window.
        expected: usize,
        /// Observed frames of a window.
        warm_up: usize,
        /// Predicted frames of a window.
        unroll: usize,
    },
    /// A feature is constant and cannot be normalised.
    #[error(
        "training streams: nothing {} in these streams, so that a network cannot learn it: {feature}: found {found} everywhere, expected at least two different values; record longer, or add a scene with such motion",
        lacking(feature)
    )]
    Constant {
        /// The feature.
        feature: &'static str,
        /// Its value.
        found: f32,
    },
    /// Streams differ in the number of particles, which the frame model does not support.
    #[error(
        "{}: stream {stream}: particles: found {found}, expected {expected} as in the first stream (the frame model needs the same number everywhere)",
        source_file.display()
    )]
    Particles {
        /// The bag.
        source_file: PathBuf,
        /// The stream.
        stream: u64,
        /// Its particles.
        found: usize,
        /// Particles of the first stream.
        expected: usize,
    },
    /// The loss is not finite; the best checkpoint so far is kept.
    #[error(
        "epoch {epoch}, batch {batch} (windows {windows}): loss: found {found}, expected a finite number"
    )]
    NotFinite {
        /// The epoch, from 1.
        epoch: u32,
        /// The batch in it, from 1.
        batch: usize,
        /// Stream and first frame of each window.
        windows: String,
        /// The loss.
        found: f32,
    },
    /// A network with these settings could not predict a stream of the data.
    #[error("{}: stream {stream}: {reason}", source_file.display())]
    Stream {
        /// The bag.
        source_file: PathBuf,
        /// The stream.
        stream: u64,
        /// Why.
        reason: Box<ModelError>,
    },
    /// The validation streams cannot be used.
    #[error("validation: {0}")]
    Validation(EvalError),
    /// The network does not match its description.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A checkpoint cannot be read or written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// Frames cannot be read from disk.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A file of the run cannot be read or written, or its folder cannot be created.
    #[error("{}: {reason}", file.display())]
    File {
        /// The file or folder.
        file: PathBuf,
        /// The system's error.
        reason: io::Error,
    },
    /// The output contains a run, and resuming was not requested.
    #[error(
        "{}: found {found}, expected a folder without a run; choose another --output, continue the run with --resume, or \
         replace it with --force",
        output.display()
    )]
    Exists {
        /// The output folder.
        output: PathBuf,
        /// Its contents.
        found: &'static str,
    },
    /// The run to resume has other data or settings.
    #[error("{}: {field}: found {found}, expected {expected} as in the run to resume", file.display())]
    OtherRun {
        /// The record of the run.
        file: PathBuf,
        /// The key that differs.
        field: String,
        /// Its value now.
        found: String,
        /// Its value in the run to resume.
        expected: String,
    },
    /// The checkpoint that training starts from has another network.
    #[error(
        "{field}: found {found}, expected {expected} as in the checkpoint that training starts from"
    )]
    OtherNetwork {
        /// The setting that differs.
        field: String,
        /// Its value now.
        found: String,
        /// Its value in the checkpoint.
        expected: String,
    },
    /// The record of a run is damaged, or its format version is not supported.
    #[error("{}: {field}: found {found}, expected {expected}", file.display())]
    Record {
        /// The file.
        file: PathBuf,
        /// The key or property.
        field: String,
        /// Its value.
        found: String,
        /// The expected value.
        expected: String,
    },
    /// The run needs more memory than is available.
    #[error(
        "memory: found at least {} needed ({} for weights and optimizer, {} for a batch), expected at most the {} that are free; make network, windows.batch or the windows smaller",
        HumanBytes(weights + batch), HumanBytes(*weights), HumanBytes(*batch), HumanBytes(*free)
    )]
    Memory {
        /// Needed for weights, gradients, optimizer and checkpoints (bytes).
        weights: u64,
        /// Needed for the windows of a batch and their layers' outputs (bytes).
        batch: u64,
        /// Available memory (bytes).
        free: u64,
    },
    /// The run needs more disk space than is available.
    #[error(
        "{}: disk: found {} free, expected at least {} for the best and the last checkpoint",
        output.display(), HumanBytes(*found), HumanBytes(*expected)
    )]
    Disk {
        /// The output folder.
        output: PathBuf,
        /// Free space (bytes).
        found: u64,
        /// Needed space (bytes).
        expected: u64,
    },
}
