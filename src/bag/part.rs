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
    layout::ACTIVE,
    summary,
    writer::{Compression, WriterOptions, WrittenFile},
};
use crate::frame::Stamp;

/// Bytes of a message record before its data, and of its entry in the message index.
const MESSAGE_OVERHEAD: u64 = 9 + 2 + 4 + 8 + 8 + 16;

/// A file called `*.mcap.active` until it is finished. Dropped before, it stays under that name,
/// complete and readable.
pub(super) struct Part {
    mcap: mcap::Writer<NoSeek<Counted>>,
    file: PathBuf,
    active: PathBuf,
    /// Bytes handed to the system so far.
    handed_over: Arc<AtomicU64>,
    /// Bytes in the chunk that is being gathered, before compression.
    gathered: u64,
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
        Ok(Self { mcap, file, active, handed_over, gathered: 0, messages: 0, times: None })
    }

    /// The file, under its unfinished name.
    pub(super) fn active(&self) -> &Path {
        &self.active
    }

    /// The smallest log time, if there is a message.
    pub(super) fn start(&self) -> Option<Stamp> {
        self.times.map(|(start, _)| start)
    }

    /// What its messages take at most with one more of so many bytes, once its chunk has ended (bytes).
    pub(super) fn size_with(&self, data: u64) -> u64 {
        self.handed_over.load(Ordering::Relaxed) + self.gathered + data + MESSAGE_OVERHEAD
    }

    /// Writes a channel and its schema, each at most once. Gives its id.
    pub(super) fn declare(&mut self, channel: &Channel) -> Result<u16, BagError> {
        let Self { mcap, active, .. } = self;
        let schema = match &channel.schema {
            Some(schema) => mcap.add_schema(&schema.name, &schema.encoding, &schema.data),
            None => Ok(0),
        };
        schema
            .and_then(|schema| {
                mcap.add_channel(schema, &channel.topic, &channel.encoding, &channel.metadata)
            })
            .map_err(|error| refused(active, error))
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
        let chunk_ended = self.handed_over.load(Ordering::Relaxed) != before;
        self.gathered =
            if chunk_ended { 0 } else { self.gathered + data.len() as u64 + MESSAGE_OVERHEAD };
        self.messages += 1;
        let (start, end) = self.times.unwrap_or((log_time, log_time));
        self.times = Some((start.min(log_time), end.max(log_time)));
        Ok(())
    }

    /// Ends the chunk and hands it to the system.
    pub(super) fn flush(&mut self) -> Result<(), BagError> {
        self.gathered = 0;
        self.mcap.flush().map_err(|error| refused(&self.active, error))
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
        let index = summary::end_file(&self.active, summary::Chunks::MakeRoom)?;
        let stamp = |time: u64| Stamp(i64::try_from(time).unwrap_or(i64::MAX));
        let times = index.times.map(|(start, end)| (stamp(start), stamp(end)));
        Ok((self.name(index.messages(), times)?, index.counts))
    }

    fn name(&self, messages: u64, times: Option<(Stamp, Stamp)>) -> Result<WrittenFile, BagError> {
        let Self { file, active } = self;
        let metadata = fs::metadata(active).map_err(BagError::io(active, "measuring the file"))?;
        fs::rename(active, file).map_err(BagError::io(active, "naming the finished file"))?;
        Ok(WrittenFile {
            path: file.clone(),
            messages,
            start: times.map(|(start, _)| start),
            end: times.map(|(_, end)| end),
            size: metadata.len(),
        })
    }
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
