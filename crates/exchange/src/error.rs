//! Errors of imports and exports.

use std::{
    io,
    path::{Path, PathBuf},
};

use eddy_bag::BagError;
use eddy_dataset::DatasetError;
use eddy_messages::UnusableFrame;

/// Why frames cannot be imported or exported.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the message of each variant says what its fields are")]
pub enum ExchangeError {
    /// A bag cannot be read or written.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// A bag states a quantity that is not in its range.
    #[error(transparent)]
    Stated(DatasetError),
    /// The operating system reports an error.
    #[error("{path}: {action}: {reason}", path = .path.display())]
    Io { path: PathBuf, action: &'static str, reason: io::Error },
    /// The output exists.
    #[error("{path}: already exists; choose another output path or delete it", path = .path.display())]
    Exists { path: PathBuf },
    /// The output is a single file, for one stream.
    #[error("{path}: found {found} streams, expected 1 for a single file; choose one with --stream, or give a directory", path = .path.display())]
    OneFile { path: PathBuf, found: usize },
    /// No bag has the stream; `found` lists their streams.
    #[error("stream: found {found}, expected {wanted}")]
    NoStream { found: String, wanted: u64 },
    /// Two bags or files have a stream with this id.
    #[error("stream {stream}: found in {first} and in {second}, expected in one of them; convert them one by one", first = .first.display(), second = .second.display())]
    SameStream { stream: u64, first: PathBuf, second: PathBuf },
    /// A stream has fewer frames than selected.
    #[error("{bag}: stream {stream}: found {found} frames, expected at least {wanted}", bag = .bag.display())]
    TooShort { bag: PathBuf, stream: u64, found: usize, wanted: usize },
    /// The format cannot represent a stream; `rule` is its requirement, and what else can be done.
    #[error("{bag}: stream {stream}: {field}: found {found}, expected {expected}: {rule}", bag = .bag.display())]
    Unsuitable {
        bag: PathBuf,
        stream: u64,
        field: &'static str,
        found: String,
        expected: String,
        rule: &'static str,
    },
    /// A file is not of the expected kind.
    #[error("{path}: found {found}, expected {expected}", path = .path.display())]
    File { path: PathBuf, found: String, expected: &'static str },
    /// An array of a file cannot be used.
    #[error("{path}: {array}: found {found}, expected {expected}", path = .path.display())]
    Array { path: PathBuf, array: String, found: String, expected: String },
    /// An array holds Python objects.
    #[error(
        "{path}: {array}: found an object array, expected numbers: object arrays are pickles, and \
         reading a pickle runs any program that its author put into it; if you trust the file, \
         save it in Python as a structured array with the fields position and particle_type \
         instead", path = .path.display()
    )]
    Pickle { path: PathBuf, array: String },
    /// A frame of a file cannot be used.
    #[error(transparent)]
    Frame(Box<UnusableFrame>),
    /// This program was built without HDF5.
    #[error(
        "hdf5: this program was built without HDF5; build it with `--features hdf5` (needs the \
         HDF5 C library) or `--features hdf5-static` (needs cmake)"
    )]
    NoHdf5,
    /// The HDF5 library reports an error.
    #[error("{path}: HDF5: {reason}", path = .path.display())]
    Hdf5 { path: PathBuf, reason: String },
    /// The progress callback stopped the operation.
    #[error("interrupted; nothing was written")]
    Interrupted,
}

impl ExchangeError {
    /// For `map_err`: an [`ExchangeError::Io`] of `action` on `path`.
    pub(super) fn io(path: &Path, action: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |reason| Self::Io { path: path.into(), action, reason }
    }

    /// For `map_err`: why the output `path` cannot be created.
    pub fn output(path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |reason| match reason.kind() {
            io::ErrorKind::AlreadyExists => Self::Exists { path: path.into() },
            _ => Self::io(path, "creating the output")(reason),
        }
    }
}
