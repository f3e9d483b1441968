//! The messages of all files of a bag, merged by log time. One block is in memory at a time, several where their
//! times overlap; of a bag in a store, the next few are prefetched.

use std::{collections::VecDeque, sync::Arc};

use eddy_storage::Prefetched;
use mcap::records::{MessageHeader, Record};

use super::{
    block::{Block, ChannelKeys, unknown_channel},
    contents::{Contents, FileChannel, TopicNames},
    error_log::ErrorLog,
};
use crate::{error::BagError, format::channel::Channel};
use eddy_frames::Stamp;

/// Blocks of a bag in a store that are prefetched: with blocks of 1 MiB and 50 ms a request, 80 MiB/s.
const PREFETCHED_BLOCKS: usize = 4;

/// A message of a bag.
#[derive(Clone, Debug, PartialEq)]
pub struct BagMessage {
    /// Name of the topic.
    pub topic: Arc<str>,
    /// Name of its type, such as `eddy_msgs/msg/ParticleFrame`.
    pub type_name: Arc<str>,
    /// Sequence number from the writer; 0 if it does not count.
    pub sequence: u32,
    /// Time of reception.
    pub log_time: Stamp,
    /// Time of publication.
    pub publish_time: Stamp,
    /// CDR with its 4-byte header, unchecked.
    pub data: Vec<u8>,
    /// The channel of the message.
    pub channel: Arc<Channel>,
}

impl BagMessage {
    /// A message as it is in a file.
    ///
    /// # Errors
    /// Which time is beyond the range of ROS.
    pub(super) fn of(
        topic: &TopicNames,
        channel: &Arc<Channel>,
        header: &MessageHeader,
        data: Vec<u8>,
    ) -> Result<Self, String> {
        Ok(Self {
            topic: topic.name.clone(),
            type_name: topic.type_name.clone(),
            sequence: header.sequence,
            log_time: stamp("log_time", header.log_time)?,
            publish_time: stamp("publish_time", header.publish_time)?,
            data,
            channel: Arc::clone(channel),
        })
    }
}

/// Selects messages of a bag.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Selection {
    /// Only these topics; all if `None`.
    pub topics: Option<Vec<String>>,
    /// Smallest log time; no limit if `None`.
    pub from: Option<Stamp>,
    /// Largest log time, inclusive; no limit if `None`.
    pub until: Option<Stamp>,
}

/// The messages of a bag in the order of their log time; equal times in the order of the files.
///
/// In a damaged bag, all intact messages come first, then the first errors, then [`BagError::MoreErrors`] if
/// there are more.
#[derive(Debug)]
pub struct Messages {
    contents: Arc<Contents>,
    /// Whether each topic is selected.
    selected: Vec<bool>,
    from: u64,
    until: u64,
    /// Blocks not read yet, in the order of their first message.
    pending: VecDeque<Block>,
    /// Prefetches of the first pending blocks, for a bag in a store.
    prefetched: VecDeque<Option<Prefetched>>,
    /// Messages of the blocks that were read, in order.
    ready: VecDeque<BagMessage>,
    /// Returned after the messages.
    errors: ErrorLog<BagError>,
}

impl Messages {
    pub(super) fn new(contents: Arc<Contents>, selection: &Selection) -> Self {
        let selected = contents
            .topics
            .iter()
            .map(|topic| selection.topics.as_ref().is_none_or(|names| names.contains(&topic.name)))
            .collect();
        let limit = |time: Option<Stamp>, none: u64| {
            time.map_or(none, |Stamp(time)| u64::try_from(time).unwrap_or_default())
        };
        let before_all = selection.until.is_some_and(|until| until < Stamp(0));
        let (from, until) = (limit(selection.from, 0), limit(selection.until, u64::MAX));
        let mut pending: Vec<Block> = contents
            .files
            .iter()
            .flat_map(|file| &file.blocks)
            .filter(|block| block.last >= from && block.first <= until && !before_all)
            .cloned()
            .collect();
        pending.sort_by_key(|block| (block.first, block.file, block.position));
        let (pending, ready) = (pending.into(), VecDeque::new());
        let mut errors = ErrorLog::default();
        for file in &contents.files {
            file.errors().for_each(|error| errors.push(error));
            errors.omit(file.damage.omitted());
        }
        let prefetched = VecDeque::new();
        Self { contents, selected, from, until, pending, prefetched, ready, errors }
    }

    /// Whether a pending block may contain a message before all that are ready.
    fn must_read_next(&self) -> bool {
        match (self.pending.front(), self.ready.front()) {
            (None, _) => false,
            (Some(_), None) => true,
            (Some(block), Some(message)) => {
                i64::try_from(block.first).is_ok_and(|first| Stamp(first) < message.log_time)
            }
        }
    }

    fn read_next(&mut self) {
        let Some(block) = self.pending.pop_front() else { return };
        let contents = self.contents.clone();
        let file = &contents.files[block.file];
        let prefetched = self.prefetched.pop_front().flatten();
        for next in self.pending.iter().take(PREFETCHED_BLOCKS).skip(self.prefetched.len()) {
            self.prefetched.push_back(next.prefetch(&contents.files[next.file].file));
        }
        let channels = &contents.channels[block.file];
        let ready = &mut self.ready;
        let ready_before = ready.len();
        let mut keys = ChannelKeys::of(&block);
        let outcome = block.read(&file.path, &file.file, prefetched, |_, record| {
            keys.next_record();
            let Record::Message { header, data } = record else {
                // A scan has found the ids that the file declares twice. Of other files only the summary section is known.
                return if file.scanned { Ok(()) } else { file.declared.check(&record) };
            };
            let FileChannel { topic, channel } = channels
                .get(&keys.key(header.channel_id))
                .ok_or_else(|| unknown_channel(header.channel_id))?;
            if !self.selected[*topic] || header.log_time < self.from || header.log_time > self.until
            {
                return Ok(());
            }
            let topic = &contents.names[*topic];
            ready.push_back(BagMessage::of(topic, channel, &header, data.into_owned())?);
            Ok(())
        });
        if ready.len() > ready_before {
            // Stable, and fast where both ranges are sorted.
            ready.make_contiguous().sort_by_key(|message| message.log_time);
        }
        match outcome {
            Ok(()) => {}
            // Errors of the system may be temporary, and must not be omitted in favour of damage.
            Err(error @ BagError::Io { .. }) => self.errors.push_front(error),
            Err(error) => self.errors.push(error),
        }
    }
}

/// MCAP's times are `u64`, those of ROS `i64`: a larger time is an error.
fn stamp(field: &str, time: u64) -> Result<Stamp, String> {
    i64::try_from(time)
        .map(Stamp)
        .map_err(|_| format!("{field} {time} ns, beyond the range of ROS"))
}

impl Iterator for Messages {
    type Item = Result<BagMessage, BagError>;

    fn next(&mut self) -> Option<Self::Item> {
        while self.must_read_next() {
            self.read_next();
        }
        match self.ready.pop_front() {
            Some(message) => Some(Ok(message)),
            None => self.errors.pop(&self.contents.path).map(Err),
        }
    }
}
