//! Where the messages of a file lie: from its summary if it has a usable one, else by a walk
//! through the whole file, which also tells how it ends.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::File,
    io::Read,
    path::{Path, PathBuf},
    sync::Arc,
};

use mcap::{
    MAGIC, parse_record,
    records::{self, ChunkIndex, Record, SchemaHeader, Statistics, op},
};

use super::{
    channel::{Channel, Schema},
    error::BagError,
    record::{self, Records, SIZE_LIMIT, Step},
    segment::{Kind, Segment},
};

/// What is wrong with a file as far as its index tells.
#[derive(Clone, Debug)]
pub(super) enum Damage {
    /// It ends too early.
    Truncated { size: u64, messages: u64, expected: String },
    /// Bytes are not what they should be.
    Corrupt { position: u64, found: String, expected: String },
}

impl Damage {
    /// As an error about the file at `path`.
    pub(super) fn error(&self, path: &Path) -> BagError {
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

/// Where the messages of one file lie.
#[derive(Debug)]
pub(super) struct FileIndex {
    pub(super) path: PathBuf,
    /// Length of the file (bytes).
    pub(super) size: u64,
    pub(super) schemas: BTreeMap<u16, Arc<Schema>>,
    pub(super) channels: BTreeMap<u16, Arc<Channel>>,
    /// Messages, by channel.
    pub(super) counts: BTreeMap<u16, u64>,
    /// Smallest and largest log time (ns), if there is a message.
    pub(super) times: Option<(u64, u64)>,
    pub(super) segments: Vec<Segment>,
    /// Names of the compressions of its chunks; empty for none.
    pub(super) compressions: BTreeSet<String>,
    pub(super) damage: Option<Damage>,
    /// Whether all this is from the file's own summary.
    pub(super) summarized: bool,
    /// If it was walked through: the end of its last whole record before the summary (bytes).
    pub(super) data_end: u64,
    /// If it was walked through: its readable chunks as a summary lists them.
    pub(super) chunks: Vec<ChunkIndex>,
    /// If it was walked through: its attachments and its metadata records.
    pub(super) extras: (u32, u32),
}

impl FileIndex {
    /// Indexes the file, number `number` of its bag.
    ///
    /// # Errors
    /// [`BagError::Io`], and [`BagError::Magic`] when it is no MCAP file. Damage behind the first
    /// bytes is no error but noted in the index.
    pub(super) fn open(path: &Path, number: usize) -> Result<Self, BagError> {
        let failed = |reason| BagError::Io { path: path.into(), action: "reading", reason };
        let mut file = File::open(path).map_err(BagError::io(path, "opening the file"))?;
        let size = file.metadata().map_err(failed)?.len();
        let mut magic = Vec::new();
        file.by_ref().take(MAGIC.len() as u64).read_to_end(&mut magic).map_err(failed)?;
        if !MAGIC.starts_with(&magic) {
            return Err(BagError::Magic { path: path.into(), found: magic });
        }
        let start = record::summary_start(&mut file, size).map_err(failed)?;
        if let Some(start) = start {
            let records = Records::new(file.try_clone().map_err(failed)?, size, start);
            let index = Builder::new(path, number, size).of_summary(records);
            if let Some(index) = index.map_err(failed)? {
                return Ok(index);
            }
        }
        let records = Records::new(file, size, magic.len() as u64);
        Builder::new(path, number, size).by_walking(records)
    }

    /// Indexes the file by walking through it, whatever its summary says.
    ///
    /// # Errors
    /// [`BagError::Io`].
    pub(super) fn walk(path: &Path) -> Result<Self, BagError> {
        let failed = |reason| BagError::Io { path: path.into(), action: "reading", reason };
        let file = File::open(path).map_err(BagError::io(path, "opening the file"))?;
        let size = file.metadata().map_err(failed)?.len();
        Builder::new(path, 0, size).by_walking(Records::new(file, size, MAGIC.len() as u64))
    }

    /// How many messages it has.
    pub(super) fn messages(&self) -> u64 {
        self.counts.values().sum()
    }
}

/// An index while it is being made.
pub(super) struct Builder {
    pub(super) index: FileIndex,
    /// Number of the file in its bag.
    pub(super) number: usize,
}

impl Builder {
    fn new(path: &Path, number: usize, size: u64) -> Self {
        let index = FileIndex {
            path: path.into(),
            size,
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            counts: BTreeMap::new(),
            times: None,
            segments: Vec::new(),
            compressions: BTreeSet::new(),
            damage: None,
            summarized: false,
            data_end: MAGIC.len() as u64,
            chunks: Vec::new(),
            extras: (0, 0),
        };
        Self { index, number }
    }

    /// The index in the file's summary; `None` when it lacks a part that is needed or contradicts
    /// itself: files may have no statistics, no chunk indexes, or messages outside chunks.
    fn of_summary(mut self, mut records: Records) -> std::io::Result<Option<FileIndex>> {
        let (mut statistics, mut chunks) = (None, Vec::new());
        while let Step::Record(header) = records.step()? {
            if header.opcode == op::FOOTER {
                break;
            }
            if !matches!(header.opcode, op::SCHEMA | op::CHANNEL | op::STATISTICS | op::CHUNK_INDEX)
                || header.length > SIZE_LIMIT
            {
                continue;
            }
            let body = records.read(&header)?;
            match parse_record(header.opcode, &body) {
                Ok(Record::Statistics(found)) => statistics = Some(found),
                Ok(Record::ChunkIndex(chunk)) => chunks.push(chunk),
                Ok(record) if self.declare(&record).is_ok() => {}
                _ => return Ok(None),
            }
        }
        Ok(statistics.and_then(|statistics| self.assemble(statistics, &chunks)))
    }

    fn assemble(mut self, statistics: Statistics, chunks: &[ChunkIndex]) -> Option<FileIndex> {
        let counts = statistics.channel_message_counts;
        let complete = chunks.len() == statistics.chunk_count as usize
            && self.index.channels.len() == statistics.channel_count as usize
            && counts.keys().all(|channel| self.index.channels.contains_key(channel))
            && counts.values().sum::<u64>() == statistics.message_count
            && (!chunks.is_empty() || statistics.message_count == 0);
        if !complete {
            return None;
        }
        for chunk in chunks {
            let (position, length) = (chunk.chunk_start_offset, chunk.chunk_length);
            let inside = position.checked_add(length).is_some_and(|end| end <= self.index.size);
            if !inside {
                return None;
            }
            self.index.compressions.insert(chunk.compression.clone());
            self.index.segments.push(Segment {
                file: self.number,
                position,
                length,
                kind: Kind::Chunk,
                first: chunk.message_start_time,
                last: chunk.message_end_time,
            });
        }
        self.index.counts = counts;
        self.index.times = (statistics.message_count > 0)
            .then_some((statistics.message_start_time, statistics.message_end_time));
        self.index.summarized = true;
        Some(self.index)
    }

    /// Notes a schema or a channel.
    pub(super) fn declare(&mut self, record: &Record<'_>) -> Result<(), String> {
        match record {
            Record::Schema { header: SchemaHeader { id, name, encoding }, data } => {
                let (name, encoding) = (name.clone(), encoding.clone());
                let schema = Schema { name, encoding, data: data.to_vec() };
                self.index.schemas.insert(*id, Arc::new(schema));
            }
            Record::Channel(records::Channel {
                id,
                schema_id,
                topic,
                message_encoding,
                metadata,
            }) => {
                let schema = match (schema_id, self.index.schemas.get(schema_id)) {
                    (0, _) => None,
                    (_, Some(schema)) => Some(Arc::clone(schema)),
                    (_, None) => {
                        return Err(format!(
                            "channel {id} of topic {topic} with schema {schema_id}, which is unknown"
                        ));
                    }
                };
                let channel = Channel {
                    topic: topic.clone(),
                    schema,
                    encoding: message_encoding.clone(),
                    metadata: metadata.clone(),
                };
                self.index.channels.insert(*id, Arc::new(channel));
            }
            _ => {}
        }
        Ok(())
    }
}
