//! The index of a file: its channels, where its messages are, and what is damaged.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
    sync::Arc,
};

use eddy_storage::File;
use mcap::{
    MAGIC,
    records::{self, ChunkIndex, Record, SchemaHeader, op},
};

use super::{
    block::Block,
    error_log::ErrorLog,
    records::{HEADER_SIZE, RecordHeader},
};
use crate::{
    error::BagError,
    format::{
        channel::{Channel, Schema},
        description::Description,
        parse,
    },
};

/// Called with the number of bytes read since the last call; `false` stops the operation.
pub(crate) type Progress<'a> = dyn FnMut(u64) -> bool + 'a;

/// Bytes between two calls of [`Progress`].
pub(crate) const PROGRESS_STEP: u64 = 1 << 20;

/// Damage that is found while a file is indexed.
#[derive(Clone, Debug)]
pub(super) enum Damage {
    /// The file is truncated.
    Truncated { size: u64, messages: u64, expected: String },
    /// A record is damaged.
    Corrupt { position: u64, found: String, expected: String },
}

impl Damage {
    /// As an error of the file at `path`.
    fn error(&self, path: &Path) -> BagError {
        let path = path.into();
        match self.clone() {
            Self::Truncated { size, messages, expected } => {
                BagError::Truncated { path, size, messages, expected }
            }
            Self::Corrupt { position, found, expected } => {
                BagError::Corrupt { path, position, found, expected }
            }
        }
    }
}

/// Smallest and largest log time (ns).
pub(crate) type Times = (u64, u64);

/// A channel of a file: its id, or a number beyond all ids for another content that the file declares for an id later on.
pub(crate) type ChannelKey = u32;

/// Channels and schemas by their ids, as declared in one place of a file.
#[derive(Clone, Debug, Default)]
pub(crate) struct Declarations {
    pub(crate) schemas: BTreeMap<u16, Arc<Schema>>,
    pub(crate) channels: BTreeMap<u16, Arc<Channel>>,
}

impl Declarations {
    /// Adds a schema or a channel; ignores other records. Returns the content that its id had before, if that was another one.
    ///
    /// # Errors
    /// The reason why the record is rejected.
    pub(super) fn declare(&mut self, record: &Record<'_>) -> Result<Option<String>, String> {
        let replaced = match record {
            Record::Schema { header: SchemaHeader { id, name, encoding }, data } => {
                let (name, encoding) = (name.clone(), encoding.clone());
                let schema = Arc::new(Schema { name, encoding, data: data.to_vec() });
                let before = self.schemas.insert(*id, Arc::clone(&schema));
                before.filter(|before| *before != schema).map(|before| {
                    let (name, id) = (before.name.escape_debug(), id);
                    format!("schema {id} of type {name}")
                })
            }
            Record::Channel(channel) => {
                let (id, channel) = (channel.id, Arc::new(self.channel(channel)?));
                let before = self.channels.insert(id, Arc::clone(&channel));
                before
                    .filter(|before| *before != channel)
                    .map(|before| described_channel(id, &before))
            }
            _ => None,
        };
        Ok(replaced)
    }

    /// A channel with its schema.
    fn channel(&self, channel: &records::Channel) -> Result<Channel, String> {
        let records::Channel { id, schema_id, topic, message_encoding, metadata } = channel;
        let schema = match (schema_id, self.schemas.get(schema_id)) {
            (0, _) => None,
            (_, Some(schema)) => Some(Arc::clone(schema)),
            (_, None) => {
                let topic = topic.escape_debug();
                return Err(format!(
                    "channel {id} of topic {topic} with schema {schema_id}, which is not declared"
                ));
            }
        };
        let (topic, encoding, metadata) =
            (topic.clone(), message_encoding.clone(), metadata.clone());
        Ok(Channel { topic, schema, encoding, metadata })
    }

    /// Checks a schema or a channel against the one with its id, if there is one; ignores other records.
    ///
    /// # Errors
    /// What the record says, and what is known of its id.
    pub(super) fn check(&self, record: &Record<'_>) -> Result<(), String> {
        match record {
            Record::Schema { header: SchemaHeader { id, name, encoding }, data } => {
                let known = self.schemas.get(id);
                let differs = known.filter(|known| {
                    known.name != *name || known.encoding != *encoding || known.data != **data
                });
                differs.map_or(Ok(()), |known| {
                    let (name, known) = (name.escape_debug(), known.name.escape_debug());
                    Err(format!("schema {id} of type {name}, elsewhere in the file one of {known} with another content"))
                })
            }
            Record::Channel(record) => {
                let found = self.channel(record)?;
                let known = self.channels.get(&record.id).filter(|known| ***known != found);
                known.map_or(Ok(()), |known| {
                    Err(declared_twice(
                        &described_channel(record.id, &found),
                        &described_channel(record.id, known),
                    ))
                })
            }
            _ => Ok(()),
        }
    }
}

/// A channel in an error message.
pub(super) fn described_channel(id: u16, channel: &Channel) -> String {
    let (topic, of) = (channel.topic.escape_debug(), channel.type_name().escape_debug());
    format!("channel {id} of topic {topic} ({of})")
}

/// Two contents of an id, in an error message.
pub(super) fn declared_twice(found: &str, elsewhere: &str) -> String {
    format!("{found}, elsewhere in the file {elsewhere} with another content")
}

/// Bytes in which the header of a file is expected.
const HEADER_LIMIT: u64 = 256;

