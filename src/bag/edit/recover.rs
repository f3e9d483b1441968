//! What can be read of a damaged bag.

use std::path::{Path, PathBuf};

use super::{CopyOptions, copy};
use crate::bag::{
    error::BagError, index::FileIndex, layout, metadata, reader::BagReader, writer::BagSummary,
};

/// A bag of which every message that can be read will be saved: a directory, whatever its
/// `metadata.yaml` says, or a lone file.
#[derive(Debug)]
pub struct Recovery {
    bag: BagReader,
    losses: Vec<String>,
    /// Messages that the bag has by what its files and its `metadata.yaml` say.
    stated: u64,
}

/// What came of a recovery.
#[derive(Clone, Debug)]
pub struct Recovered {
    /// The new bag.
    pub bag: BagSummary,
    /// What was wrong with the old one, one sentence each; empty when nothing of it is missing.
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
        let (mut losses, mut files) = (Vec::new(), Vec::<FileIndex>::new());
        for file in layout::mcap_files(path)? {
            match FileIndex::open_watched(&file, files.len(), watch) {
                Ok(index) => {
                    losses.extend(index.damage.as_ref().map(|d| d.error(&file).to_string()));
                    files.push(index);
                }
                Err(error @ BagError::Magic { .. }) => losses.push(error.to_string()),
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
        let Self { bag, losses: known, stated } = self;
        let mut losses = Vec::new();
        let mut lose = |damage: BagError| {
            let damage = damage.to_string();
            if !known.contains(&damage) {
                losses.push(damage);
            }
        };
        let mut extras = Vec::new();
        for extra in bag.extras() {
            match extra {
                // What the system refuses now it may give later: this is no loss to accept.
                Ok(_) | Err(BagError::Io { .. }) => extras.push(extra),
                Err(damage) => lose(damage),
            }
        }
        let readable = bag.messages().filter_map(|message| match message {
            Ok(_) | Err(BagError::Io { .. }) => Some(message),
            Err(damage) => {
                lose(damage);
                None
            }
        });
        let saved = copy(output, bag.channels(), extras, readable, options)?;
        let mut losses: Vec<String> = known.iter().cloned().chain(losses).collect();
        if saved.messages < stated {
            let (path, found) = (bag.path().display(), saved.messages);
            losses.push(format!("{path}: found {found} messages, expected the {stated} it states"));
        }
        Ok(Recovered { bag: saved, losses })
    }
}
