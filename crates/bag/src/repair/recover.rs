//! Copies what can be read of a damaged bag into a new one.

use std::{
    cell::RefCell,
    path::{Path, PathBuf},
};

use crate::{
    edit::copy::{CopyOptions, Recording, copy},
    error::BagError,
    format::{layout, metadata, summary::BagSummary},
    read::{error_log::ErrorLog, index::FileIndex, open::Source, reader::BagReader},
};

/// A bag to recover: all files of a directory, regardless of `metadata.yaml`, or a single file.
#[derive(Debug)]
pub struct Recovery {
    bag: BagReader,
    /// Files that are not MCAP files.
    losses: ErrorLog<BagError>,
    /// Number of messages declared by the files and by `metadata.yaml`.
    declared: u64,
}

/// Result of a recovery.
#[derive(Clone, Debug)]
pub struct Recovered {
    /// The new bag.
    pub bag: BagSummary,
    /// Descriptions of the damage; empty when nothing is missing. At most ten, then the number of the others.
    pub losses: Vec<String>,
}

impl Recovery {
    /// Indexes the files. `progress` is called with the number of bytes read since the last call; `false` stops
    /// the operation.
    ///
    /// # Errors
    /// [`BagError::Io`], but not for bytes that the disk cannot read, which are damage. [`BagError::NotABag`], [`BagError::Interrupted`].
    pub fn open(path: &Path, progress: &mut dyn FnMut(u64) -> bool) -> Result<Self, BagError> {
        let (mut losses, mut files) = (ErrorLog::default(), Vec::<FileIndex>::new());
        for file in layout::mcap_files(path)? {
            // The messages count, not what a summary section says of them.
            match FileIndex::open_by(&file, files.len(), Source::ScanOrSummary, progress) {
                Ok(index) => files.push(index),
                Err(error @ BagError::Magic { .. }) => losses.push(error),
                Err(error) => return Err(error),
            }
        }
        let by_files =
            files.iter().map(|file| file.declared_messages.unwrap_or(0).max(file.messages())).sum();
        // An unreadable metadata.yaml declares nothing.
        let in_yaml = metadata::readable(path);
        let by_metadata = in_yaml.as_ref().and_then(|of| of.message_count).unwrap_or(0);
        let bag = BagReader::from_files(path, files, in_yaml);
        Ok(Self { bag, losses, declared: by_metadata.max(by_files) })
    }

    /// Total size of the files of a bag (bytes).
    ///
    /// # Errors
    /// [`BagError::Io`], [`BagError::NotABag`].
    pub fn size(path: &Path) -> Result<u64, BagError> {
        let size = |file: PathBuf| {
            let metadata = std::fs::metadata(&file);
            metadata
                .map(|found| found.len())
                .map_err(BagError::io(file, "reading the size of the file"))
        };
        layout::mcap_files(path)?.into_iter().map(size).sum()
    }

    /// The readable part of the bag.
    pub fn bag(&self) -> &BagReader {
        &self.bag
    }

    /// Copies what can be read into a new bag at `output`. The old bag is not changed.
    ///
    /// A chunk with a wrong checksum is skipped as a whole, since it is unknown which of its messages are
    /// damaged. Of a truncated chunk, the messages before the end of the file are kept. An unfinished file that
    /// ends after a complete record is not damaged, unless `metadata.yaml` or statistics declare more messages.
    ///
    /// # Errors
    /// [`BagError::Nothing`] when no message can be read, otherwise as [`extract`](fn@crate::extract).
    pub fn save(self, output: &Path, options: CopyOptions<'_>) -> Result<Recovered, BagError> {
        let Self { bag, losses, declared } = self;
        // Shared by both iterators.
        let losses = RefCell::new(losses);
        let auxiliary = bag.auxiliary().filter_map(|record| skip_damage(record, &losses));
        let messages = bag.messages().filter_map(|message| skip_damage(message, &losses));
        let recording = Recording {
            custom_data: bag.custom_data().clone(),
            distro: bag.distro().to_owned(),
            auxiliary,
        };
        let saved = copy(output, bag.channels(), recording, messages, options)?;
        let mut losses = losses.into_inner();
        let mut losses: Vec<String> =
            std::iter::from_fn(|| losses.pop(bag.path())).map(|error| error.to_string()).collect();
        if saved.messages < declared {
            let (path, found) = (bag.path().display(), saved.messages);
            losses
                .push(format!("{path}: found {found} messages, expected the {declared} declared"));
        }
        Ok(Recovered { bag: saved, losses })
    }
}

/// Passes on what could be read; skips damage and adds it to `losses`.
fn skip_damage<T>(
    found: Result<T, BagError>,
    losses: &RefCell<ErrorLog<BagError>>,
) -> Option<Result<T, BagError>> {
    match found {
        // Errors of the system may be temporary: they stop the recovery.
        Ok(_) | Err(BagError::Io { .. }) => return Some(found),
        Err(BagError::MoreErrors { count, .. }) => losses.borrow_mut().omit(count),
        Err(damage) => losses.borrow_mut().push(damage),
    }
    None
}
