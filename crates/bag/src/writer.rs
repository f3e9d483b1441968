//! Messages into a bag as rosbag2 lays it out: a directory of MCAP files, split by size and time.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use mcap::records::MessageHeader;

use super::{
    channel::Channel, error::BagError, extra::Extra, layout, messages::BagMessage, metadata,
    part::Part,
};
use eddy_frames::Stamp;
use eddy_messages::type_support;

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
    /// When a file ends and the next one begins; never by default.
    pub split: Split,
}

/// When a file of a bag ends and the next one begins.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Split {
    /// Before it would take more than this, closed (bytes). A message that is longer, together with the
    /// descriptions of the topics, gets a file of its own.
    pub size: Option<u64>,
    /// Before a message logged so long after its first one.
    pub duration: Option<Duration>,
}

impl Default for WriterOptions {
    fn default() -> Self {
        let (compression, split) = (Compression::default(), Split::default());
        Self { compression, chunk_size: 1 << 20, split }
    }
}

/// Key in `custom_data` of `metadata.yaml`: messages that arrived and are not in the bag.
const NOT_RECORDED: &str = "eddy_messages_not_recorded";

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
    /// Everything that the files say about it.
    pub channel: Arc<Channel>,
}

impl WrittenTopic {
    /// A topic without a message yet.
    pub(super) fn new(channel: &Arc<Channel>) -> Self {
        Self {
            name: channel.topic.clone(),
            type_name: channel.type_name().to_owned(),
            hash: channel.type_hash().unwrap_or_default().to_owned(),
            messages: 0,
            channel: Arc::clone(channel),
        }
    }
}

/// A file that was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WrittenFile {
    /// The file.
    pub path: PathBuf,
    /// How many messages it has.
    pub messages: u64,
    /// Smallest log time, if there is a message.
    pub start: Option<Stamp>,
    /// Largest log time, if there is a message.
    pub end: Option<Stamp>,
    /// Its size (bytes).
    pub size: u64,
}

/// What was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BagSummary {
    /// The bag's directory.
    pub directory: PathBuf,
    /// The MCAP files in it, in the order of their messages.
    pub files: Vec<WrittenFile>,
    /// How many messages it has.
    pub messages: u64,
    /// How many it was given and could not keep, because no room was left.
    pub lost: u64,
    /// Smallest log time, if there is a message.
    pub start: Option<Stamp>,
    /// Largest log time, if there is a message.
    pub end: Option<Stamp>,
    /// The topics, in the order in which they were added.
    pub topics: Vec<WrittenTopic>,
    /// What else `metadata.yaml` says (`custom_data`).
    pub custom_data: BTreeMap<String, String>,
}

/// Writes one bag.
///
/// Its last file is called `*.mcap.active` until [`BagWriter::finish`]. Dropped without it, the file
/// stays under that name, complete and readable. The same calls give the same bytes.
pub struct BagWriter {
    part: Part,
    options: WriterOptions,
    directory: PathBuf,
    /// The files are called after it.
    name: String,
    finished: Vec<WrittenFile>,
    topics: Vec<WrittenTopic>,
    /// By topic: MCAP's channel id in the current file, and the messages it was given there.
    channels: Vec<(u16, u64)>,
    /// Messages that no room was left for.
    lost: u64,
    /// Messages that never came as far as here.
    not_given: u64,
    custom_data: BTreeMap<String, String>,
    /// A file could not be written on, for want of room; the bag has ended before its time.
    full: bool,
}

impl BagWriter {
    /// Creates the bag's directory and its file, which starts to exist with its header.
    ///
    /// # Errors
    /// [`BagError::Exists`] when there is something at `path`, [`BagError::NotABag`] when `path` has
    /// no last part to name the file after, [`BagError::Io`] when the system refuses.
    pub fn create(path: &Path, options: WriterOptions) -> Result<Self, BagError> {
        let name = layout::name_of(path)?;
        if fs::symlink_metadata(path).is_ok() {
            return Err(BagError::Exists { path: path.into() });
        }
        fs::create_dir_all(path).map_err(BagError::io(path, "creating the bag"))?;
        Ok(Self {
            part: Part::create(layout::numbered(path, &name, 0), &options)?,
            options,
            directory: path.into(),
            name,
            finished: Vec::new(),
            topics: Vec::new(),
            channels: Vec::new(),
            lost: 0,
            not_given: 0,
            custom_data: BTreeMap::new(),
            full: false,
        })
    }

