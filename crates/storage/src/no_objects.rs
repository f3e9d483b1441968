//! Without the feature `object-store`: every URL of a store is an error.

use std::{io, path::Path};

use super::{Entry, File, Kind, Storage, Version, scheme, unsupported};

pub(crate) struct Objects;

impl Storage for Objects {
    fn kind(&self, path: &Path) -> io::Result<Kind> {
        Err(needs_feature(path))
    }

    fn list(&self, directory: &Path) -> io::Result<Vec<Entry>> {
        Err(needs_feature(directory))
    }

    fn open(&self, path: &Path) -> io::Result<File> {
        Err(needs_feature(path))
    }
}

pub(crate) fn upload(_file: &Path, to: &Path) -> io::Result<()> {
    Err(needs_feature(to))
}

pub(crate) fn read_version(path: &Path) -> io::Result<Option<(Vec<u8>, Version)>> {
    Err(needs_feature(path))
}

pub(crate) fn replace(path: &Path, _: Vec<u8>, _: Option<&Version>) -> io::Result<Version> {
    Err(needs_feature(path))
}

fn needs_feature(path: &Path) -> io::Error {
    let expected = "a path: this program was built without `--features object-store`";
    unsupported(scheme(path).unwrap_or_default(), expected)
}
