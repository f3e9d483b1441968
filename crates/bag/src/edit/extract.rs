//! Copies selected topics and times of a bag.

use std::path::Path;

use super::copy::{CopyOptions, copy, recording_of};
use crate::{
    error::BagError,
    format::summary::BagSummary,
    read::{messages::Selection, reader::BagReader},
};

/// Copies the selected messages of a bag into a new one at `output`, which has all selected topics, also those
/// without messages.
///
/// # Errors
/// [`BagError::Exists`] when `output` exists; [`BagError::Nothing`] when no message is selected; damage of the
/// bag; errors of the writer. On error no new bag is left behind.
pub fn extract(
    bag: &BagReader,
    selection: &Selection,
    output: &Path,
    options: CopyOptions<'_>,
) -> Result<BagSummary, BagError> {
    let selected = bag.channels().iter().filter(|channel| {
        selection.topics.as_ref().is_none_or(|topics| topics.contains(&channel.topic))
    });
    copy(output, selected, recording_of(bag), bag.select(selection), options)
}