    /// The file that is being written.
    pub fn active_file(&self) -> &Path {
        self.part.active()
    }

    /// How many messages were written.
    pub fn messages(&self) -> u64 {
        self.topics.iter().map(|topic| topic.messages).sum()
    }

    /// The topics so far, in the order in which they were added.
    pub fn topics(&self) -> &[WrittenTopic] {
        &self.topics
    }

    /// Has `metadata.yaml` say one more thing.
    pub fn note(&mut self, key: &str, value: String) {
        self.custom_data.insert(key.to_owned(), value);
    }

    /// Has `metadata.yaml` say that so many messages arrived and were not given to the bag, beside those
    /// that it could not keep.
    pub fn note_not_given(&mut self, messages: u64) {
        self.not_given += messages;
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

    /// Adds a topic of any type: `schema` is its `.msg` text with that of every dependency (empty if
    /// unknown), `hash` its RIHS01 type hash (empty if unknown).
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
        self.kept_topic(name, type_name, schema, hash, 0)
    }

    /// Adds a topic of any type, whose publishers keep the last `kept` messages for subscribers that come
    /// later (transient local).
    ///
    /// # Errors
    /// As [`BagWriter::topic`].
    pub fn kept_topic(
        &mut self,
        name: &str,
        type_name: &str,
        schema: &str,
        hash: &str,
        kept: usize,
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
        self.channel(&Arc::new(Channel::ros(name, type_name, schema, hash, kept)))
    }

    /// Adds a topic as another writer described it, or gives the id it already has. Equal topics with
    /// other descriptions are other topics here, as they are in MCAP.
    ///
    /// # Errors
    /// As [`BagWriter::write`].
    pub fn channel(&mut self, channel: &Arc<Channel>) -> Result<TopicId, BagError> {
        let known = self
            .topics
            .iter()
            .position(|topic| Arc::ptr_eq(&topic.channel, channel) || topic.channel == *channel);
        if let Some(known) = known {
            return Ok(TopicId(known));
        }
        let size = self.options.split.size;
        if self.part.start().is_some()
            && size.is_some_and(|most| self.part.closed_size_with_channel(channel) > most)
        {
            self.split()?;
        }
        let id = self.part.declare(channel);
        let id = self.noted(id)?;
        self.channels.push((id, 0));
        self.topics.push(WrittenTopic::new(channel));
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
        let sequence = (self.topics[topic.0].messages + 1) as u32;
        self.append(topic, sequence, log_time, publish_time, cdr)
    }

    /// Appends a message of another bag with its number and its times.
    ///
    /// # Errors
    /// As [`BagWriter::write`].
    pub fn copy(&mut self, topic: TopicId, message: &BagMessage) -> Result<(), BagError> {
        let BagMessage { sequence, log_time, publish_time, data, .. } = message;
        self.append(topic, *sequence, *log_time, *publish_time, data)
    }

    fn append(
        &mut self,
        topic: TopicId,
        sequence: u32,
        log_time: Stamp,
        publish_time: Stamp,
        data: &[u8],
    ) -> Result<(), BagError> {
        let TopicId(index) = topic;
        let times = (
            self.nanoseconds(index, "log_time", log_time)?,
            self.nanoseconds(index, "publish_time", publish_time)?,
        );
        if self.must_split(log_time, data.len() as u64) {
            self.split()?;
        }
        let (channel_id, _) = self.channels[index];
        let (log, publish_time) = times;
        let header = MessageHeader { channel_id, sequence, log_time: log, publish_time };
        // Also what fails on its way to the disk was given to the bag.
        self.topics[index].messages += 1;
        self.channels[index].1 += 1;
        let written = self.part.write(&header, log_time, data);
        self.noted(written)
    }

