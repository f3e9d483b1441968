//! What a file says beside its messages: times and indexes of chunks, the summary section. A scan compares it with the messages.

use std::collections::{BTreeMap, BTreeSet};

use mcap::records::{AttachmentIndex, ChunkIndex, MetadataIndex, Record, Statistics, op};

use super::{
    index::{Declarations, FileIndex, Times, declared_twice, described_channel},
    records::{RecordHeader, compression},
};

/// Time and place of a message in its chunk (ns, bytes).
type Entry = (u64, u64);

/// The statements of one file, while it is scanned.
#[derive(Default)]
pub(super) struct Statements {
    chunk: Option<LastChunk>,
    /// Messages of each id of a channel.
    counts: BTreeMap<u16, u64>,
    /// The schemas and channels in the summary section.
    declared: Declarations,
    /// Each with the position of its record.
    chunk_indexes: Vec<(u64, ChunkIndex)>,
    statistics: Option<(u64, Statistics)>,
    auxiliary: Vec<(u64, AuxiliaryPlace)>,
}

/// What the summary section says otherwise than the data section: position, found, expected.
type Difference = (u64, String, String);

/// Where an index says that an attachment or a metadata record is: opcode, position, length.
type AuxiliaryPlace = (u8, u64, u64);

/// A chunk whose message indexes are being read.
#[derive(Default)]
pub(super) struct LastChunk {
    position: u64,
    /// Times that the chunk states.
    stated: Times,
    /// By the id of their channel.
    messages: BTreeMap<u16, Vec<Entry>>,
    indexed: BTreeMap<u16, Vec<Entry>>,
    has_index: bool,
}

impl LastChunk {
    pub(super) fn new(position: u64, stated: Times) -> Self {
        Self { position, stated, ..Self::default() }
    }

    pub(super) fn add_message(&mut self, channel: u16, time: u64, place: u64) {
        self.messages.entry(channel).or_default().push((time, place));
    }
}

impl Statements {
    /// A chunk that was read, before its message indexes.
    pub(super) fn begin_chunk(&mut self, chunk: LastChunk) {
        for (channel, messages) in &chunk.messages {
            self.count(*channel, messages.len() as u64);
        }
        self.chunk = Some(chunk);
    }

    /// Counts messages of a channel.
    pub(super) fn count(&mut self, channel: u16, messages: u64) {
        *self.counts.entry(channel).or_insert(0) += messages;
    }

    /// Adds a message index behind the last chunk.
    pub(super) fn index(&mut self, index: &mcap::records::MessageIndex) {
        if let Some(chunk) = &mut self.chunk {
            let entries = index.records.iter().map(|entry| (entry.log_time, entry.offset));
            chunk.indexed.entry(index.channel_id).or_default().extend(entries);
            chunk.has_index = true;
        }
    }

    /// Whether a record of the summary section is one that [`Statements::add`] takes.
    pub(super) fn takes(opcode: u8) -> bool {
        matches!(
            opcode,
            op::SCHEMA
                | op::CHANNEL
                | op::STATISTICS
                | op::CHUNK_INDEX
                | op::ATTACHMENT_INDEX
                | op::METADATA_INDEX
        )
    }

    /// Adds a record of the summary section.
    pub(super) fn add(&mut self, position: u64, record: Record<'_>, index: &mut FileIndex) {
        match record {
            Record::Schema { .. } | Record::Channel(_) => {
                if let Ok(Some(replaced)) = self.declared.declare(&record) {
                    let found = format!("{replaced} and another content of its id");
                    index.add_contradiction(position, found, ONE_CONTENT.into());
                }
            }
            Record::Statistics(statistics) => self.statistics = Some((position, statistics)),
            Record::ChunkIndex(chunk) => self.chunk_indexes.push((position, chunk)),
            Record::AttachmentIndex(AttachmentIndex { offset, length, .. }) => {
                self.auxiliary.push((position, (op::ATTACHMENT, offset, length)));
            }
            Record::MetadataIndex(MetadataIndex { offset, length, .. }) => {
                self.auxiliary.push((position, (op::METADATA, offset, length)));
            }
            _ => {}
        }
    }

