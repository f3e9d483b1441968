//! Where the messages of a file lie: from its summary if it has a usable one, else by walking
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
    layout,
    record::{self, RecordHeader, Records, SIZE_LIMIT, Step},
    segment::{Kind, Segment, described, wanted_record},
};

/// No record has this opcode: bytes that were never written, most likely.
const NO_RECORD: u8 = 0;

/// A run of messages outside chunks ends at this size (bytes), so that reading stays bounded.
const LOOSE_RUN: u64 = 1 << 20;

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
struct Builder {
    index: FileIndex,
    /// Number of the file in its bag.
    number: usize,
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

    /// Reads the whole file once. Chunks are opened to see what is in them.
    fn by_walking(mut self, mut records: Records) -> Result<FileIndex, BagError> {
        let failed = BagError::io(self.index.path.clone(), "reading");
        let ended = self.walk(&mut records);
        match ended {
            Ok(None) => {}
            Ok(Some(expected)) => {
                let (size, messages) = (self.index.size, self.index.messages());
                let truncated = Damage::Truncated { size, messages, expected };
                self.index.damage.get_or_insert(truncated);
            }
            Err(WalkError::Io(error)) => return Err(failed(error)),
            Err(WalkError::Bag(error)) => return Err(error),
        }
        Ok(self.index)
    }

    /// Walks to the end. Gives what should have come when the file ends too early.
    fn walk(&mut self, records: &mut Records) -> Result<Option<String>, WalkError> {
        if self.index.size < MAGIC.len() as u64 {
            return Ok(Some("the rest of the 8 bytes that start an MCAP file".into()));
        }
        let mut in_summary = false;
        loop {
            let header = match records.step()? {
                Step::Record(header) => header,
                Step::CutBody(header) if !in_summary && self.reads_on(&header, records)? => {
                    continue;
                }
                Step::CutBody(header) => {
                    if header.opcode == op::CHUNK {
                        self.chunk(&header, Kind::CutChunk, records)?;
                    }
                    let start = header.position;
                    return Ok(Some(format!("{} from byte {start}", described(&header))));
                }
                Step::CutHeader => return Ok(Some("a record's header of 9 bytes".into())),
                // What is still being written ends after any whole record.
                Step::End if !in_summary && layout::is_active(&self.index.path) => return Ok(None),
                Step::End => return Ok(Some("the data end record and the footer".into())),
            };
            match header.opcode {
                NO_RECORD if !in_summary => {
                    if self.reads_on(&header, records)? {
                        continue;
                    }
                    return Ok(Some(format!("a record from byte {}", header.position)));
                }
                op::FOOTER => {
                    let rest = self.index.size - header.end();
                    let expected = "the 8 bytes that end an MCAP file";
                    return Ok((rest < MAGIC.len() as u64).then(|| expected.into()));
                }
                op::DATA_END => in_summary = true,
                _ if in_summary => {}
                op::CHUNK => self.chunk(&header, Kind::Chunk, records)?,
                op::MESSAGE_INDEX => self.message_index(&header, records)?,
                op::SCHEMA | op::CHANNEL | op::MESSAGE => self.loose(&header, records)?,
                op::ATTACHMENT => self.index.extras.0 += 1,
                op::METADATA => self.index.extras.1 += 1,
                _ => {}
            }
            if !in_summary {
                self.index.data_end = header.end();
            }
        }
    }

    /// Looks for a chunk after a record that cannot be one, and goes on there.
    fn reads_on(
        &mut self,
        header: &RecordHeader,
        records: &mut Records,
    ) -> Result<bool, WalkError> {
        let found = records.go_to_chunk(header.position + 1)?;
        if found {
            let (found, expected) = (described(header), "a record within the file".into());
            let damage = Damage::Corrupt { position: header.position, found, expected };
            self.index.damage.get_or_insert(damage);
        }
        Ok(found)
    }

