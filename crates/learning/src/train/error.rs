//! Why a network cannot be trained.

use std::{io, path::PathBuf};

use indicatif::HumanBytes;

use eddy_evaluation::{EvalError, dataset::DatasetError};
use eddy_inference::{checkpoint::CheckpointError, engine::ModelError};

/// Why a network cannot be trained, or not any further.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A setting is out of its range.
    #[error("{field}: found {found}, expected {expected}")]
    Setting {
        /// The setting's name in the file.
        field: &'static str,
        /// Its value.
        found: String,
        /// What it should be.
        expected: &'static str,
    },
    /// There is no training stream with a whole window.
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
    /// A feature is the same for all particles at all times: there is no scale to divide it by.
    #[error(
        "training streams: {feature}: found {found} everywhere, expected at least two different values"
    )]
    Constant {
        /// The feature.
        feature: &'static str,
        /// Its value.
        found: f32,
    },
    /// The frame model needs the same number of particles everywhere.
    #[error(
        "{}: stream {stream}: particles: found {found}, expected {expected} as in the first stream (the frame model takes one number only)",
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
    /// The loss is no number any more; the best checkpoint so far is kept.
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
    /// The validation streams do not fit.
    #[error("validation: {0}")]
    Validation(EvalError),
    /// The network does not fit its own description.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The checkpoint cannot be written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// Frames on disk cannot be read again.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A file of the run cannot be read or written, or the folder for it cannot be made.
    #[error("{}: {reason}", file.display())]
    File {
        /// The file or folder.
        file: PathBuf,
        /// What the system said.
        reason: io::Error,
    },
    /// There is a run already, and nobody asked to go on with it.
    #[error(
        "{}: found {found}, expected a folder without a run (--resume goes on with the run that is there)",
        output.display()
    )]
    Exists {
        /// The output folder.
        output: PathBuf,
        /// What is there.
        found: &'static str,
    },
    /// The run that is to go on was another one.
    #[error("{}: {field}: found {found}, expected {expected} as in the run that is to go on", file.display())]
    OtherRun {
        /// The record of the run.
        file: PathBuf,
        /// What differs.
        field: String,
        /// What it is now.
        found: String,
        /// What it was.
        expected: String,
    },
    /// The record of a run is damaged, or of another format version.
    #[error("{}: {field}: found {found}, expected {expected}", file.display())]
    Record {
        /// The file.
        file: PathBuf,
        /// The key, or what else is wrong.
        field: String,
        /// What is there.
        found: String,
        /// What should be there.
        expected: String,
    },
    /// The run needs more memory than there is.
    #[error(
        "memory: found at least {} needed ({} for weights and optimizer, {} for a batch), expected at most the {} that are free; make network, windows.batch or the windows smaller",
        HumanBytes(weights + batch), HumanBytes(*weights), HumanBytes(*batch), HumanBytes(*free)
    )]
    Memory {
        /// For weights, gradients, optimizer and checkpoints (bytes).
        weights: u64,
        /// For the windows of a batch and what is computed from them (bytes).
        batch: u64,
        /// What there is (bytes).
        free: u64,
    },
    /// The run needs more disk than there is.
    #[error(
        "{}: disk: found {} free, expected at least {} for the best and the last checkpoint",
        output.display(), HumanBytes(*found), HumanBytes(*expected)
    )]
    Disk {
        /// The output folder.
        output: PathBuf,
        /// What is free (bytes).
        found: u64,
        /// What is needed (bytes).
        expected: u64,
    },
}
