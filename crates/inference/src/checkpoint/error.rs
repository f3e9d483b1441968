//! Why something is no checkpoint.

use std::{io, path::PathBuf};

/// Why a checkpoint cannot be read, written or used.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// A file cannot be read.
    #[error("{}: {reason}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// What the system said.
        reason: io::Error,
    },
    /// A file cannot be written.
    #[error("{}: {reason}", file.display())]
    Write {
        /// The file, or the directory that should hold it.
        file: PathBuf,
        /// What the system said.
        reason: io::Error,
    },
    /// The description is no TOML, or lacks a key, or has one too many.
    #[error("{}: {reason}", file.display())]
    Description {
        /// The file.
        file: PathBuf,
        /// Line, key, and what is wrong there.
        reason: String,
    },
    /// A value of the description is another one than expected.
    #[error("{}: {field}: found {found}, expected {expected}", file.display())]
    Field {
        /// The file.
        file: PathBuf,
        /// The key.
        field: String,
        /// Its value.
        found: String,
        /// What it should be.
        expected: String,
    },
    /// The weights file is damaged, or no safetensors file.
    #[error("{}: found {found}, expected a whole safetensors file", file.display())]
    Corrupt {
        /// The file.
        file: PathBuf,
        /// What the reader stumbled over.
        found: String,
    },
    /// A tensor has another number type than f32.
    #[error("{}: {tensor}: found numbers of type {found}, expected F32", file.display())]
    NumberType {
        /// The file.
        file: PathBuf,
        /// The tensor.
        tensor: String,
        /// Its number type.
        found: String,
    },
    /// A tensor of the described network is not there.
    #[error("{}: {tensor}: found nothing, expected a tensor of shape {expected:?}", file.display())]
    Missing {
        /// The file.
        file: PathBuf,
        /// The tensor.
        tensor: String,
        /// The shape it should have.
        expected: Vec<usize>,
    },
    /// There is a tensor that the described network does not have.
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
    /// A tensor has another shape than the described network's.
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
        /// Index of the first such number, last axis fastest.
        index: usize,
        /// The number.
        found: f32,
    },
}
