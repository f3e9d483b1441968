//! What can be read of a damaged bag.

use std::path::{Path, PathBuf};

use super::{CopyOptions, copy};
use crate::bag::{error::BagError, layout, reader::BagReader, writer::BagSummary};

/// What came of a recovery.
#[derive(Clone, Debug)]
pub struct Recovered {
    /// The new bag.
    pub bag: BagSummary,
    /// What was wrong with the old one, one sentence each; empty when nothing of it is missing.
    pub losses: Vec<String>,
}

/// Copies every message that can be read from a bag into a new one at `output`: a directory, whatever
/// its `metadata.yaml` says, or a lone file. The old bag is not touched.
///
/// A chunk that fails its checksum is left out as a whole, since nothing tells which of its messages
/// is wrong. Of a chunk that the end of the file cuts, the messages before the cut are kept. A file
/// that was never closed but ends after a whole record counts as whole.
///
/// # Errors
/// [`BagError::Nothing`] when there is no message to keep, otherwise as [`extract`](fn@super::extract).
pub fn recover(
    path: &Path,
    output: &Path,
    options: CopyOptions<'_>,
) -> Result<Recovered, BagError> {
    let mut losses = Vec::new();
    let mut files: Vec<PathBuf> = Vec::new();
    for file in layout::mcap_files(path)? {
        match BagReader::open_files(path, std::slice::from_ref(&file)) {
            Ok(bag) => {
                losses.extend(bag.damage().map(|damage| damage.to_string()));
                files.push(file);
            }
            Err(error @ BagError::Magic { .. }) => losses.push(error.to_string()),
            Err(error) => return Err(error),
        }
    }
    let bag = BagReader::open_files(path, &files)?;
    let known_before = losses.len();
    let readable = bag.messages().filter(|message| match message {
        // What the disk refuses now it may give later: this is no loss to accept.
        Ok(_) | Err(BagError::Io { .. }) => true,
        Err(damage) => {
            let damage = damage.to_string();
            if !losses[..known_before].contains(&damage) {
                losses.push(damage);
            }
            false
        }
    });
    let bag = copy(output, bag.channels(), readable, options)?;
    Ok(Recovered { bag, losses })
}
