//! Copies selected topics and times of a bag.

use std::path::Path;

use super::copy::{CopyOptions, copy, recording_of};
use crate::{
    error::BagError,
    format::summary::BagSummary,
    read::{
        messages::{BagMessage, Selection},
        reader::BagReader,
    },
};

/// Copies the selected messages of a bag into a new one at `output`, which has all selected topics, also those
/// without messages.
///
/// Before the first of them come the messages that transient-local publishers had kept at the start of the selection, such
/// as that of `/robot_description`, since a bag from there on is of little use without. Their log time is the start, so
/// that the new bag begins there; their publish time stays.
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
    let is_selected =
        |topic: &String| selection.topics.as_ref().is_none_or(|topics| topics.contains(topic));
    let selected = bag.channels().iter().filter(|channel| is_selected(&channel.topic));
    let mut messages = bag.select(selection).peekable();
    let kept = selection.from.filter(|_| messages.peek().is_some()).map(|start| {
        let kept = bag.kept_at(start, |topic| match is_selected(&topic.name) {
            true => topic.kept(),
            false => 0,
        });
        kept.into_iter()
            .map(move |message| message.map(|message| BagMessage { log_time: start, ..message }))
    });
    let messages = kept.into_iter().flatten().chain(messages);
    copy(output, selected, recording_of(bag), messages, options)
}
