//! Copies channels, messages, attachments and metadata records into a new bag.

use std::{collections::BTreeMap, path::Path, sync::Arc};

use super::staged::StagedBag;
use crate::{
    error::BagError,
    format::{channel::Channel, summary::BagSummary},
    read::{
        auxiliary::{AuxiliaryRecord, Written},
        messages::BagMessage,
    },
    write::options::WriterOptions,
};

/// Options of a copy.
pub struct CopyOptions<'a> {
    /// Options of the new bag.
    pub writer: WriterOptions,
    /// Called after each message; `false` stops the copy with [`BagError::Interrupted`].
    pub on_message: &'a mut dyn FnMut() -> bool,
}

/// Writes a new bag at `output`, which appears when it is complete. What describes the recording is `custom_data`, and attachments and
/// metadata records.
pub(crate) fn copy<'c>(
    output: &Path,
    channels: impl IntoIterator<Item = &'c Arc<Channel>>,
    (custom_data, auxiliary): (
        BTreeMap<String, String>,
        impl IntoIterator<Item = Result<AuxiliaryRecord, BagError>>,
    ),
    messages: impl Iterator<Item = Result<BagMessage, BagError>>,
    options: CopyOptions<'_>,
) -> Result<BagSummary, BagError> {
    let mut bag = StagedBag::create(output, options.writer)?;
    for channel in channels {
        bag.writer.channel(channel)?;
    }
    for (key, value) in custom_data {
        bag.writer.set_custom_data(&key, value);
    }
    let mut written = Written::default();
    for record in auxiliary {
        let record = record?;
        if record.describes_recording() && written.insert(&record) {
            bag.writer.write_auxiliary(&record)?;
        }
    }
    for message in messages {
        let message = message?;
        let topic = bag.writer.channel(&message.channel)?;
        bag.writer.copy(topic, &message)?;
        if !(options.on_message)() {
            return Err(BagError::Interrupted { path: output.into() });
        }
    }
    if bag.writer.messages() == 0 {
        return Err(BagError::Nothing { path: output.into() });
    }
    bag.commit(output)
}