    fn chunk(
        &mut self,
        header: &RecordHeader,
        kind: Kind,
        records: &mut Records,
    ) -> Result<(), WalkError> {
        let stated = records.chunk_header(header)?;
        if let Some(stated) = &stated {
            self.index.compressions.insert(stated.compression.clone());
        }
        let end = header.end().min(self.index.size);
        let segment = Segment {
            file: self.number,
            position: header.position,
            length: end - header.position,
            kind,
            first: 0,
            last: 0,
        };
        let path = self.index.path.clone();
        let (mut counts, mut times) = (BTreeMap::new(), None);
        let outcome = segment.read(&path, |record| match record {
            Record::Message { header, .. } => {
                if !self.index.channels.contains_key(&header.channel_id) {
                    return Err(unknown_channel(header.channel_id));
                }
                *counts.entry(header.channel_id).or_insert(0) += 1;
                times = Some(widened(times, header.log_time));
                Ok(())
            }
            other => self.declare(&other),
        });
        match outcome {
            Ok(()) => {}
            Err(BagError::Corrupt { position, found, expected, .. }) => {
                // The chunks after it may be whole: go on, and remember the first fault.
                self.index.damage.get_or_insert(Damage::Corrupt { position, found, expected });
                return Ok(());
            }
            Err(error) => return Err(error.into()),
        }
        if let Some(stated) = stated.filter(|_| kind == Kind::Chunk) {
            let (message_start_time, message_end_time) = times.unwrap_or_default();
            self.index.chunks.push(ChunkIndex {
                message_start_time,
                message_end_time,
                chunk_start_offset: header.position,
                chunk_length: segment.length,
                message_index_offsets: BTreeMap::new(),
                message_index_length: 0,
                compressed_size: header.length.saturating_sub(stated.records as u64),
                uncompressed_size: stated.uncompressed,
                compression: stated.compression,
            });
        }
        if let Some((first, last)) = times {
            self.index.segments.push(Segment { first, last, ..segment });
            self.count(counts, (first, last));
        }
        Ok(())
    }

    /// Notes where the chunk before it keeps the index of one of its channels.
    fn message_index(
        &mut self,
        header: &RecordHeader,
        records: &mut Records,
    ) -> Result<(), WalkError> {
        let Some(chunk) = self.index.chunks.last_mut() else { return Ok(()) };
        let indexed = chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length;
        if header.position != indexed || header.length > SIZE_LIMIT {
            return Ok(());
        }
        let body = records.read(header)?;
        if let Ok(Record::MessageIndex(index)) = parse_record(header.opcode, &body) {
            chunk.message_index_offsets.insert(index.channel_id, header.position);
            chunk.message_index_length += header.end() - header.position;
        }
        Ok(())
    }

    fn loose(&mut self, header: &RecordHeader, records: &mut Records) -> Result<(), WalkError> {
        if header.length > SIZE_LIMIT {
            let found = described(header);
            let expected = "at most 1 GiB".into();
            let damage = Damage::Corrupt { position: header.position, found, expected };
            self.index.damage.get_or_insert(damage);
            return Ok(());
        }
        let body = records.read(header)?;
        let parsed = wanted_record(header.opcode, &body).map_err(|error| error.to_string());
        let outcome = match parsed {
            Ok(Some(Record::Message { header: message, .. })) => {
                if self.index.channels.contains_key(&message.channel_id) {
                    self.loose_message(header, message.log_time);
                    self.count(
                        BTreeMap::from([(message.channel_id, 1)]),
                        (message.log_time, message.log_time),
                    );
                    Ok(())
                } else {
                    Err(unknown_channel(message.channel_id))
                }
            }
            Ok(Some(other)) => self.declare(&other),
            Ok(None) => Ok(()),
            Err(reason) => Err(reason),
        };
        if let Err(found) = outcome {
            let expected = "a record that fits those before it".into();
            let damage = Damage::Corrupt { position: header.position, found, expected };
            self.index.damage.get_or_insert(damage);
        }
        Ok(())
    }

    /// Adds a message outside chunks to the run before it, if it follows it without a gap.
    fn loose_message(&mut self, header: &RecordHeader, time: u64) {
        let length = header.end() - header.position;
        if let Some(run) = self.index.segments.last_mut()
            && run.kind == Kind::Loose
            && run.position + run.length == header.position
            && run.length < LOOSE_RUN
        {
            run.length += length;
            (run.first, run.last) = widened(Some((run.first, run.last)), time);
            return;
        }
        self.index.segments.push(Segment {
            file: self.number,
            position: header.position,
            length,
            kind: Kind::Loose,
            first: time,
            last: time,
        });
    }

    fn count(&mut self, counts: BTreeMap<u16, u64>, (first, last): (u64, u64)) {
        for (channel, messages) in counts {
            *self.index.counts.entry(channel).or_insert(0) += messages;
        }
        let times = widened(self.index.times, first);
        self.index.times = Some(widened(Some(times), last));
    }

    /// Notes a schema or a channel.
    fn declare(&mut self, record: &Record<'_>) -> Result<(), String> {
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

/// Why a walk had to stop.
enum WalkError {
    Io(std::io::Error),
    Bag(BagError),
}

impl From<std::io::Error> for WalkError {
    fn from(error: std::io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<BagError> for WalkError {
    fn from(error: BagError) -> Self {
        Self::Bag(error)
    }
}

pub(super) fn unknown_channel(channel: u16) -> String {
    format!("a message of channel {channel}, which is unknown")
}

fn widened(times: Option<(u64, u64)>, time: u64) -> (u64, u64) {
    times.map_or((time, time), |(first, last)| (first.min(time), last.max(time)))
}