    /// Writes an attachment or a metadata record of another bag.
    ///
    /// # Errors
    /// As [`BagWriter::write`].
    pub(super) fn attach(&mut self, extra: &Extra) -> Result<(), BagError> {
        let attached = self.part.attach(extra);
        self.noted(attached)
    }

    fn must_split(&self, log_time: Stamp, length: u64) -> bool {
        let Some(start) = self.part.start() else { return false };
        let Split { size, duration } = self.options.split;
        let elapsed = u128::try_from(log_time.0 - start.0).unwrap_or_default();
        size.is_some_and(|most| self.part.closed_size_with(length) > most)
            || duration.is_some_and(|most| elapsed >= most.as_nanos())
    }

    /// Ends the file and begins the next one, which knows the same topics.
    fn split(&mut self) -> Result<(), BagError> {
        let number = self.finished.len() + 1;
        let path = layout::numbered(&self.directory, &self.name, number);
        let next = Part::create(path, &self.options);
        let next = self.noted(next)?;
        let done = std::mem::replace(&mut self.part, next);
        match done.finish() {
            Ok(file) => self.finished.push(file),
            Err(failed) => {
                let (error, unclosed) = *failed;
                self.full |= error.is_no_room();
                if self.full {
                    let (file, kept) = unclosed.close_in_the_room_there_is()?;
                    self.finished.push(file);
                    self.lost += lost(&mut self.topics, &mut self.channels, &kept);
                }
                return Err(error);
            }
        }
        let topics = self.topics.iter().map(|topic| Arc::clone(&topic.channel));
        let channels: Vec<_> = topics.collect();
        for (index, channel) in channels.iter().enumerate() {
            let id = self.part.declare(channel);
            self.channels[index] = (self.noted(id)?, 0);
        }
        Ok(())
    }

    /// Remembers whether it failed for want of room.
    fn noted<T>(&mut self, outcome: Result<T, BagError>) -> Result<T, BagError> {
        if let Err(error) = &outcome {
            self.full |= error.is_no_room();
        }
        outcome
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
        let flushed = self.part.flush();
        self.noted(flushed)
    }

    /// Ends the file, gives it its name and writes `metadata.yaml`.
    ///
    /// When no room is left on the disk, now or when a message was written, the last file ends after
    /// the chunks that fit; [`BagSummary::lost`] says what that costs.
    ///
    /// # Errors
    /// [`BagError::Io`] and [`BagError::Format`]. The file then keeps the name `*.active`.
    pub fn finish(self) -> Result<BagSummary, BagError> {
        let Self { part, directory, finished: mut files, mut topics, mut channels, .. } = self;
        let mut custom_data = self.custom_data;
        let mut lost_here = 0;
        files.push(match part.finish() {
            Ok(file) => file,
            Err(failed) => {
                let (error, unclosed) = *failed;
                if !self.full && !error.is_no_room() {
                    return Err(error);
                }
                let (file, kept) = unclosed.close_in_the_room_there_is()?;
                lost_here = lost(&mut topics, &mut channels, &kept);
                file
            }
        });
        let lost = self.lost + lost_here;
        if self.not_given + lost > 0 {
            custom_data.insert(NOT_RECORDED.to_owned(), (self.not_given + lost).to_string());
        }
        let summary = BagSummary {
            directory,
            messages: files.iter().map(|file| file.messages).sum(),
            lost,
            start: files.iter().filter_map(|file| file.start).min(),
            end: files.iter().filter_map(|file| file.end).max(),
            files,
            topics,
            custom_data,
        };
        metadata::write(&summary)?;
        Ok(summary)
    }
}

/// Takes from the counts of the topics what a file was given and could not keep; how much that is.
fn lost(
    topics: &mut [WrittenTopic],
    channels: &mut [(u16, u64)],
    kept: &BTreeMap<u16, u64>,
) -> u64 {
    let mut lost = 0;
    for (topic, (channel, given)) in topics.iter_mut().zip(channels) {
        let missing = given.saturating_sub(kept.get(channel).copied().unwrap_or_default());
        topic.messages -= missing;
        lost += missing;
        *given = 0;
    }
    lost
}
