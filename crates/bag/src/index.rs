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
    MAGIC,
    records::{self, ChunkIndex, Record, SchemaHeader, Statistics, op},
};

use super::{
    channel::{Channel, Schema},
    error::BagError,
    faults::Faults,
    parse,
    record::{self, RecordHeader, Records, SIZE_LIMIT, Step},
    segment::{Kind, Segment},
};

/// Called with the number of bytes that were passed over; `false` ends the work.
pub(super) type Watch<'a> = dyn FnMut(u64) -> bool + 'a;

/// How much is passed over between two calls of who watches (bytes).
pub(super) const WATCHED: u64 = 1 << 20;

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
    pub(super) damage: Faults<Damage>,
    /// Whether all this is from the file's own summary.
    pub(super) summarized: bool,
    /// How many messages its summary states, if it has one that does.
    pub(super) stated: Option<u64>,
    /// Its attachments and its metadata records.
    pub(super) extras: Vec<RecordHeader>,
    /// If it was walked through: the end of its last whole record before the summary (bytes).
    pub(super) data_end: u64,
    /// If it was walked through: its readable chunks as a summary lists them.
    pub(super) chunks: Vec<ChunkIndex>,
    /// If it was walked through: what its pieces hold, in their order.
    pub(super) pieces: Vec<Piece>,
}

/// What a piece of a file holds.
#[derive(Debug)]
pub(super) struct Piece {
    /// Where it starts (bytes).
    pub(super) position: u64,
    /// Messages, by channel.
    pub(super) counts: BTreeMap<u16, u64>,
    /// Smallest and largest log time (ns).
    pub(super) times: (u64, u64),
}

pub(super) fn widened(times: Option<(u64, u64)>, (first, last): (u64, u64)) -> (u64, u64) {
    times.map_or((first, last), |(before, after)| (before.min(first), after.max(last)))
}

impl FileIndex {
    /// Indexes the file, number `number` of its bag.
    ///
    /// # Errors
    /// [`BagError::Io`], and [`BagError::Magic`] when it is no MCAP file. Damage behind the first
    /// bytes is no error but noted in the index.
    pub(super) fn open(path: &Path, number: usize) -> Result<Self, BagError> {
        Self::open_watched(path, number, &mut |_| true)
    }

    /// The same, which may take long where the file has to be walked through.
    ///
    /// # Errors
    /// Also [`BagError::Interrupted`].
    pub(super) fn open_watched(
        path: &Path,
        number: usize,
        watch: &mut Watch<'_>,
    ) -> Result<Self, BagError> {
        let failed = |reason| BagError::Io { path: path.into(), action: "reading", reason };
        let mut file = File::open(path).map_err(BagError::io(path, "opening the file"))?;
        let size = file.metadata().map_err(failed)?.len();
        let mut magic = Vec::new();
        readable(file.by_ref().take(MAGIC.len() as u64).read_to_end(&mut magic)).map_err(failed)?;
        if !MAGIC.starts_with(&magic) {
            return Err(BagError::Magic { path: path.into(), found: magic });
        }
        let mut builder = Builder::new(path, number, size);
        let start = readable(record::summary_start(&mut file, size)).map_err(failed)?.flatten();
        if let Some(start) = start {
            let mut records = Records::new(file.try_clone().map_err(failed)?, size, start);
            let found = readable(builder.find_by_summary(&mut records, start)).map_err(failed)?;
            if found == Some(true) {
                if !watch(size) {
                    return Err(BagError::Interrupted { path: path.into() });
                }
                return Ok(builder.index);
            }
            builder = builder.keeping_channels();
        }
        let records = Records::new(file, size, size.min(MAGIC.len() as u64));
        builder.by_walking(records, watch)
    }

    /// Indexes the file by walking through it, whatever its summary says.
    ///
    /// # Errors
    /// [`BagError::Io`].
    pub(super) fn walk(path: &Path) -> Result<Self, BagError> {
        let failed = |reason| BagError::Io { path: path.into(), action: "reading", reason };
        let file = File::open(path).map_err(BagError::io(path, "opening the file"))?;
        let size = file.metadata().map_err(failed)?.len();
        let records = Records::new(file, size, MAGIC.len() as u64);
        Builder::new(path, 0, size).by_walking(records, &mut |_| true)
    }

