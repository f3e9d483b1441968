//! One MCAP file while it is being written.
//!
//! Chunks are gathered in memory and appended whole: what a killed process leaves behind is a file
//! of whole chunks, and at most the last one is cut.

use std::{
    collections::BTreeMap,
    fs::{self, File},
    io::{self, BufWriter, Write},
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use mcap::{McapError, records::MessageHeader, write::NoSeek};

use super::{
    channel::Channel,
    error::BagError,
    extra::Extra,
    index::FileIndex,
    layout::ACTIVE,
    summary,
    writer::{Compression, WriterOptions, WrittenFile},
};
use eddy_frames::Stamp;
use eddy_settings::atomic;

/// Bytes of a message record before its data, and of its entry in the message index.
const MESSAGE_OVERHEAD: u64 = 9 + 2 + 4 + 8 + 8 + 16;
/// Bytes of a chunk record around its records, of its index in the summary, and of the frame of a
/// compression around what does not become smaller.
const CHUNK_OVERHEAD: u64 = 9 + 48 + 4 + 9 + 80 + 64;
/// Of so many bytes at least, compressions make blocks with a header of a few bytes (lz4: 64 KiB and 4, zstd:
/// 128 KiB and 3).
const SMALLEST_FRAME: u64 = 1 << 13;
/// Bytes that a chunk takes for each channel: its message index, and where that is.
const CHUNK_CHANNEL_OVERHEAD: u64 = 9 + 2 + 4 + 10;
/// Bytes of a schema and a channel around their texts, in the data and in the summary.
const CHANNEL_OVERHEAD: u64 = 2 * (9 + 2 + 3 * 4 + 9 + 2 + 2 + 3 * 4) + 10;
/// Bytes of the lengths of an entry of a channel's metadata.
const ENTRY_OVERHEAD: u64 = 4 + 4;
/// Bytes of an attachment's or a metadata record's index in the summary, beside its names.
const EXTRA_OVERHEAD: u64 = 9 + 5 * 8 + 2 * 4;
/// Bytes of data end, statistics, six offsets of groups, footer and magic.
const END_OVERHEAD: u64 = (9 + 4) + (9 + 46) + 6 * (9 + 17) + (9 + 20) + 8;

/// A file called `*.mcap.active` until it is finished. Dropped before, it stays under that name,
/// complete and readable.
pub(super) struct Part {
    mcap: mcap::Writer<NoSeek<Counted>>,
    file: PathBuf,
    active: PathBuf,
    /// Bytes handed to the system so far.
    handed_over: Arc<AtomicU64>,
    /// Bytes that the chunk that is being gathered takes at most.
    gathered: u64,
    /// Bytes that the summary takes at most.
    summary: u64,
    channels: u64,
    messages: u64,
    /// Smallest and largest log time.
    times: Option<(Stamp, Stamp)>,
}

impl Part {
    /// Creates the file, which starts to exist with its header.
    pub(super) fn create(file: PathBuf, options: &WriterOptions) -> Result<Self, BagError> {
        let active = PathBuf::from(format!("{}{ACTIVE}", file.display()));
        let stream =
            File::create_new(&active).map_err(BagError::io(&active, "creating the file"))?;
        let handed_over = Arc::new(AtomicU64::new(0));
        let counted = Counted { stream: BufWriter::new(stream), count: Arc::clone(&handed_over) };
        let mut mcap = mcap::WriteOptions::new()
            .profile("ros2")
            .library(concat!("eddy ", env!("CARGO_PKG_VERSION")))
            .compression(match options.compression {
                Compression::None => None,
                Compression::Lz4 => Some(mcap::Compression::Lz4),
                Compression::Zstd => Some(mcap::Compression::Zstd),
            })
            // Workers of its own would cost a writer one thread for each core.
            .compression_threads(0)
            .chunk_size(Some(options.chunk_size))
            .disable_seeking(true)
            .create(NoSeek::new(counted))
            .map_err(|error| refused(&active, error))?;
        mcap.flush().map_err(|error| refused(&active, error))?;
        let (gathered, summary, channels) = (0, END_OVERHEAD, 0);
        let (messages, times) = (0, None);
        Ok(Self { mcap, file, active, handed_over, gathered, summary, channels, messages, times })
    }

    /// The file, under its unfinished name.
    pub(super) fn active(&self) -> &Path {
        &self.active
    }

    /// The smallest log time, if there is a message.
    pub(super) fn start(&self) -> Option<Stamp> {
        self.times.map(|(start, _)| start)
    }

    /// What the file takes at most, closed, with one more message of so many bytes.
    pub(super) fn closed_size_with(&self, data: u64) -> u64 {
        let chunk = self.gathered + self.chunk_overhead() + data + MESSAGE_OVERHEAD;
        let frames = chunk / SMALLEST_FRAME;
        // It may begin a chunk.
        let handed_over = self.handed_over.load(Ordering::Relaxed);
        handed_over + chunk + frames + self.chunk_overhead() + self.summary
    }

    /// What the file takes at most, closed, with one more channel and its schema.
    pub(super) fn closed_size_with_channel(&self, channel: &Channel) -> u64 {
        let chunks = 2 * CHUNK_CHANNEL_OVERHEAD;
        self.closed_size_with(0) + 2 * described_size(channel) + chunks
    }

    fn chunk_overhead(&self) -> u64 {
        CHUNK_OVERHEAD + self.channels * CHUNK_CHANNEL_OVERHEAD
    }

    /// Adds what was written since so many bytes had been handed over.
    fn account(&mut self, handed_over_before: u64, bytes: u64) {
        if self.handed_over.load(Ordering::Relaxed) != handed_over_before {
            // The chunk before has ended, and is in the summary.
            self.gathered = 0;
            self.summary += self.chunk_overhead();
        }
        self.gathered += bytes;
    }

    /// Writes a channel and its schema, each at most once. Gives its id.
    pub(super) fn declare(&mut self, channel: &Channel) -> Result<u16, BagError> {
        let Self { mcap, active, handed_over, .. } = self;
        let before = handed_over.load(Ordering::Relaxed);
        let schema = match &channel.schema {
            Some(schema) => mcap.add_schema(&schema.name, &schema.encoding, &schema.data),
            None => Ok(0),
        };
        let id = schema
            .and_then(|schema| {
                mcap.add_channel(schema, &channel.topic, &channel.encoding, &channel.metadata)
            })
            .map_err(|error| refused(active, error))?;
        let size = described_size(channel);
        self.account(before, size);
        self.summary += size;
        self.channels += 1;
        Ok(id)
    }

    /// Writes an attachment or a metadata record.
    pub(super) fn attach(&mut self, extra: &Extra) -> Result<(), BagError> {
        let before = self.handed_over.load(Ordering::Relaxed);
        let (written, names) = match extra {
            Extra::Attachment(attachment) => {
                let names = attachment.name.len() + attachment.media_type.len();
                (self.mcap.attach(attachment), names)
            }
            Extra::Metadata(metadata) => (self.mcap.write_metadata(metadata), metadata.name.len()),
        };
        written.map_err(|error| refused(&self.active, error))?;
        self.account(before, 0);
        self.summary += EXTRA_OVERHEAD + names as u64;
        Ok(())
    }

    /// Appends a message; its log time is given once more as the time it is.
    pub(super) fn write(
        &mut self,
        header: &MessageHeader,
        log_time: Stamp,
        data: &[u8],
    ) -> Result<(), BagError> {
        let before = self.handed_over.load(Ordering::Relaxed);
        self.mcap
            .write_to_known_channel(header, data)
            .map_err(|error| refused(&self.active, error))?;
        self.account(before, data.len() as u64 + MESSAGE_OVERHEAD);
        self.messages += 1;
        let (start, end) = self.times.unwrap_or((log_time, log_time));
        self.times = Some((start.min(log_time), end.max(log_time)));
        Ok(())
    }

    /// Ends the chunk and hands it to the system.
    pub(super) fn flush(&mut self) -> Result<(), BagError> {
        let before = self.handed_over.load(Ordering::Relaxed);
        self.mcap.flush().map_err(|error| refused(&self.active, error))?;
        self.account(before, 0);
        Ok(())
    }

    /// Ends the file, brings it to the disk and gives it its name.
    ///
    /// # Errors
    /// The reason, and what is left of the file.
    pub(super) fn finish(mut self) -> Result<WrittenFile, Box<(BagError, Unclosed)>> {
        if let Err(error) = self.mcap.finish() {
            return Err(Box::new((refused(&self.active, error), self.abandon())));
        }
        let Self { mcap, file, active, messages, times, .. } = self;
        let stream = mcap.into_inner().into_inner().stream;
        let ended = stream
            .into_inner()
            .map_err(|error| BagError::io(&active, "writing")(error.into_error()))
            .and_then(|stream| {
                stream.sync_all().map_err(BagError::io(&active, "bringing the file to the disk"))
            });
        let unclosed = Unclosed { file, active };
        match ended.and_then(|()| unclosed.name(messages, times)) {
            Ok(written) => Ok(written),
            Err(error) => Err(Box::new((error, unclosed))),
        }
    }

    /// Gives up what is still in memory.
    pub(super) fn abandon(self) -> Unclosed {
        let Self { mcap, file, active, .. } = self;
        mcap.into_inner().into_inner().discard();
        Unclosed { file, active }
    }
}

/// A file that could not be written to its end, under its unfinished name.
pub(super) struct Unclosed {
    file: PathBuf,
    active: PathBuf,
}

impl Unclosed {
    /// Ends the file after the whole chunks that fit on the disk beside its summary, and gives it its
    /// name: for when no room was left to write on. Gives also the messages it has, by channel.
    pub(super) fn close_in_the_room_there_is(
        self,
    ) -> Result<(WrittenFile, BTreeMap<u16, u64>), BagError> {
        let index = FileIndex::walk(&self.active)?;
        let index = summary::end_file(&self.active, index, summary::Chunks::MakeRoom)?;
        let stamp = |time: u64| Stamp(i64::try_from(time).unwrap_or(i64::MAX));
        let times = index.times.map(|(start, end)| (stamp(start), stamp(end)));
        Ok((self.name(index.messages(), times)?, index.counts))
    }

    fn name(&self, messages: u64, times: Option<(Stamp, Stamp)>) -> Result<WrittenFile, BagError> {
        let Self { file, active } = self;
        let metadata = fs::metadata(active).map_err(BagError::io(active, "measuring the file"))?;
        atomic::rename(active, file).map_err(BagError::io(active, "naming the finished file"))?;
        Ok(WrittenFile {
            path: file.clone(),
            messages,
            start: times.map(|(start, _)| start),
            end: times.map(|(_, end)| end),
            size: metadata.len(),
        })
    }
}

/// What a channel and its schema take once in the data or in the summary, and more (bytes).
fn described_size(channel: &Channel) -> u64 {
    let schema = channel.schema.as_ref();
    let schema =
        schema.map_or(0, |schema| schema.name.len() + schema.encoding.len() + schema.data.len());
    let texts = schema + channel.topic.len() + channel.encoding.len();
    let entries = channel.metadata.iter();
    let entries = entries.map(|(key, value)| (key.len() + value.len()) as u64 + ENTRY_OVERHEAD);
    texts as u64 + entries.sum::<u64>() + CHANNEL_OVERHEAD
}

/// Counts the bytes that pass.
struct Counted {
    stream: BufWriter<File>,
    count: Arc<AtomicU64>,
}

impl Counted {
    /// Closes the file without what is still in the buffer.
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

fn refused(path: &Path, error: McapError) -> BagError {
    match error {
        McapError::Io(error) => BagError::io(path, "writing")(error),
        other => BagError::Format { path: path.into(), reason: other.to_string() },
    }
}
