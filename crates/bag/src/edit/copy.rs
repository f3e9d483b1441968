//! Copies channels, messages, attachments and metadata records into a new bag.

use std::{path::Path, sync::Arc};

use super::staged::StagedBag;
use crate::{
    error::BagError,
    format::{
        channel::Channel,
        custom_data::{CustomData, LOSSES},
        summary::BagSummary,
    },
    read::{
        auxiliary::{AuxiliaryRecord, Written},
        messages::BagMessage,
        reader::BagReader,
    },
    write::options::WriterOptions,
};

/// Options of a copy.
pub struct CopyOptions<'a> {
    /// Options of the new bag.
    pub writer: WriterOptions,
    /// Entries to set in its `custom_data`, beside those of the old bags.
    pub custom_data: CustomData,
    /// Called after each message; `false` stops the copy with [`BagError::Interrupted`].
    pub on_message: &'a mut dyn FnMut() -> bool,
}

/// What describes a recording, beside its messages.
pub(crate) struct Recording<A> {
    /// Entries of `custom_data` in `metadata.yaml`; [`LOSSES`] are left out of copies.
    pub(crate) custom_data: CustomData,
    /// Distribution of ROS that recorded the messages; empty if unknown.
    pub(crate) distro: String,
    /// Attachments and metadata records.
    pub(crate) auxiliary: A,
}

/// The recording that a bag holds.
pub(crate) fn recording_of(
    bag: &BagReader,
) -> Recording<impl Iterator<Item = Result<AuxiliaryRecord, BagError>>> {
    let (custom_data, distro) = (bag.custom_data().clone(), bag.distro().to_owned());
    Recording { custom_data, distro, auxiliary: bag.auxiliary() }
}

/// Writes a new bag at `output`, which appears when it is complete.
pub(crate) fn copy<'c>(
    output: &Path,
    channels: impl IntoIterator<Item = &'c Arc<Channel>>,
    Recording { mut custom_data, distro, auxiliary }: Recording<
        impl IntoIterator<Item = Result<AuxiliaryRecord, BagError>>,
    >,
    messages: impl Iterator<Item = Result<BagMessage, BagError>>,
    options: CopyOptions<'_>,
) -> Result<BagSummary, BagError> {
    let mut bag = StagedBag::create(output, options.writer)?;
    for channel in channels {
        bag.writer.channel(channel)?;
    }
    custom_data.retain(|key, _| !LOSSES.contains(&key.as_str()));
    custom_data.extend(options.custom_data);
    bag.writer.extend_custom_data(custom_data);
    bag.writer.set_distro(distro);
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