    /// Compares the last chunk with its messages, after its message indexes.
    pub(super) fn end_chunk(&mut self, index: &mut FileIndex) {
        let Some(chunk) = self.chunk.take() else { return };
        let LastChunk { position, stated, messages, mut indexed, has_index } = chunk;
        let times = messages.values().flatten().map(|(time, _)| *time);
        if let (Some(first), Some(last)) = (times.clone().min(), times.max())
            && stated != (first, last)
        {
            let found = format!("a chunk with times from {} to {} ns", stated.0, stated.1);
            index.add_contradiction(position, found, of_messages((first, last)));
        }
        if !has_index {
            return;
        }
        for (channel, mut messages) in messages {
            let mut entries = indexed.remove(&channel).unwrap_or_default();
            messages.sort_unstable();
            entries.sort_unstable();
            if entries.len() != messages.len() {
                let (found, expected) = (entries.len(), messages.len());
                let found = format!("{found} messages in the index of channel {channel}");
                index.add_contradiction(position, found, format!("the {expected} of the chunk"));
            } else if entries != messages {
                let found = format!("other times or places in the index of channel {channel}");
                index.add_contradiction(position, found, "those of the messages".into());
            }
        }
        for (channel, entries) in indexed.into_iter().filter(|(_, entries)| !entries.is_empty()) {
            let found = format!("{} messages in the index of channel {channel}", entries.len());
            index.add_contradiction(position, found, "the 0 of the chunk".into());
        }
    }

    /// Compares the summary section with the data section, which is undamaged.
    pub(super) fn end(mut self, index: &mut FileIndex) {
        self.end_chunk(index);
        for (position, found, expected) in self.differences(index) {
            index.add_contradiction(position, found, expected);
        }
    }

    fn differences(&self, index: &FileIndex) -> Vec<Difference> {
        let mut differences = self.channel_differences(index);
        differences.extend(self.chunk_differences(index));
        differences.extend(self.statistics_differences(index));
        differences.extend(self.auxiliary_differences(index));
        differences
    }

    fn channel_differences(&self, index: &FileIndex) -> Vec<Difference> {
        let mut differences = Vec::new();
        let data = &index.declared;
        for (&id, of_summary) in &self.declared.channels {
            if let Some(of_data) = data.channels.get(&id).filter(|of_data| *of_data != of_summary) {
                let (found, data) =
                    (described_channel(id, of_summary), described_channel(id, of_data));
                let position = index.size;
                differences.push((position, declared_twice(&found, &data), ONE_CONTENT.into()));
            }
        }
        differences
    }

    fn chunk_differences(&self, index: &FileIndex) -> Vec<Difference> {
        let mut differences = Vec::new();
        let chunks: BTreeMap<u64, &ChunkIndex> =
            index.chunks.iter().map(|chunk| (chunk.chunk_start_offset, chunk)).collect();
        let with_messages: BTreeSet<u64> =
            index.contents.iter().map(|contents| contents.position).collect();
        for (position, stated) in &self.chunk_indexes {
            let start = stated.chunk_start_offset;
            let difference = match chunks.get(&start) {
                Some(chunk) => difference_of(stated, chunk, with_messages.contains(&start)),
                None => Some(("the index of a chunk".into(), "a chunk there".into())),
            };
            if let Some((found, expected)) = difference {
                let found = format!("index of the chunk at byte {start}: {found}");
                differences.push((*position, found, expected));
            }
        }
        differences
    }

