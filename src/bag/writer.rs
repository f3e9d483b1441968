//! Messages into an MCAP file, as rosbag2 writes it.
//!
//! Chunks are gathered in memory and appended whole: what a killed process leaves behind is a file
//! of whole chunks, and at most the last one is cut.

use std::{
    collections::BTreeMap,
    fs::{self, File},
    io::BufWriter,
    path::{Path, PathBuf},
};

use mcap::{McapError, records::MessageHeader, write::NoSeek};

use super::{
    error::BagError,
    layout::{self, ACTIVE},
    metadata,
};
use crate::{frame::Stamp, msg::type_support};

/// How chunks are compressed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Compression {
    /// Not at all.
    None,
    /// LZ4: fast.
    Lz4,
    /// Zstandard, level 3: small.
    #[default]
    Zstd,
}

/// How a bag is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WriterOptions {
    /// How chunks are compressed; zstd by default.
    pub compression: Compression,
    /// Size at which a chunk ends (bytes before compression); 1 MiB by default.
    pub chunk_size: u64,
}

impl Default for WriterOptions {
    fn default() -> Self {
        Self { compression: Compression::default(), chunk_size: 1 << 20 }
    }
}

/// A topic of the bag that gave it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct TopicId(usize);

/// A topic that was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WrittenTopic {
    /// Its name.
    pub name: String,
    /// The type of its messages.
    pub type_name: String,
    /// RIHS01 type hash; empty if unknown.
    pub hash: String,
    /// How many messages it has.
    pub messages: u64,
}

/// What was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BagSummary {
    /// The bag's directory.
    pub directory: PathBuf,
    /// The MCAP file in it.
    pub file: PathBuf,
    /// How many messages it has.
    pub messages: u64,
    /// Smallest log time, if there is a message.
    pub start: Option<Stamp>,
    /// Largest log time, if there is a message.
    pub end: Option<Stamp>,
    /// Size of the file (bytes).
    pub size: u64,
    /// The topics, in the order in which they were added.
    pub topics: Vec<WrittenTopic>,
}

/// Writes one bag: a directory with one MCAP file.
///
/// The file is called `*.mcap.active` until [`BagWriter::finish`]. Dropped without it, the file
/// stays under that name, complete and readable. The same calls give the same bytes.
pub struct BagWriter {
    mcap: mcap::Writer<NoSeek<BufWriter<File>>>,
    directory: PathBuf,
    file: PathBuf,
    active: PathBuf,
    topics: Vec<WrittenTopic>,
    /// MCAP's channel ids, by topic.
    channels: Vec<u16>,
    /// Smallest and largest log time.
    times: Option<(Stamp, Stamp)>,
}

impl BagWriter {
    /// Creates the bag's directory and its file, which starts to exist with its header.
    ///
    /// # Errors
    /// [`BagError::Exists`] when there is something at `path`, [`BagError::NotABag`] when `path` has
    /// no last part to name the file after, [`BagError::Io`] when the system refuses.
    pub fn create(path: &Path, options: WriterOptions) -> Result<Self, BagError> {
        let file = layout::first_file(path).ok_or_else(|| BagError::NotABag {
            path: path.into(),
            found: "a path without a last part in UTF-8".into(),
        })?;
        if fs::symlink_metadata(path).is_ok() {
            return Err(BagError::Exists { path: path.into() });
        }
        fs::create_dir_all(path).map_err(BagError::io(path, "creating the bag"))?;
        let active = PathBuf::from(format!("{}{ACTIVE}", file.display()));
        let stream =
            File::create_new(&active).map_err(BagError::io(&active, "creating the file"))?;
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
            .create(NoSeek::new(BufWriter::new(stream)))
            .map_err(|error| refused(&active, error))?;
        mcap.flush().map_err(|error| refused(&active, error))?;
        let (topics, channels) = (Vec::new(), Vec::new());
        Ok(Self { mcap, directory: path.into(), file, active, topics, channels, times: None })
    }

    /// The file that is being written.
    pub fn active_file(&self) -> &Path {
        &self.active
    }

    /// How many messages were written.
    pub fn messages(&self) -> u64 {
        self.topics.iter().map(|topic| topic.messages).sum()
    }

    /// The topics so far, in the order in which they were added.
    pub fn topics(&self) -> &[WrittenTopic] {
        &self.topics
    }

    /// Adds a topic with one of our message types, or gives the id it already has.
    ///
    /// # Errors
    /// [`BagError::Type`] when the type is unknown, [`BagError::TopicType`] when the topic has
    /// another one already, otherwise as [`BagWriter::write`].
    pub fn topic(&mut self, name: &str, type_name: &str) -> Result<TopicId, BagError> {
        let support = type_support(type_name)
            .map_err(|reason| BagError::Type { topic: name.into(), reason })?;
        self.topic_with_schema(name, type_name, &support.schema, &support.hash)
    }

