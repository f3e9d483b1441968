//! Files on disk, and objects in a store (`s3://bucket/key`, `gs://bucket/key`), read through one interface.
//!
//! A path is a path of this machine, a `file://` URL, or the URL of an object or a prefix in a store. What begins with a prefix
//! and a slash is in its directory, as the tools of the stores show it. Stores need the feature `object-store`.
//!
//! 1. `file`: a [`File`], read at any position or in order; [`Prefetched`] bytes on their way. `pieces`: reads in order.
//! 2. `disk`: files of this machine.
//! 3. `objects`: objects of stores, or `no_objects` without the feature; `client`: requests to stores, and what their errors mean.

#[cfg(feature = "object-store")]
mod client;
mod disk;
mod file;
#[cfg(not(feature = "object-store"))]
mod no_objects;
#[cfg(feature = "object-store")]
mod objects;
mod pieces;

use std::{
    borrow::Cow,
    io::{self, ErrorKind, Read as _},
    path::{Path, PathBuf},
};

pub use file::{File, Prefetched, Reader};
#[cfg(not(feature = "object-store"))]
use no_objects as objects;

/// What is at a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A file or an object.
    File,
    /// A directory, or a prefix of objects.
    Directory,
}

/// An entry of a directory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// The path of the directory, joined with the name.
    pub path: PathBuf,
    /// Links to directories are no directories.
    pub is_directory: bool,
}

/// Where files are.
trait Storage {
    fn kind(&self, path: &Path) -> io::Result<Kind>;
    /// In any order.
    fn list(&self, directory: &Path) -> io::Result<Vec<Entry>>;
    fn open(&self, path: &Path) -> io::Result<File>;
}

/// Whether the path is a URL of a store, rather than a path of this machine or a `file://` URL.
pub fn is_remote(path: &Path) -> bool {
    scheme(path).is_some_and(|scheme| scheme != "file")
}

/// The path of this machine that a path or a `file://` URL means.
///
/// # Errors
/// [`io::ErrorKind::Unsupported`] for a URL of a store: for what is only read from or written to a disk.
pub fn on_disk(path: &Path) -> io::Result<Cow<'_, Path>> {
    match scheme(path) {
        Some("file") => {
            let path = path.to_str().and_then(|text| text.strip_prefix("file://"));
            let path = path.map(|path| path.strip_prefix("localhost").unwrap_or(path));
            Ok(Cow::Owned(path.unwrap_or_default().into()))
        }
        Some(other) => Err(unsupported(other, "a path of this machine")),
        None => Ok(Cow::Borrowed(path)),
    }
}

/// What is at a path.
///
/// # Errors
/// Those of the system or of the store; [`io::ErrorKind::NotFound`] when there is nothing.
pub fn kind(path: &Path) -> io::Result<Kind> {
    storage(path)?.kind(path)
}

/// Whether there is something at a path.
///
/// # Errors
/// Those of the system or of the store, except that there is nothing.
pub fn exists(path: &Path) -> io::Result<bool> {
    match kind(path) {
        Ok(_) => Ok(true),
        Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
            Ok(false)
        }
        Err(error) => Err(error),
    }
}

/// The entries of a directory, sorted by name.
///
/// # Errors
/// Those of the system or of the store.
pub fn list(directory: &Path) -> io::Result<Vec<Entry>> {
    let mut entries = storage(directory)?.list(directory)?;
    entries.sort_by(|one, other| one.path.cmp(&other.path));
    Ok(entries)
}

/// The text of a file.
///
/// # Errors
/// Those of the system or of the store; [`io::ErrorKind::InvalidData`] when it is not UTF-8.
pub fn read_to_string(path: &Path) -> io::Result<String> {
    let mut text = String::new();
    File::open(path)?.reader()?.read_to_string(&mut text)?;
    Ok(text)
}

/// Stores a file of this machine as the object at a URL of a store, in place of what is there. It appears complete or not at
/// all.
///
/// # Errors
/// Those of the system or of the store.
pub fn upload(file: &Path, to: &Path) -> io::Result<()> {
    objects::upload(file, to)
}

