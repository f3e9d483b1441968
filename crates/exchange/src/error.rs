//! What can be wrong with files of other programs.

use std::{
    io,
    path::{Path, PathBuf},
};

use eddy_bag::BagError;
use eddy_frames::InvalidFrame;

/// Why frames could not be handed to, or taken from, another program's file.
#[derive(Debug, thiserror::Error)]
pub enum ExchangeError {
    /// A bag could not be read or written.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// The operating system refused.
    #[error("{path}: {action}: {reason}", path = .path.display())]
    Io {
        /// The file or directory.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// What the system said.
        reason: io::Error,
    },
    /// The output would overwrite something.
    #[error("{path}: found something of that name, expected a path where nothing is yet", path = .path.display())]
    Exists {
        /// The path asked for.
        path: PathBuf,
    },
    /// The output cannot hold so many streams.
    #[error("{path}: found {found} streams, expected 1 for a lone file: choose one with --stream, or name a directory", path = .path.display())]
    OneFile {
        /// The path asked for.
        path: PathBuf,
        /// How many streams there are.
        found: usize,
    },
    /// No bag has the stream.
    #[error("stream: found {found}, expected {wanted}")]
    NoStream {
        /// The streams there are.
        found: String,
        /// The one asked for.
        wanted: u64,
    },
    /// A stream is there twice, and both would get one name.
    #[error("stream {stream}: found it in {first} and in {second}, expected it in one of them", first = .first.display(), second = .second.display())]
    SameStream {
        /// The stream.
        stream: u64,
        /// A bag or file that has it.
        first: PathBuf,
        /// Another one.
        second: PathBuf,
    },
    /// A stream has fewer frames than were asked for.
    #[error("{bag}: stream {stream}: found {found} frames, expected at least {wanted}", bag = .bag.display())]
    TooShort {
        /// The bag.
        bag: PathBuf,
        /// The stream.
        stream: u64,
        /// How many frames it has.
        found: usize,
        /// How many were asked for.
        wanted: usize,
    },
    /// A stream does not have the form that the format asks for.
    #[error("{bag}: stream {stream}: {field}: found {found}, expected {expected}: {rule}", bag = .bag.display())]
    Unfit {
        /// The bag.
        bag: PathBuf,
        /// The stream.
        stream: u64,
        /// What does not fit.
        field: &'static str,
        /// Its value there.
        found: String,
        /// The value it should have.
        expected: String,
        /// What the format demands, and what else can be done.
        rule: &'static str,
    },
    /// A file is not of the kind expected.
    #[error("{path}: found {found}, expected {expected}", path = .path.display())]
    File {
        /// The file or directory.
        path: PathBuf,
        /// What is there.
        found: String,
        /// What should be there.
        expected: &'static str,
    },
    /// An array, or a key, of a file cannot be used.
    #[error("{path}: {array}: found {found}, expected {expected}", path = .path.display())]
    Array {
        /// The file.
        path: PathBuf,
        /// The array's name.
        array: String,
        /// What it holds.
        found: String,
        /// What it should hold.
        expected: String,
    },
    /// An array holds Python objects.
    #[error(
        "{path}: {array}: found an object array, expected numbers: object arrays are pickles, and \
         reading a pickle runs whatever program its author put into it; where the file is \
         trusted, save it in Python as a structured array with the fields position and \
         particle_type instead", path = .path.display()
    )]
    Pickle {
        /// The file.
        path: PathBuf,
        /// The array's name.
        array: String,
    },
    /// What a file holds is no frame.
    #[error("{path}: frame {frame}: {reason}", path = .path.display())]
    Frame {
        /// The file.
        path: PathBuf,
        /// Number of the frame in the file, from 0.
        frame: usize,
        /// What is wrong with it.
        reason: InvalidFrame,
    },
    /// This program was built without HDF5.
    #[error(
        "hdf5: found a program built without HDF5, expected one built with `--features hdf5` \
         (needs the HDF5 C library) or `--features hdf5-static` (needs cmake)"
    )]
    NoHdf5,
    /// The HDF5 library refused.
    #[error("{path}: HDF5: {reason}", path = .path.display())]
    Hdf5 {
        /// The file.
        path: PathBuf,
        /// What it said.
        reason: String,
    },
    /// The caller asked for an early end.
    #[error("interrupted: nothing was written")]
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