    /// Takes from the index of a file that was walked through what lies there and behind it.
    pub(super) fn cut_back(&mut self, end: u64) {
        (self.size, self.data_end) = (end, end);
        self.segments.retain(|segment| segment.position + segment.length <= end);
        self.chunks.retain(|chunk| chunk.chunk_start_offset < end);
        self.extras.retain(|extra| extra.position < end);
        self.pieces.retain(|piece| piece.position < end);
        (self.counts, self.times) = (BTreeMap::new(), None);
        for Piece { counts, times, .. } in &self.pieces {
            for (channel, messages) in counts {
                *self.counts.entry(*channel).or_insert(0) += messages;
            }
            self.times = Some(widened(self.times, *times));
        }
    }

    /// What is wrong with it, as errors.
    pub(super) fn faults(&self) -> impl Iterator<Item = BagError> {
        self.damage.first().map(|damage| damage.error(&self.path))
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
            damage: Faults::default(),
            summarized: false,
            stated: None,
            extras: Vec::new(),
            data_end: MAGIC.len() as u64,
            chunks: Vec::new(),
            pieces: Vec::new(),
        };
        Self { index, number }
    }

    /// A new start for the walk: the file's beginning, where the topics are, may be what is damaged.
    fn keeping_channels(self) -> Self {
        let FileIndex { path, size, schemas, channels, .. } = self.index;
        let mut again = Self::new(&path, self.number, size);
        (again.index.schemas, again.index.channels) = (schemas, channels);
        again
    }

    /// Takes the index from the file's summary; `false` when it lacks a part that is needed or contradicts
    /// itself or the file: files may have no statistics, no chunk indexes, or messages outside chunks.
    fn find_by_summary(&mut self, records: &mut Records, summary: u64) -> std::io::Result<bool> {
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
            match parse::record(header.opcode, &body) {
                Ok(Record::Statistics(found)) => statistics = Some(found),
                Ok(Record::ChunkIndex(chunk)) => chunks.push(chunk),
                Ok(record) if self.declare(&record).is_ok() => {}
                _ => return Ok(false),
            }
        }
        chunks.sort_by_key(|chunk: &ChunkIndex| chunk.chunk_start_offset);
        let Some(extras) = between(&chunks, records, summary)? else { return Ok(false) };
        self.index.extras = extras;
        Ok(statistics.is_some_and(|statistics| self.assemble(statistics, &chunks)))
    }

    fn assemble(&mut self, statistics: Statistics, chunks: &[ChunkIndex]) -> bool {
        let counts = statistics.channel_message_counts;
        let complete = chunks.len() == statistics.chunk_count as usize
            && self.index.channels.len() == statistics.channel_count as usize
            && counts.keys().all(|channel| self.index.channels.contains_key(channel))
            && counts.values().sum::<u64>() == statistics.message_count
            && (!chunks.is_empty() || statistics.message_count == 0);
        if !complete {
            return false;
        }
        for chunk in chunks {
            let (position, length) = (chunk.chunk_start_offset, chunk.chunk_length);
            let inside = position.checked_add(length).is_some_and(|end| end <= self.index.size);
            if !inside {
                return false;
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
        self.index.stated = Some(statistics.message_count);
        self.index.counts = counts;
        self.index.times = (statistics.message_count > 0)
            .then_some((statistics.message_start_time, statistics.message_end_time));
        self.index.summarized = true;
        true
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

/// What is readable; `None` where a sector of the disk is not.
fn readable<T>(read: std::io::Result<T>) -> std::io::Result<Option<T>> {
    match read {
        Ok(read) => Ok(Some(read)),
        Err(error) if BagError::is_unreadable(&error) => Ok(None),
        Err(error) => Err(error),
    }
}

/// The attachments and metadata records between the chunks. `None` when there are messages as well, or
/// chunks that the summary does not know, or what is there does not fit the summary.
fn between(
    chunks: &[ChunkIndex],
    records: &mut Records,
    summary: u64,
) -> std::io::Result<Option<Vec<RecordHeader>>> {
    let mut extras = Vec::new();
    records.position = MAGIC.len() as u64;
    let ends = chunks.iter().map(|chunk| {
        let ChunkIndex { chunk_length, message_index_length, .. } = chunk;
        let end = chunk.chunk_start_offset.checked_add(*chunk_length);
        (chunk.chunk_start_offset, end.and_then(|end| end.checked_add(*message_index_length)))
    });
    for (start, end) in ends.chain([(summary, Some(summary))]) {
        while records.position < start {
            let Step::Record(header) = records.step()? else { return Ok(None) };
            match header.opcode {
                op::ATTACHMENT | op::METADATA => extras.push(header),
                0 | op::CHUNK | op::MESSAGE => return Ok(None),
                _ => {}
            }
        }
        match end {
            Some(end) if records.position == start => records.position = end,
            _ => return Ok(None),
        }
    }
    Ok(Some(extras))
}
