//! The messages that publishers have kept at a moment for subscribers that come later.
//!
//! Blocks are read from the latest to the earliest, and only those that may hold one of the messages.

use std::cmp::Reverse;

use mcap::records::Record;

use super::{
    block::{Block, ChannelKeys, unknown_channel},
    contents::{Contents, FileChannel, TopicInfo},
    messages::BagMessage,
};
use crate::error::BagError;
use eddy_frames::Stamp;

/// As [`BagReader::kept_at`](super::reader::BagReader::kept_at).
pub(super) fn kept_at(
    contents: &Contents,
    at: Stamp,
    depth_of: impl Fn(&TopicInfo) -> usize,
) -> Vec<Result<BagMessage, BagError>> {
    let Ok(at) = u64::try_from(at.0) else { return Vec::new() };
    let depths = contents.topics.iter().map(|topic| Kept::new(depth_of(topic), topic));
    let mut topics: Vec<Kept> = depths.collect();
    let files = contents.files.iter();
    let mut blocks: Vec<&Block> =
        files.flat_map(|file| &file.blocks).filter(|block| block.first < at).collect();
    blocks.sort_by_key(|block| Reverse((block.last, block.file, block.position)));
    let mut errors = Vec::new();
    for block in blocks {
        let channels = &contents.channels[block.file];
        let is_wanted = |channel: &FileChannel| topics[channel.topic].is_wanted(block.last);
        let holds_wanted = match &block.channels {
            Some(ids) => ids.iter().filter_map(|id| channels.get(id)).any(is_wanted),
            None => channels.values().any(is_wanted),
        };
        if !holds_wanted {
            continue;
        }
        let mut number = 0;
        let file = &contents.files[block.file];
        let mut keys = ChannelKeys::of(block);
        let outcome = block.read(&file.path, &file.file, None, |_, record| {
            keys.next_record();
            let Record::Message { header, data } = record else {
                return if file.scanned { Ok(()) } else { file.declared.check(&record) };
            };
            number += 1;
            let FileChannel { topic, channel } = channels
                .get(&keys.key(header.channel_id))
                .ok_or_else(|| unknown_channel(header.channel_id))?;
            if header.log_time < at && topics[*topic].depth > 0 {
                let names = &contents.names[*topic];
                let message = BagMessage::of(names, channel, &header, data.into_owned())?;
                let place = (header.log_time, block.file, block.position, number);
                topics[*topic].add(place, message);
            }
            Ok(())
        });
        errors.extend(outcome.err().map(Err));
    }
    let mut kept: Vec<_> = topics.into_iter().flat_map(|topic| topic.messages).collect();
    kept.sort_by_key(|(place, _)| *place);
    kept.into_iter().map(|(_, message)| Ok(message)).chain(errors).collect()
}

/// Log time, file, position of the block, number in the block: the order of messages.
type Place = (u64, usize, u64, usize);

/// The messages of a topic that were found.
struct Kept {
    /// How many are kept.
    depth: usize,
    /// How many there are in the bag.
    total: u64,
    /// How many were found, kept or not.
    found: u64,
    /// In order.
    messages: Vec<(Place, BagMessage)>,
}

impl Kept {
    fn new(depth: usize, topic: &TopicInfo) -> Self {
        Self { depth, total: topic.message_count, found: 0, messages: Vec::new() }
    }

    /// Whether a message up to log time `last` may be among the kept ones.
    fn is_wanted(&self, last: u64) -> bool {
        let oldest = self.messages.first().map_or(0, |((time, ..), _)| *time);
        let is_full = self.messages.len() >= self.depth && oldest > last;
        self.depth > 0 && self.found < self.total && !is_full
    }

    fn add(&mut self, place: Place, message: BagMessage) {
        self.found += 1;
        let index = self.messages.partition_point(|(other, _)| *other < place);
        self.messages.insert(index, (place, message));
        if self.messages.len() > self.depth {
            self.messages.remove(0);
        }
    }
}