/// The index of one file.
#[derive(Debug)]
pub(crate) struct FileIndex {
    pub(crate) path: PathBuf,
    pub(crate) file: File,
    /// Index of the file in the bag.
    pub(super) number: usize,
    /// Size of the file (bytes).
    pub(crate) size: u64,
    /// The schemas and channels, of each id the last one.
    pub(crate) declared: Declarations,
    /// All channels with messages or without: more than ids where an id was declared with several contents.
    pub(crate) channels: BTreeMap<ChannelKey, Arc<Channel>>,
    /// Messages of each channel.
    pub(crate) counts: BTreeMap<ChannelKey, u64>,
    /// `None` without messages.
    pub(crate) times: Option<Times>,
    pub(super) blocks: Vec<Block>,
    /// Compressions of the chunks; empty for none.
    pub(super) compressions: BTreeSet<String>,
    pub(super) damage: ErrorLog<Damage>,
    /// After a scan: what the file says twice, and differently. The messages themselves are what is read.
    pub(super) contradictions: ErrorLog<Damage>,
    /// Whether the summary section is usable: complete, and confirmed by the message indexes.
    pub(crate) summarized: bool,
    /// Whether the index comes from a scan.
    pub(crate) scanned: bool,
    /// Message count in the statistics record, if there is one.
    pub(crate) declared_messages: Option<u64>,
    /// What the metadata record of rosbag2 says.
    pub(crate) description: Description,
    /// The attachments and metadata records.
    pub(crate) auxiliary: Vec<RecordHeader>,
    /// After a scan: end of the last complete record of the data section (bytes).
    pub(crate) data_end: u64,
    /// After a scan: the readable chunks.
    pub(crate) chunks: Vec<ChunkIndex>,
    /// After a scan: contents of the blocks, in file order.
    pub(super) contents: Vec<BlockContents>,
}

/// The messages of a block.
#[derive(Debug)]
pub(super) struct BlockContents {
    /// Start of the block (bytes).
    pub(super) position: u64,
    /// Messages of each channel.
    pub(super) counts: BTreeMap<ChannelKey, u64>,
    pub(super) times: Times,
}

/// The smallest range that includes both.
pub(crate) fn widen(times: Option<Times>, (first, last): Times) -> Times {
    times.map_or((first, last), |(before, after)| (before.min(first), after.max(last)))
}

/// Adds the messages of each channel to `counts`.
pub(super) fn add_counts(
    counts: &mut BTreeMap<ChannelKey, u64>,
    added: &BTreeMap<ChannelKey, u64>,
) {
    for (channel, messages) in added {
        *counts.entry(*channel).or_insert(0) += messages;
    }
}

impl FileIndex {
    /// The empty index of file `number` of a bag.
    pub(super) fn new(path: &Path, number: usize, file: File) -> Self {
        Self {
            path: path.into(),
            number,
            size: file.size(),
            file,
            declared: Declarations::default(),
            channels: BTreeMap::new(),
            counts: BTreeMap::new(),
            times: None,
            blocks: Vec::new(),
            compressions: BTreeSet::new(),
            damage: ErrorLog::default(),
            contradictions: ErrorLog::default(),
            summarized: false,
            scanned: false,
            declared_messages: None,
            description: Description::default(),
            auxiliary: Vec::new(),
            data_end: MAGIC.len() as u64,
            chunks: Vec::new(),
            contents: Vec::new(),
        }
    }

    /// Removes everything at or after byte `end` from the index of a scanned file.
    pub(crate) fn truncate(&mut self, end: u64) {
        (self.size, self.data_end) = (end, end);
        self.blocks.retain(|block| block.position + block.length <= end);
        self.chunks.retain(|chunk| chunk.chunk_start_offset < end);
        self.auxiliary.retain(|record| record.position < end);
        self.contents.retain(|block| block.position < end);
        (self.counts, self.times) = (BTreeMap::new(), None);
        for BlockContents { counts, times, .. } in &self.contents {
            add_counts(&mut self.counts, counts);
            self.times = Some(widen(self.times, *times));
        }
    }

    /// Makes it file `number` of a bag.
    pub(crate) fn set_number(&mut self, number: usize) {
        self.number = number;
        self.blocks.iter_mut().for_each(|block| block.file = number);
    }

    /// Whether eddy has written the file, by the header at its start.
    pub(crate) fn is_written_by_eddy(&self) -> bool {
        let start = self.file.read(MAGIC.len() as u64, self.size.min(HEADER_LIMIT));
        start.is_ok_and(|start| {
            let body = start.get(HEADER_SIZE as usize..).unwrap_or_default();
            let header = parse::record(op::HEADER, body);
            matches!(header, Ok(Record::Header(header)) if header.library.starts_with("eddy "))
        })
    }

    /// The damage of the file, as errors.
    pub(crate) fn errors(&self) -> impl Iterator<Item = BagError> {
        self.damage.iter().map(|damage| damage.error(&self.path))
    }

    /// Number of messages.
    pub(crate) fn messages(&self) -> u64 {
        self.counts.values().sum()
    }

    pub(super) fn add_damage(&mut self, position: u64, found: String, expected: String) {
        self.damage.push(Damage::Corrupt { position, found, expected });
    }

    /// What the file says twice, and differently, as errors; then the number of those that are not listed.
    pub(crate) fn contradictions(&self) -> (impl Iterator<Item = BagError>, u64) {
        let listed = self.contradictions.iter().map(|found| found.error(&self.path));
        (listed, self.contradictions.omitted())
    }

    /// Whether an id of a channel has several contents, which a summary section cannot say.
    pub(crate) fn has_ambiguous_ids(&self) -> bool {
        self.channels.keys().any(|key| u16::try_from(*key).is_err())
    }

    pub(super) fn add_contradiction(&mut self, position: u64, found: String, expected: String) {
        self.contradictions.push(Damage::Corrupt { position, found, expected });
    }
}
