//! The index of a file: its channels, where its messages are, and what is damaged.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
    sync::Arc,
};

use eddy_storage::File;
use mcap::{
    MAGIC,
    records::{self, ChunkIndex, Record, SchemaHeader},
};

use super::{block::Block, error_log::ErrorLog, records::RecordHeader};
use crate::{
    error::BagError,
    format::channel::{Channel, Schema},
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
pub(super) type Times = (u64, u64);

/// The index of one file.
#[derive(Debug)]
pub(crate) struct FileIndex {
    pub(crate) path: PathBuf,
    pub(crate) file: File,
    /// Index of the file in the bag.
    pub(super) number: usize,
    /// Size of the file (bytes).
    pub(crate) size: u64,
    pub(crate) schemas: BTreeMap<u16, Arc<Schema>>,
    pub(crate) channels: BTreeMap<u16, Arc<Channel>>,
    /// Messages of each channel.
    pub(crate) counts: BTreeMap<u16, u64>,
    /// `None` without messages.
    pub(crate) times: Option<Times>,
    pub(super) blocks: Vec<Block>,
    /// Compressions of the chunks; empty for none.
    pub(super) compressions: BTreeSet<String>,
    pub(super) damage: ErrorLog<Damage>,
    /// Whether the index was read from the summary section.
    pub(crate) summarized: bool,
    /// Message count in the statistics record, if there is one.
    pub(crate) declared_messages: Option<u64>,
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
    pub(super) counts: BTreeMap<u16, u64>,
    pub(super) times: Times,
}

/// The smallest range that includes both.
pub(super) fn widen(times: Option<Times>, (first, last): Times) -> Times {
    times.map_or((first, last), |(before, after)| (before.min(first), after.max(last)))
}

/// Adds the messages of each channel to `counts`.
pub(super) fn add_counts(counts: &mut BTreeMap<u16, u64>, added: &BTreeMap<u16, u64>) {
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
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            counts: BTreeMap::new(),
            times: None,
            blocks: Vec::new(),
            compressions: BTreeSet::new(),
            damage: ErrorLog::default(),
            summarized: false,
            declared_messages: None,
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

    /// Adds a schema or a channel; ignores other records.
    ///
    /// # Errors
    /// The reason why the record is rejected.
    pub(super) fn declare(&mut self, record: &Record<'_>) -> Result<(), String> {
        match record {
            Record::Schema { header: SchemaHeader { id, name, encoding }, data } => {
                let (name, encoding) = (name.clone(), encoding.clone());
                let schema = Schema { name, encoding, data: data.to_vec() };
                self.schemas.insert(*id, Arc::new(schema));
            }
            Record::Channel(records::Channel {
                id,
                schema_id,
                topic,
                message_encoding,
                metadata,
            }) => {
                let schema = match (schema_id, self.schemas.get(schema_id)) {
                    (0, _) => None,
                    (_, Some(schema)) => Some(Arc::clone(schema)),
                    (_, None) => {
                        return Err(format!(
                            "channel {id} of topic {topic} with schema {schema_id}, which is not declared"
                        ));
                    }
                };
                let channel = Channel {
                    topic: topic.clone(),
                    schema,
                    encoding: message_encoding.clone(),
                    metadata: metadata.clone(),
                };
                self.channels.insert(*id, Arc::new(channel));
            }
            _ => {}
        }
        Ok(())
    }
}
