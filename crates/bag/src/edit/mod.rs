//! Bags made of bags. Messages pass through one after the other, with their bytes, numbers and both
//! times as they are, and so do the descriptions of their topics. Attachments and metadata records all go
//! with them, whatever is chosen of the messages; only not what rosbag2 noted about the old file.
//!
//! 1. `choice`: which topics are wanted, by name and by pattern.
//! 2. `moment`: a moment of a bag, as people write it.
//! 3. `extract`: some topics of a bag, some of its time.
//! 4. `merge`: several bags as one, in the order of time.
//! 5. `recover`: what can be read of a damaged bag.
//! 6. `clouds`: frames also as point clouds.
//! 7. `reindex`: summaries and `metadata.yaml` of the files that are there.

mod choice;
mod clouds;
mod extract;
mod merge;
mod moment;
mod recover;
mod reindex;

pub use choice::TopicChoice;
pub use clouds::{clouds, without_cloud};
pub use extract::extract;
pub use merge::merge;
pub use moment::{InvalidMoment, Moment};
pub use recover::{Recovered, Recovery};
pub use reindex::{Reindexed, Reindexing};

use std::{path::Path, sync::Arc};

use super::{
    channel::Channel,
    draft::Draft,
    error::BagError,
    extra::{Extra, Written},
    messages::BagMessage,
    writer::{BagSummary, WriterOptions},
};

/// How a copy is made.
pub struct CopyOptions<'a> {
    /// How the new bag is written.
    pub writer: WriterOptions,
    /// Called after each message; `false` ends the work with [`BagError::Interrupted`].
    pub go_on: &'a mut dyn FnMut() -> bool,
}

/// Writes channels, extras and messages into a new bag at `output`, which appears when it is whole.
fn copy<'c>(
    output: &Path,
    channels: impl IntoIterator<Item = &'c Arc<Channel>>,
    extras: impl IntoIterator<Item = Result<Extra, BagError>>,
    messages: impl Iterator<Item = Result<BagMessage, BagError>>,
    options: CopyOptions<'_>,
) -> Result<BagSummary, BagError> {
    let mut draft = Draft::begin(output, options.writer)?;
    for channel in channels {
        draft.writer.channel(channel)?;
    }
    let mut written = Written::default();
    for extra in extras {
        let extra = extra?;
        if extra.is_about_what_was_recorded() && written.add(&extra) {
            draft.writer.attach(&extra)?;
        }
    }
    for message in messages {
        let message = message?;
        let topic = draft.writer.channel(&message.channel)?;
        draft.writer.copy(topic, &message)?;
        if !(options.go_on)() {
            return Err(BagError::Interrupted { path: output.into() });
        }
    }
    if draft.writer.messages() == 0 {
        return Err(BagError::Nothing { path: output.into() });
    }
    draft.deliver(output)
}
