//! Indexes a file: from its summary section if that is usable, otherwise by a scan of the whole file.

use std::{
    io::{self, Read},
    path::Path,
};

use eddy_storage::File;
use mcap::MAGIC;

use super::{
    auxiliary,
    index::{Declarations, FileIndex, Progress},
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
        Self::open_by(path, number, Source::Summary, &mut |_| true)
    }

    /// As [`FileIndex::open`], from the source of choice, with a callback during a scan.
    ///
    /// # Errors
    /// Also [`BagError::Interrupted`].
    pub(crate) fn open_by(
        path: &Path,
        number: usize,
        source: Source,
        progress: &mut Progress<'_>,
    ) -> Result<Self, BagError> {
        let mut index = Self::index(path, number, source, progress)?;
        index.description = auxiliary::description(&index.file, &index.auxiliary);
        Ok(index)
    }

    fn index(
        path: &Path,
        number: usize,
        source: Source,
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
            return Err(not_mcap(path, magic, &mut reader));
        }
        let (mut by_summary, mut is_confirmed) = (None, false);
        let mut declared = Declarations::default();
        let start = readable(records::summary_start(&mut reader, size)).map_err(failed)?.flatten();
        if let Some(start) = start {
            let mut index = Self::new(path, number, file.clone());
            let mut records = Records::new(reader, size, start);
            let found = readable(index.read_summary(&mut records, start)).map_err(failed)?;
            // The scan keeps the channels: the start of the file, where they are declared, may be damaged.
            declared = index.declared.clone();
            is_confirmed = found == Some(true);
            if is_confirmed && source == Source::Summary {
                if !progress(size) {
                    return Err(BagError::Interrupted { path: path.into() });
                }
                return Ok(index);
            }
            by_summary = index.summarized.then_some(index);
            reader = file.reader().map_err(failed)?;
        }
        let records = Records::new(reader, size, size.min(MAGIC.len() as u64));
        let index = Self { summarized: is_confirmed, ..Self::new(path, number, file) };
        let index = index.scan_records(records, declared, progress)?;
        // Damage between the chunks hides some of them from a scan. What loses messages is not preferred.
        let is_damaged = index.errors().next().is_some();
        let finds_more = |by_summary: &Self| {
            is_damaged
                && source != Source::Scan
                && (is_confirmed || by_summary.messages() > index.messages())
        };
        Ok(by_summary.filter(finds_more).unwrap_or(index))
    }

    /// Indexes a file by a scan, without its summary section.
    ///
    /// # Errors
    /// [`BagError::Io`].
    pub(crate) fn scan(path: &Path) -> Result<Self, BagError> {
        let file = File::open(path).map_err(BagError::io(path, "opening the file"))?;
        let reader = file.reader().map_err(BagError::io(path, "reading"))?;
        let records = Records::new(reader, file.size(), MAGIC.len() as u64);
        Self::new(path, 0, file).scan_records(records, Declarations::default(), &mut |_| true)
    }
}

/// Where the index of a file comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Source {
    /// From the summary section, if the message indexes confirm it, else from a scan.
    Summary,
    /// From a scan of all records.
    Scan,
    /// From a scan of all records, unless that meets damage and the summary section finds more.
    ScanOrSummary,
}

/// How a file of Git LFS begins that holds the address of a file in its place
/// (<https://github.com/git-lfs/git-lfs/blob/main/docs/spec.md>).
const LFS_POINTER: &[u8] = b"version https://git-lfs";

/// The error of a file that begins with `found` instead of the bytes of MCAP.
fn not_mcap(path: &Path, mut found: Vec<u8>, rest: &mut impl Read) -> BagError {
    let begun = found.len();
    // Bytes that cannot be read are no pointer.
    let _ = rest
        .take((LFS_POINTER.len() - begun.min(LFS_POINTER.len())) as u64)
        .read_to_end(&mut found);
    if found == LFS_POINTER {
        return BagError::LfsPointer { path: path.into() };
    }
    found.truncate(begun);
    BagError::Magic { path: path.into(), found }
}

/// `None` where the disk has a bad sector.
fn readable<T>(read: io::Result<T>) -> io::Result<Option<T>> {
    match read {
        Ok(read) => Ok(Some(read)),
        Err(error) if BagError::is_unreadable(&error) => Ok(None),
        Err(error) => Err(error),
    }
}
