//! Indexes a file: from its summary section if that is usable, otherwise by a scan of the whole file.

use std::{
    io::{self, Read},
    path::Path,
};

use eddy_storage::File;
use mcap::MAGIC;

use super::{
    index::{FileIndex, Progress},
    records::{self, Records},
};
use crate::error::BagError;

impl FileIndex {
    /// Indexes file `number` of a bag.
    ///
    /// # Errors
    /// [`BagError::Io`]; [`BagError::Magic`] when it is not an MCAP file. Damage after the first bytes is not
    /// an error but recorded in the index.
    pub(super) fn open(path: &Path, number: usize) -> Result<Self, BagError> {
        Self::open_with_progress(path, number, &mut |_| true)
    }

    /// As [`FileIndex::open`], with a callback during a scan.
    ///
    /// # Errors
    /// Also [`BagError::Interrupted`].
    pub(crate) fn open_with_progress(
        path: &Path,
        number: usize,
        progress: &mut Progress<'_>,
    ) -> Result<Self, BagError> {
        let failed = |reason| BagError::Io { path: path.into(), action: "reading", reason };
        let file = File::open(path).map_err(BagError::io(path, "opening the file"))?;
        let size = file.size();
        let mut reader = file.reader().map_err(failed)?;
        let mut magic = Vec::new();
        readable(reader.by_ref().take(MAGIC.len() as u64).read_to_end(&mut magic))
            .map_err(failed)?;
        if !MAGIC.starts_with(&magic) {
            return Err(BagError::Magic { path: path.into(), found: magic });
        }
        let mut index = Self::new(path, number, file.clone());
        let start = readable(records::summary_start(&mut reader, size)).map_err(failed)?.flatten();
        if let Some(start) = start {
            let mut records = Records::new(reader, size, start);
            let found = readable(index.read_summary(&mut records, start)).map_err(failed)?;
            if found == Some(true) {
                if !progress(size) {
                    return Err(BagError::Interrupted { path: path.into() });
                }
                return Ok(index);
            }
            // The scan keeps the channels: the start of the file, where they are declared, may be damaged.
            let Self { schemas, channels, .. } = index;
            index = Self { schemas, channels, ..Self::new(path, number, file.clone()) };
            reader = file.reader().map_err(failed)?;
        }
        let records = Records::new(reader, size, size.min(MAGIC.len() as u64));
        index.scan_records(records, progress)
    }

    /// Indexes a file by a scan, without its summary section.
    ///
    /// # Errors
    /// [`BagError::Io`].
    pub(crate) fn scan(path: &Path) -> Result<Self, BagError> {
        let file = File::open(path).map_err(BagError::io(path, "opening the file"))?;
        let reader = file.reader().map_err(BagError::io(path, "reading"))?;
        let records = Records::new(reader, file.size(), MAGIC.len() as u64);
        Self::new(path, 0, file).scan_records(records, &mut |_| true)
    }
}

/// `None` where the disk has a bad sector.
fn readable<T>(read: io::Result<T>) -> io::Result<Option<T>> {
    match read {
        Ok(read) => Ok(Some(read)),
        Err(error) if BagError::is_unreadable(&error) => Ok(None),
        Err(error) => Err(error),
    }
}
