//! Some topics of a bag, some of its time.

use std::path::Path;

use super::{CopyOptions, copy};
use crate::{error::BagError, messages::Selection, reader::BagReader, writer::BagSummary};

/// Copies the selected messages of a bag into a new one at `output`. All wanted topics are in it, also
/// those without a message.
///
/// # Errors
/// [`BagError::Exists`] when there is something at `output`; [`BagError::Nothing`] when no message
/// is selected; damage of the bag; what writing gives. There is then no new bag.
pub fn extract(
    bag: &BagReader,
    selection: &Selection,
    output: &Path,
    options: CopyOptions<'_>,
) -> Result<BagSummary, BagError> {
    let wanted = bag.channels().iter().filter(|channel| {
        selection.topics.as_ref().is_none_or(|topics| topics.contains(&channel.topic))
    });
    copy(output, wanted, bag.extras(), bag.select(selection), options)
}