    /// Adds a topic of any type: `schema` is its `.msg` text with that of every dependency, `hash`
    /// its RIHS01 type hash (empty if unknown).
    ///
    /// # Errors
    /// As [`BagWriter::topic`].
    pub fn topic_with_schema(
        &mut self,
        name: &str,
        type_name: &str,
        schema: &str,
        hash: &str,
    ) -> Result<TopicId, BagError> {
        if let Some(known) = self.topics.iter().position(|topic| topic.name == name) {
            if self.topics[known].type_name != type_name {
                return Err(BagError::TopicType {
                    path: self.directory.clone(),
                    topic: name.into(),
                    found: type_name.into(),
                    expected: self.topics[known].type_name.clone(),
                });
            }
            return Ok(TopicId(known));
        }
        let about = BTreeMap::from([
            ("offered_qos_profiles".to_owned(), metadata::offered_qos_profiles()),
            ("topic_type_hash".to_owned(), hash.to_owned()),
        ]);
        let channel = self
            .mcap
            .add_schema(type_name, "ros2msg", schema.as_bytes())
            .and_then(|schema| self.mcap.add_channel(schema, name, "cdr", &about))
            .map_err(|error| refused(&self.active, error))?;
        self.channels.push(channel);
        self.topics.push(WrittenTopic {
            name: name.into(),
            type_name: type_name.into(),
            hash: hash.into(),
            messages: 0,
        });
        Ok(TopicId(self.topics.len() - 1))
    }

    /// Appends a message: `cdr` with its 4-byte header. `log_time` is when it was received,
    /// `publish_time` when it was sent. Messages of a topic are numbered from 1.
    ///
    /// # Errors
    /// [`BagError::NegativeTime`] for times before 0: the message is not written, the bag stays
    /// usable. [`BagError::Io`] and [`BagError::Format`] when writing failed: nothing more can be
    /// written; whole chunks before that stay in the file.
    pub fn write(
        &mut self,
        topic: TopicId,
        log_time: Stamp,
        publish_time: Stamp,
        cdr: &[u8],
    ) -> Result<(), BagError> {
        let TopicId(index) = topic;
        let header = MessageHeader {
            channel_id: self.channels[index],
            sequence: (self.topics[index].messages + 1) as u32,
            log_time: self.nanoseconds(index, "log_time", log_time)?,
            publish_time: self.nanoseconds(index, "publish_time", publish_time)?,
        };
        self.mcap
            .write_to_known_channel(&header, cdr)
            .map_err(|error| refused(&self.active, error))?;
        self.topics[index].messages += 1;
        let (start, end) = self.times.unwrap_or((log_time, log_time));
        self.times = Some((start.min(log_time), end.max(log_time)));
        Ok(())
    }

    fn nanoseconds(&self, topic: usize, field: &'static str, time: Stamp) -> Result<u64, BagError> {
        u64::try_from(time.0).map_err(|_| BagError::NegativeTime {
            path: self.directory.clone(),
            topic: self.topics[topic].name.clone(),
            field,
            found: time.0,
        })
    }

    /// Ends the chunk and hands it to the system: a process killed after this keeps all messages
    /// before it.
    ///
    /// # Errors
    /// As [`BagWriter::write`].
    pub fn flush(&mut self) -> Result<(), BagError> {
        self.mcap.flush().map_err(|error| refused(&self.active, error))
    }

    /// Ends the file, gives it its name and writes `metadata.yaml`.
    ///
    /// # Errors
    /// [`BagError::Io`] and [`BagError::Format`]. The file then keeps the name `*.active`.
    pub fn finish(mut self) -> Result<BagSummary, BagError> {
        let Self { directory, file, active, .. } = &self;
        let (directory, file, active) = (directory.clone(), file.clone(), active.clone());
        self.mcap.finish().map_err(|error| refused(&active, error))?;
        let stream = self.mcap.into_inner().into_inner().into_inner();
        let stream =
            stream.map_err(|error| BagError::io(&active, "writing")(error.into_error()))?;
        stream.sync_all().map_err(BagError::io(&active, "bringing the file to the disk"))?;
        let size = stream.metadata().map_err(BagError::io(&active, "measuring the file"))?.len();
        fs::rename(&active, &file).map_err(BagError::io(&active, "naming the finished file"))?;
        let summary = BagSummary {
            directory,
            file,
            messages: self.topics.iter().map(|topic| topic.messages).sum(),
            start: self.times.map(|(start, _)| start),
            end: self.times.map(|(_, end)| end),
            size,
            topics: self.topics,
        };
        metadata::write(&summary)?;
        Ok(summary)
    }
}

fn refused(path: &Path, error: McapError) -> BagError {
    match error {
        McapError::Io(error) => BagError::io(path, "writing")(error),
        other => BagError::Format { path: path.into(), reason: other.to_string() },
    }
}
