//! Why a network cannot be trained.

use std::{io, path::PathBuf};

use crate::{checkpoint::CheckpointError, engine::ModelError, eval::EvalError};

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
    /// `metrics.csv` cannot be written.
    #[error("{}: {reason}", file.display())]
    Metrics {
        /// The file.
        file: PathBuf,
        /// What the system said.
        reason: io::Error,
    },
}
