//! Files of this machine.

use std::{fs, io, path::Path};

use super::{Entry, File, Kind, Storage, on_disk};

pub(crate) struct Disk;

impl Storage for Disk {
    fn kind(&self, path: &Path) -> io::Result<Kind> {
        let metadata = fs::metadata(on_disk(path)?)?;
        Ok(if metadata.is_dir() { Kind::Directory } else { Kind::File })
    }

    fn list(&self, directory: &Path) -> io::Result<Vec<Entry>> {
        let entries = fs::read_dir(on_disk(directory)?)?;
        entries
            .map(|entry| {
                let entry = entry?;
                Ok(Entry { path: entry.path(), is_directory: entry.file_type()?.is_dir() })
            })
            .collect()
    }

    fn open(&self, path: &Path) -> io::Result<File> {
        let path = on_disk(path)?.into_owned();
        let size = fs::File::open(&path)?.metadata()?.len();
        Ok(File::on_disk(path, size))
    }
}