/// Identifies what an object was when it was read or written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Version {
    /// Its entity tag.
    pub e_tag: Option<String>,
    /// Its generation, in stores that number them.
    pub generation: Option<String>,
}

/// The content of an object and its version; `None` if it does not exist.
///
/// # Errors
/// Those of the store.
pub fn read_version(path: &Path) -> io::Result<Option<(Vec<u8>, Version)>> {
    objects::read_version(path)
}

/// Replaces the `known` version of an object, or creates it if none is known. Returns the new version.
///
/// # Errors
/// [`io::ErrorKind::AlreadyExists`] when another writer was faster; those of the store.
pub fn replace(path: &Path, bytes: Vec<u8>, known: Option<&Version>) -> io::Result<Version> {
    objects::replace(path, bytes, known)
}

/// Where a path is.
///
/// # Errors
/// [`io::ErrorKind::Unsupported`] for other schemes than `s3`, `gs` and `file`.
fn storage(path: &Path) -> io::Result<&'static dyn Storage> {
    match scheme(path) {
        None | Some("file") => Ok(&disk::Disk),
        Some("s3" | "gs") => Ok(&objects::Objects),
        Some(other) => Err(unsupported(other, "s3://, gs://, file:// or a path")),
    }
}

fn scheme(path: &Path) -> Option<&str> {
    let (scheme, _) = path.to_str()?.split_once("://")?;
    let is_scheme = scheme.starts_with(|c: char| c.is_ascii_alphabetic())
        && scheme.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '+' | '-' | '.'));
    is_scheme.then_some(scheme)
}

fn unsupported(scheme: &str, expected: &str) -> io::Error {
    let message = format!("found a URL that begins with {scheme}://, expected {expected}");
    io::Error::new(ErrorKind::Unsupported, message)
}

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_path_and_its_file_url_are_the_same_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a text.txt");
        fs::write(&path, "hello").unwrap();
        fs::create_dir(folder.path().join("b")).unwrap();
        for prefix in ["", "file://", "file://localhost"] {
            let at = |path: &Path| PathBuf::from(format!("{prefix}{}", path.display()));
            assert_eq!(kind(&at(&path)).unwrap(), Kind::File);
            assert_eq!(kind(&at(folder.path())).unwrap(), Kind::Directory);
            assert_eq!(read_to_string(&at(&path)).unwrap(), "hello");
            assert_eq!(on_disk(&at(&path)).unwrap(), path);
            let names: Vec<_> = list(&at(folder.path())).unwrap();
            let [file, directory] = &names[..] else { panic!("{names:?}") };
            assert!(!file.is_directory && file.path.ends_with("a text.txt"), "{names:?}");
            assert!(directory.is_directory && directory.path.ends_with("b"), "{names:?}");
            assert!(!exists(&at(&folder.path().join("c"))).unwrap());
            assert!(!exists(&at(&path.join("below a file"))).unwrap());
        }
    }

    #[test]
    fn other_urls_are_rejected_with_what_is_expected() {
        let message = kind(Path::new("ftp://host/bag")).unwrap_err().to_string();
        let expected =
            "found a URL that begins with ftp://, expected s3://, gs://, file:// or a path";
        assert_eq!(message, expected);
        let message = on_disk(Path::new("s3://bucket/bag")).unwrap_err().to_string();
        assert!(message.ends_with("expected a path of this machine"), "{message}");
    }

    #[test]
    #[cfg(not(feature = "object-store"))]
    fn without_the_feature_a_url_of_a_store_is_rejected() {
        let url = Path::new("s3://bucket/bag");
        for error in [kind(url).unwrap_err(), upload(Path::new("bag"), url).unwrap_err()] {
            assert!(error.to_string().contains("--features object-store"), "{error}");
        }
    }

    #[test]
    fn names_with_colons_are_paths() {
        for name in ["run:1", "a/b:c", "://x", "1x://y"] {
            assert!(!is_remote(Path::new(name)), "{name}");
            assert_eq!(on_disk(Path::new(name)).unwrap(), Path::new(name));
        }
    }
}
