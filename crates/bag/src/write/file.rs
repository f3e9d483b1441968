//! Writes one MCAP file.
//!
//! Chunks are collected in memory and appended as a whole: a killed process leaves a file of complete chunks, of
//! which at most the last one is truncated.

use std::{
    collections::BTreeMap,
    fs::{self, File, TryLockError},
    io::{self, BufWriter, Write},
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use mcap::{McapError, records::MessageHeader, write::NoSeek};

use super::{
    finish::{self, OnFullDisk},
    options::{Compression, WriterOptions},
};
use crate::{
    error::BagError,
    format::{channel::Channel, layout::ACTIVE, summary::WrittenFile},
    read::{
        auxiliary::AuxiliaryRecord,
        index::{ChannelKey, FileIndex},
    },
};
use eddy_frames::Stamp;
use eddy_settings::atomic;

/// Whether a process is writing this unfinished file now, and was not killed.
pub fn is_being_written(active: &Path) -> bool {
    let locked = File::open(active).map(|file| file.try_lock_shared());
    matches!(locked, Ok(Err(TryLockError::WouldBlock)))
}

/// Bytes of a message record before its data, and of its entry in the message index.
const MESSAGE_OVERHEAD: u64 = 9 + 2 + 4 + 8 + 8 + 16;
/// Bytes of a chunk record beside its records, of its chunk index, and of the compression's frame around
/// incompressible data.
const CHUNK_OVERHEAD: u64 = 9 + 48 + 4 + 9 + 80 + 64;
/// Lower bound of the bytes per compression block, each with a header of a few bytes (lz4: 64 KiB and 4, zstd:
/// 128 KiB and 3), so that a byte for each is enough.
const SMALLEST_BLOCK: u64 = 1 << 13;
/// Bytes of a chunk for each channel: the message index and its offset.
const CHUNK_CHANNEL_OVERHEAD: u64 = 9 + 2 + 4 + 10;
/// Bytes of a schema and a channel beside their strings, in the data and summary sections.
const CHANNEL_OVERHEAD: u64 = 2 * (9 + 2 + 3 * 4 + 9 + 2 + 2 + 3 * 4) + 10;
/// Bytes of the two lengths of a metadata entry of a channel.
const ENTRY_OVERHEAD: u64 = 4 + 4;
/// Bytes of the index of an attachment or a metadata record beside its strings.
const AUXILIARY_OVERHEAD: u64 = 9 + 5 * 8 + 2 * 4;
/// Bytes of data end, statistics, six summary offsets, footer and magic.
const END_OVERHEAD: u64 = (9 + 4) + (9 + 46) + 6 * (9 + 17) + (9 + 20) + 8;

/// A file called `*.mcap.active` until it is finished. Dropped before, it keeps that name and is complete and
/// readable.
pub(super) struct FileWriter {
    mcap: mcap::Writer<NoSeek<Counted>>,
    file: PathBuf,
    active: PathBuf,
    /// Bytes written to the file so far.
    written: Arc<AtomicU64>,
    /// Upper bound of the size of the chunk in memory (bytes).
    chunk: u64,
    /// Upper bound of the size of the summary section (bytes).
    summary: u64,
    channels: u64,
    messages: u64,
    /// Smallest and largest log time.
    times: Option<(Stamp, Stamp)>,
}

impl FileWriter {
    /// Creates the file and writes its header.
    pub(super) fn create(file: PathBuf, options: &WriterOptions) -> Result<Self, BagError> {
        let active = PathBuf::from(format!("{}{ACTIVE}", file.display()));
        let stream =
            File::create_new(&active).map_err(BagError::io(&active, "creating the file"))?;
        // Until it is closed; see `is_being_written`. Some network file systems have no locks.
        if let Err(error) = stream.lock() {
            tracing::debug!("{}: no lock: {error}", active.display());
        }
        let written = Arc::new(AtomicU64::new(0));
        let counted = Counted { stream: BufWriter::new(stream), count: Arc::clone(&written) };
        let mut mcap = mcap::WriteOptions::new()
            .profile("ros2")
            .library(concat!("eddy ", env!("CARGO_PKG_VERSION")))
            .compression(match options.compression {
                Compression::None => None,
                Compression::Lz4 => Some(mcap::Compression::Lz4),
                Compression::Zstd => Some(mcap::Compression::Zstd),
            })
            // Its thread pool would start one thread for each core.
            .compression_threads(0)
            .chunk_size(Some(options.chunk_size))
            .disable_seeking(true)
            .create(NoSeek::new(counted))
            .map_err(|error| mcap_error(&active, error))?;
        mcap.flush().map_err(|error| mcap_error(&active, error))?;
        let (chunk, summary, channels) = (0, END_OVERHEAD, 0);
        let (messages, times) = (0, None);
        Ok(Self { mcap, file, active, written, chunk, summary, channels, messages, times })
    }

    /// Path of the unfinished file.
    pub(super) fn active(&self) -> &Path {
        &self.active
    }

    /// Smallest log time; `None` without messages.
    pub(super) fn start(&self) -> Option<Stamp> {
        self.times.map(|(start, _)| start)
    }

    /// Upper bound of the size of the finished file (bytes) with another message of `data` bytes.
    pub(super) fn finished_size_with_message(&self, data: u64) -> u64 {
        let chunk = self.chunk + self.chunk_overhead() + data + MESSAGE_OVERHEAD;
        let blocks = chunk / SMALLEST_BLOCK;
        // The message may start a new chunk.
        let written = self.written.load(Ordering::Relaxed);
        written + chunk + blocks + self.chunk_overhead() + self.summary
    }

    /// Upper bound of the size of the finished file (bytes) with another channel and its schema.
    pub(super) fn finished_size_with_channel(&self, channel: &Channel) -> u64 {
        let chunks = 2 * CHUNK_CHANNEL_OVERHEAD;
        self.finished_size_with_message(0) + 2 * channel_size(channel) + chunks
    }

    fn chunk_overhead(&self) -> u64 {
        CHUNK_OVERHEAD + self.channels * CHUNK_CHANNEL_OVERHEAD
    }

    /// Adds `bytes` to the size of the chunk, after a call that may have written the chunk before.
    fn account(&mut self, written_before: u64, bytes: u64) {
        if self.written.load(Ordering::Relaxed) != written_before {
            self.chunk = 0;
            self.summary += self.chunk_overhead();
        }
        self.chunk += bytes;
    }

    /// Writes a channel and its schema, each once, and returns the channel id.
    pub(super) fn add_channel(&mut self, channel: &Channel) -> Result<u16, BagError> {
        let Self { mcap, active, written, .. } = self;
        let before = written.load(Ordering::Relaxed);
        let schema = match &channel.schema {
            Some(schema) => mcap.add_schema(&schema.name, &schema.encoding, &schema.data),
            None => Ok(0),
        };
        let id = schema
            .and_then(|schema| {
                mcap.add_channel(schema, &channel.topic, &channel.encoding, &channel.metadata)
            })
            .map_err(|error| mcap_error(active, error))?;
        let size = channel_size(channel);
        self.account(before, size);
        self.summary += size;
        self.channels += 1;
        Ok(id)
    }

    /// Writes an attachment or a metadata record.
    pub(super) fn write_auxiliary(&mut self, record: &AuxiliaryRecord) -> Result<(), BagError> {
        let before = self.written.load(Ordering::Relaxed);
        let (outcome, names) = match record {
            AuxiliaryRecord::Attachment(attachment) => {
                let names = attachment.name.len() + attachment.media_type.len();
                (self.mcap.attach(attachment), names)
            }
            AuxiliaryRecord::Metadata(metadata) => {
                (self.mcap.write_metadata(metadata), metadata.name.len())
            }
        };
        outcome.map_err(|error| mcap_error(&self.active, error))?;
        self.account(before, 0);
        self.summary += AUXILIARY_OVERHEAD + names as u64;
        Ok(())
    }

    /// Appends a message; `log_time` is that of the header.
    pub(super) fn write(
        &mut self,
        header: &MessageHeader,
        log_time: Stamp,
        data: &[u8],
    ) -> Result<(), BagError> {
        let before = self.written.load(Ordering::Relaxed);
        self.mcap
            .write_to_known_channel(header, data)
            .map_err(|error| mcap_error(&self.active, error))?;
        self.account(before, data.len() as u64 + MESSAGE_OVERHEAD);
        self.messages += 1;
        let (start, end) = self.times.unwrap_or((log_time, log_time));
        self.times = Some((start.min(log_time), end.max(log_time)));
        Ok(())
    }

    /// Ends the chunk and writes it to the file.
    pub(super) fn flush(&mut self) -> Result<(), BagError> {
        let before = self.written.load(Ordering::Relaxed);
        self.mcap.flush().map_err(|error| mcap_error(&self.active, error))?;
        self.account(before, 0);
        Ok(())
    }

    /// Finishes the file, syncs it to disk and renames it.
    ///
    /// # Errors
    /// The reason, with the unfinished file.
    pub(super) fn finish(mut self) -> Result<WrittenFile, Box<(BagError, UnfinishedFile)>> {
        if let Err(error) = self.mcap.finish() {
            return Err(Box::new((mcap_error(&self.active, error), self.abandon())));
        }
        let Self { mcap, file, active, messages, times, .. } = self;
        let stream = mcap.into_inner().into_inner().stream;
        let ended = stream
            .into_inner()
            .map_err(|error| BagError::io(&active, "writing")(error.into_error()))
            .and_then(|stream| {
                stream.sync_all().map_err(BagError::io(&active, "syncing the file to disk"))
            });
        let unfinished = UnfinishedFile { file, active };
        match ended.and_then(|()| unfinished.rename(messages, times)) {
            Ok(written) => Ok(written),
            Err(error) => Err(Box::new((error, unfinished))),
        }
    }

    /// Discards the chunk in memory.
    fn abandon(self) -> UnfinishedFile {
        let Self { mcap, file, active, .. } = self;
        mcap.into_inner().into_inner().discard();
        UnfinishedFile { file, active }
    }
}

/// A file that could not be finished.
pub(super) struct UnfinishedFile {
    file: PathBuf,
    active: PathBuf,
}

impl UnfinishedFile {
    /// Finishes the file on a full disk, after the complete chunks that leave space for the summary section.
    /// Returns also the number of messages of each channel.
    pub(super) fn finish_on_full_disk(
        self,
    ) -> Result<(WrittenFile, BTreeMap<ChannelKey, u64>), BagError> {
        let index = FileIndex::scan(&self.active)?;
        let index = finish::finish_file(&self.active, index, OnFullDisk::DropChunks)?;
        let stamp = |time: u64| Stamp(i64::try_from(time).unwrap_or(i64::MAX));
        let times = index.times.map(|(start, end)| (stamp(start), stamp(end)));
        Ok((self.rename(index.messages(), times)?, index.counts))
    }

    fn rename(
        &self,
        messages: u64,
        times: Option<(Stamp, Stamp)>,
    ) -> Result<WrittenFile, BagError> {
        let Self { file, active } = self;
        let metadata =
            fs::metadata(active).map_err(BagError::io(active, "reading the size of the file"))?;
        atomic::rename(active, file).map_err(BagError::io(active, "renaming the finished file"))?;
        Ok(WrittenFile {
            path: file.clone(),
            messages,
            start: times.map(|(start, _)| start),
            end: times.map(|(_, end)| end),
            size: metadata.len(),
        })
    }
}

/// Upper bound of the size of a channel and its schema in the data or the summary section (bytes).
fn channel_size(channel: &Channel) -> u64 {
    let schema = channel.schema.as_ref();
    let schema =
        schema.map_or(0, |schema| schema.name.len() + schema.encoding.len() + schema.data.len());
    let texts = schema + channel.topic.len() + channel.encoding.len();
    let entries = channel.metadata.iter();
    let entries = entries.map(|(key, value)| (key.len() + value.len()) as u64 + ENTRY_OVERHEAD);
    texts as u64 + entries.sum::<u64>() + CHANNEL_OVERHEAD
}

/// Counts the bytes written.
struct Counted {
    stream: BufWriter<File>,
    count: Arc<AtomicU64>,
}

impl Counted {
    /// Closes the file without writing the buffer.
    fn discard(self) {
        drop(self.stream.into_parts());
    }
}

impl Write for Counted {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.stream.write(bytes)?;
        self.count.fetch_add(written as u64, Ordering::Relaxed);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}

fn mcap_error(path: &Path, error: McapError) -> BagError {
    match error {
        McapError::Io(error) => BagError::io(path, "writing")(error),
        other => BagError::Format { path: path.into(), reason: other.to_string() },
    }
}
