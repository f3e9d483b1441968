//! Why a checkpoint cannot be read, written or used.

use std::{io, path::PathBuf};

/// Why a checkpoint cannot be read, written or used.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The directory has no checkpoint.
    #[error("{}: found no model.toml, expected a checkpoint: a directory that has one, or particle-mingru, the shipped model", directory.display())]
    NoCheckpoint {
        /// The directory.
        directory: PathBuf,
    },
    /// The directory has the name of a checkpoint that is no longer shipped.
    #[error(
        "{}: found nothing; this checkpoint was replaced by the one that is built in: leave `--checkpoint` out, and give or state the stiffness",
        directory.display()
    )]
    Replaced {
        /// The directory.
        directory: PathBuf,
    },
    /// A file cannot be read.
    #[error("{}: {reason}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// The system's error.
        reason: io::Error,
    },
    /// A file cannot be written.
    #[error("{}: {reason}", file.display())]
    Write {
        /// The file, or its directory.
        file: PathBuf,
        /// The system's error.
        reason: io::Error,
    },
    /// The description is not valid TOML, or has a missing or unknown key.
    #[error("{}: {reason}", file.display())]
    Description {
        /// The file.
        file: PathBuf,
        /// Line, key and problem.
        reason: String,
    },
    /// A value of the description is out of range.
    #[error("{}: {field}: found {found}, expected {expected}", file.display())]
    Field {
        /// The file.
        file: PathBuf,
        /// The key.
        field: String,
        /// Its value.
        found: String,
        /// The expected value.
        expected: String,
    },
    /// The weights file is damaged or not a safetensors file.
    #[error("{}: found {found}, expected a complete safetensors file", file.display())]
    Corrupt {
        /// The file.
        file: PathBuf,
        /// The parser's error.
        found: String,
    },
    /// A tensor is not of the type that the description says.
    #[error("{}: {tensor}: found numbers of type {found}, expected {expected}", file.display())]
    NumberType {
        /// The file.
        file: PathBuf,
        /// The tensor.
        tensor: String,
        /// Its number type.
        found: String,
        /// The number type of the description's weights.
        expected: String,
    },
    /// A tensor of the described network is missing.
    #[error("{}: {tensor}: found nothing, expected a tensor of shape {expected:?}", file.display())]
    Missing {
        /// The file.
        file: PathBuf,
        /// The tensor.
        tensor: String,
        /// The shape it should have.
        expected: Vec<usize>,
    },
    /// A tensor does not belong to the described network.
    #[error(
        "{}: {tensor}: found a tensor of shape {found:?}, expected none of that name in this network",
        file.display()
    )]
    Unexpected {
        /// The file.
        file: PathBuf,
        /// The tensor.
        tensor: String,
        /// Its shape.
        found: Vec<usize>,
    },
    /// A tensor does not have the shape of the described network.
    #[error("{}: {tensor}: found shape {found:?}, expected {expected:?}", file.display())]
    Shape {
        /// The file.
        file: PathBuf,
        /// The tensor.
        tensor: String,
        /// Its shape.
        found: Vec<usize>,
        /// The shape it should have.
        expected: Vec<usize>,
    },
    /// A weight is NaN or infinite.
    #[error("{}: {tensor}[{index}]: found {found}, expected a finite number", file.display())]
    NotFinite {
        /// The file.
        file: PathBuf,
        /// The tensor.
        tensor: String,
        /// Index of the first such value, last axis fastest.
        index: usize,
        /// The value.
        found: f32,
    },
    /// A weight has more digits than the description's number type.
    #[error("{}: {tensor}[{index}]: found {found}, expected {expected}, its nearest 16-bit number", file.display())]
    NotRounded {
        /// The file.
        file: PathBuf,
        /// The tensor.
        tensor: String,
        /// Place of the weight in it.
        index: usize,
        /// The weight.
        found: f32,
        /// The weight rounded.
        expected: f32,
    },
}
