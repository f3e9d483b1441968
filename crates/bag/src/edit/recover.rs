//! What can be read of a damaged bag.

use std::{
    cell::RefCell,
    path::{Path, PathBuf},
};

use super::{CopyOptions, copy};
use crate::{
    error::BagError, faults::Faults, index::FileIndex, layout, metadata, reader::BagReader,
    writer::BagSummary,
};

/// A bag of which every message that can be read will be saved: a directory, whatever its
/// `metadata.yaml` says, or a lone file.
#[derive(Debug)]
pub struct Recovery {
    bag: BagReader,
    /// Of files that are no MCAP files.
    losses: Faults<BagError>,
    /// Messages that the bag has by what its files and its `metadata.yaml` say.
    stated: u64,
}

/// What came of a recovery.
#[derive(Clone, Debug)]
pub struct Recovered {
    /// The new bag.
    pub bag: BagSummary,
    /// What was wrong with the old one, one sentence each; empty when nothing of it is missing. Of many
    /// faults the first ten, and how many more there were.
    pub losses: Vec<String>,
}

impl Recovery {
    /// Looks for what can be read. `watch` is called with the bytes that were passed over since; `false`
    /// ends the work.
    ///
    /// # Errors
    /// [`BagError::Io`] when the system refuses a file; bytes that the disk cannot read are none, but a
    /// loss. [`BagError::NotABag`], [`BagError::Interrupted`].
    pub fn open(path: &Path, watch: &mut dyn FnMut(u64) -> bool) -> Result<Self, BagError> {
        let (mut losses, mut files) = (Faults::default(), Vec::<FileIndex>::new());
        for file in layout::mcap_files(path)? {
            match FileIndex::open_watched(&file, files.len(), watch) {
                Ok(index) => files.push(index),
                Err(error @ BagError::Magic { .. }) => losses.add(error),
                Err(error) => return Err(error),
            }
        }
        let by_files = files.iter().map(|file| file.stated.unwrap_or(0).max(file.messages())).sum();
        // One that cannot be read states nothing.
        let by_metadata = metadata::message_count(path).ok().flatten().unwrap_or(0);
        let bag = BagReader::of_files(path, files);
        Ok(Self { bag, losses, stated: by_metadata.max(by_files) })
    }

    /// Size of the bag's files together (bytes).
    ///
    /// # Errors
    /// [`BagError::Io`], [`BagError::NotABag`].
    pub fn size(path: &Path) -> Result<u64, BagError> {
        let size = |file: PathBuf| {
            let metadata = std::fs::metadata(&file);
            metadata.map(|found| found.len()).map_err(BagError::io(file, "measuring the file"))
        };
        layout::mcap_files(path)?.into_iter().map(size).sum()
    }

    /// The bag as far as it can be read.
    pub fn bag(&self) -> &BagReader {
        &self.bag
    }

    /// Copies what can be read into a new bag at `output`. The old bag is not touched.
    ///
    /// A chunk that fails its checksum is left out as a whole, since nothing tells which of its messages
    /// is wrong. Of a chunk that the end of the file cuts, the messages before the cut are kept. A file
    /// that was never closed but ends after a whole record counts as whole, unless `metadata.yaml` or a
    /// summary says that there was more.
    ///
    /// # Errors
    /// [`BagError::Nothing`] when there is no message to keep, otherwise as
    /// [`extract`](fn@super::extract).
    pub fn save(self, output: &Path, options: CopyOptions<'_>) -> Result<Recovered, BagError> {
        let Self { bag, losses, stated } = self;
        // Noted while both iterators are in use.
        let losses = RefCell::new(losses);
        let extras = bag.extras().filter_map(|extra| kept(extra, &losses));
        let messages = bag.messages().filter_map(|message| kept(message, &losses));
        let saved = copy(output, bag.channels(), extras, messages, options)?;
        let mut losses = losses.into_inner();
        let mut losses: Vec<String> = std::iter::from_fn(|| losses.take_next(bag.path()))
            .map(|fault| fault.to_string())
            .collect();
        if saved.messages < stated {
            let (path, found) = (bag.path().display(), saved.messages);
            losses.push(format!("{path}: found {found} messages, expected the {stated} it states"));
        }
        Ok(Recovered { bag: saved, losses })
    }
}

/// What goes into the new bag; damage does not, and is noted.
fn kept<T>(
    found: Result<T, BagError>,
    losses: &RefCell<Faults<BagError>>,
) -> Option<Result<T, BagError>> {
    match found {
        // What the system refuses now it may give later: this is no loss to accept.
        Ok(_) | Err(BagError::Io { .. }) => return Some(found),
        Err(BagError::FurtherFaults { faults, .. }) => losses.borrow_mut().add_further(faults),
        Err(damage) => losses.borrow_mut().add(damage),
    }
    None
}