    /// Differences of the statistics record, and of the number of chunk indexes.
    fn statistics_differences(&self, index: &FileIndex) -> Vec<Difference> {
        let mut differences = Vec::new();
        let mut number = |position: u64, what: &str, found: u64, expected: u64| {
            if found != expected {
                let found = format!("statistics: {what}: {found}");
                differences.push((position, found, format!("{expected} as in the data section")));
            }
        };
        let chunks: BTreeSet<u64> =
            index.chunks.iter().map(|chunk| chunk.chunk_start_offset).collect();
        let chunks = chunks.len() as u64;
        if let Some((position, _)) = self.chunk_indexes.first() {
            number(*position, "chunk indexes", self.chunk_indexes.len() as u64, chunks);
        }
        let Some((position, statistics)) = &self.statistics else { return differences };
        let total = self.counts.values().sum();
        number(*position, "message_count", statistics.message_count, total);
        let of_channel = &statistics.channel_message_counts;
        let others = of_channel.keys().filter(|id| !self.counts.contains_key(*id));
        for channel in self.counts.keys().chain(others) {
            // Some writers leave them out.
            if let Some(found) = of_channel.get(channel).or((!of_channel.is_empty()).then_some(&0))
            {
                let expected = self.counts.get(channel).copied().unwrap_or_default();
                number(*position, &format!("messages of channel {channel}"), *found, expected);
            }
        }
        number(*position, "chunk_count", statistics.chunk_count.into(), chunks);
        for (what, found, opcode) in [
            ("attachment_count", statistics.attachment_count, op::ATTACHMENT),
            ("metadata_count", statistics.metadata_count, op::METADATA),
        ] {
            let records = index.auxiliary.iter().filter(|record| record.opcode == opcode);
            number(*position, what, found.into(), records.count() as u64);
        }
        if let Some((first, last)) = index.times {
            number(*position, "message_start_time", statistics.message_start_time, first);
            number(*position, "message_end_time", statistics.message_end_time, last);
        }
        differences
    }

    /// Differences of the indexes of attachments and metadata.
    fn auxiliary_differences(&self, index: &FileIndex) -> Vec<Difference> {
        let mut differences = Vec::new();
        for (position, (opcode, offset, length)) in &self.auxiliary {
            let is_there = |record: &RecordHeader| {
                record.opcode == *opcode
                    && record.position == *offset
                    && record.end() - record.position == *length
            };
            if !index.auxiliary.iter().any(is_there) {
                let found = format!("index of a record of {length} bytes at byte {offset}");
                let expected = "an attachment or metadata record there".to_owned();
                differences.push((*position, found, expected));
            }
        }
        differences
    }
}

/// What is expected of schemas and channels.
pub(super) const ONE_CONTENT: &str =
    "one content for each id; `eddy bag recover` gives each its own";

fn of_messages((first, last): Times) -> String {
    format!("{first} to {last} ns, the times of its messages")
}

/// The first field in which a chunk index differs from its chunk.
fn difference_of(
    stated: &ChunkIndex,
    chunk: &ChunkIndex,
    has_messages: bool,
) -> Option<(String, String)> {
    let fields = [
        ("chunk_length", stated.chunk_length, chunk.chunk_length),
        ("message_index_length", stated.message_index_length, chunk.message_index_length),
        ("compressed_size", stated.compressed_size, chunk.compressed_size),
        ("uncompressed_size", stated.uncompressed_size, chunk.uncompressed_size),
    ];
    let differs = fields.into_iter().find(|(_, stated, found)| stated != found);
    if let Some((field, stated, found)) = differs {
        return Some((format!("{field} {stated}"), found.to_string()));
    }
    let times = |of: &ChunkIndex| (of.message_start_time, of.message_end_time);
    if has_messages && times(stated) != times(chunk) {
        let (first, last) = times(stated);
        return Some((format!("times from {first} to {last} ns"), of_messages(times(chunk))));
    }
    if stated.message_index_offsets != chunk.message_index_offsets {
        return Some(("other message_index_offsets".into(), "those of its message indexes".into()));
    }
    (compression(&stated.compression) != chunk.compression).then(|| {
        let quoted = |name: &str| format!("`{}`", name.escape_debug());
        (format!("compression {}", quoted(&stated.compression)), quoted(&chunk.compression))
    })
}
