//! A bag to read: its topics, its messages, its frames.

use std::{
    collections::{BTreeMap, BTreeSet, HashSet},
    path::{Path, PathBuf},
    sync::Arc,
};

use mcap::records::op;

use super::{
    channel::Channel,
    error::BagError,
    extra::Extra,
    index::FileIndex,
    layout,
    messages::{Messages, Selection},
};
use eddy_frames::{Frame, Stamp};
use eddy_messages::{FrameCdr, Message, ParticleFrame};

/// A topic of a bag.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicInfo {
    /// Its name.
    pub name: String,
    /// The type of its messages; empty if the bag does not tell.
    pub type_name: String,
    /// The type's definition: `.msg` text with that of every dependency, where eddy wrote it.
    pub schema: String,
    /// RIHS01 type hash, if the bag tells.
    pub hash: Option<String>,
    /// How many messages it has.
    pub message_count: u64,
    /// How many messages its publishers kept for subscribers that came later (transient local).
    pub kept: usize,
}

/// A topic's name and type, shared by its messages.
#[derive(Debug)]
pub(super) struct TopicNames {
    pub(super) name: Arc<str>,
    pub(super) type_name: Arc<str>,
}

/// A channel of a file: the topic it belongs to, by number, and its description.
#[derive(Debug)]
pub(super) struct ChannelOfFile {
    pub(super) topic: usize,
    pub(super) channel: Arc<Channel>,
}

/// What opening a bag found out.
#[derive(Debug)]
pub(super) struct Contents {
    pub(super) path: PathBuf,
    pub(super) files: Vec<FileIndex>,
    /// Sorted by name, then by type.
    pub(super) topics: Vec<TopicInfo>,
    /// For each topic.
    pub(super) names: Vec<TopicNames>,
    /// For each file, by MCAP's channel id. Equal channels of several files are the same.
    pub(super) channels: Vec<BTreeMap<u16, ChannelOfFile>>,
    /// Each channel once, in the order of the files and of their ids.
    distinct: Vec<Arc<Channel>>,
}

impl Contents {
    /// The first damage known from opening.
    pub(super) fn damage(&self) -> Option<BagError> {
        self.files.iter().flat_map(FileIndex::faults).next()
    }
}

/// A bag opened for reading. Cheap to clone.
///
/// Files with a summary are opened through it; files without one (still being written, cut, or by
/// other programs) are read once when they are opened.
#[derive(Clone, Debug)]
pub struct BagReader {
    contents: Arc<Contents>,
}

impl BagReader {
    /// Opens a bag directory, an `.mcap` file or an `.mcap.active` file.
    ///
    /// # Errors
    /// [`BagError::Io`], [`BagError::NotABag`], [`BagError::Metadata`], [`BagError::Magic`]. A bag
    /// that is damaged further inside opens; [`BagReader::damage`] tells, and reading it ends with
    /// the error.
    pub fn open(path: &Path) -> Result<Self, BagError> {
        Self::open_files(path, &layout::files_of(path)?)
    }

    fn open_files(path: &Path, files: &[PathBuf]) -> Result<Self, BagError> {
        let files = files.iter().enumerate();
        let files = files.map(|(number, file)| FileIndex::open(file, number));
        Ok(Self::of_files(path, files.collect::<Result<_, _>>()?))
    }

    /// These files, numbered in their order, as one bag that is called `path`.
    pub(super) fn of_files(path: &Path, files: Vec<FileIndex>) -> Self {
        let mut topics = BTreeMap::new();
        for file in &files {
            for (id, channel) in &file.channels {
                let key = (channel.topic.as_str(), channel.type_name());
                let topic = topics.entry(key).or_insert_with(|| TopicInfo {
                    name: channel.topic.clone(),
                    type_name: channel.type_name().to_owned(),
                    schema: channel.definition(),
                    hash: channel.type_hash().map(str::to_owned),
                    message_count: 0,
                    kept: 0,
                });
                topic.kept = topic.kept.max(channel.kept());
                topic.message_count += file.counts.get(id).copied().unwrap_or_default();
            }
        }
        let topics: Vec<TopicInfo> = topics.into_values().collect();
        let mut distinct = IndexedChannels::default();
        let channels = files
            .iter()
            .map(|file| {
                let of_file = |(id, channel): (&u16, &Arc<Channel>)| {
                    let is_its = |topic: &TopicInfo| {
                        topic.name == channel.topic && topic.type_name == channel.type_name()
                    };
                    let topic = topics.iter().position(is_its)?;
                    Some((*id, ChannelOfFile { topic, channel: distinct.share(channel) }))
                };
                file.channels.iter().filter_map(of_file).collect()
            })
            .collect();
        let distinct = distinct.in_order;
        let names = topics
            .iter()
            .map(|topic| TopicNames {
                name: topic.name.as_str().into(),
                type_name: topic.type_name.as_str().into(),
            })
            .collect();
        let path = path.into();
        let contents = Contents { path, files, topics, names, channels, distinct };
        Self { contents: Arc::new(contents) }
    }

    /// The path it was opened with.
    pub fn path(&self) -> &Path {
        &self.contents.path
    }

    /// Its MCAP files.
    pub fn files(&self) -> impl Iterator<Item = &Path> {
        self.contents.files.iter().map(|file| file.path.as_path())
    }

    /// Size of its MCAP files together (bytes).
    pub fn size(&self) -> u64 {
        self.contents.files.iter().map(|file| file.size).sum()
    }

    /// How its chunks are compressed: `zstd`, `lz4` or `none`, each once.
    pub fn compressions(&self) -> BTreeSet<&str> {
        let names = self.contents.files.iter().flat_map(|file| &file.compressions);
        names.map(|name| if name.is_empty() { "none" } else { name }).collect()
    }

    /// Whether a file of it is still being written, or was left so.
    pub fn is_unfinished(&self) -> bool {
        self.files().any(layout::is_active)
    }

    /// What opening it found damaged, if anything. Reading finds the rest.
    pub fn damage(&self) -> Option<BagError> {
        self.contents.damage()
    }

    /// Its topics, sorted by name. A topic with messages of two types is there twice.
    pub fn topics(&self) -> &[TopicInfo] {
        &self.contents.topics
    }

    /// Its topics as their writers described them, in the order of the files and of their ids. A topic
    /// that several writers described differently is there several times.
    pub fn channels(&self) -> &[Arc<Channel>] {
        &self.contents.distinct
    }

    /// How many messages it has.
    pub fn message_count(&self) -> u64 {
        self.topics().iter().map(|topic| topic.message_count).sum()
    }

    /// Smallest log time, if there is a message.
    pub fn start(&self) -> Option<Stamp> {
        let first =
            self.contents.files.iter().filter_map(|file| file.times).map(|(first, _)| first);
        first.min().map(saturated)
    }

    /// Largest log time, if there is a message.
    pub fn end(&self) -> Option<Stamp> {
        let last = self.contents.files.iter().filter_map(|file| file.times).map(|(_, last)| last);
        last.max().map(saturated)
    }

    /// From the first to the last message (s).
    pub fn duration(&self) -> f64 {
        match (self.start(), self.end()) {
            (Some(start), Some(end)) => Stamp(end.0 - start.0).seconds(),
            _ => 0.0,
        }
    }

    /// How many attachments it has, and how many metadata records.
    pub fn extra_counts(&self) -> [usize; 2] {
        [op::ATTACHMENT, op::METADATA].map(|opcode| {
            let extras = self.contents.files.iter().flat_map(|file| &file.extras);
            extras.filter(|extra| extra.opcode == opcode).count()
        })
    }

    /// Its attachments and metadata records, in the order of the files.
    pub(super) fn extras(&self) -> impl Iterator<Item = Result<Extra, BagError>> {
        self.contents
            .files
            .iter()
            .flat_map(|file| file.extras.iter().map(|extra| Extra::read(&file.path, extra)))
    }

    /// All messages, in the order of their log time.
    pub fn messages(&self) -> Messages {
        self.select(&Selection::default())
    }

    /// The selected messages, in the order of their log time.
    pub fn select(&self, selection: &Selection) -> Messages {
        Messages::new(self.contents.clone(), selection)
    }

    /// The messages of a topic, which must have the given type, in the order of their log time.
    ///
    /// # Errors
    /// [`BagError::NoTopic`] when the bag lacks the topic, [`BagError::TopicType`] when it carries
    /// another type, [`BagError::NoMessages`] when it is empty; when the bag is damaged so that
    /// nothing of the topic is left, that damage.
    pub fn messages_of(&self, topic: &str, type_name: &str) -> Result<Messages, BagError> {
        let path = self.path();
        let of_topic: Vec<_> = self.topics().iter().filter(|info| info.name == topic).collect();
        if of_topic.is_empty() {
            let found = self.topics_in_words();
            let none = BagError::NoTopic { path: path.into(), topic: topic.into(), found };
            return Err(if self.topics().is_empty() {
                self.damage().unwrap_or(none)
            } else {
                none
            });
        }
        if let Some(other) = of_topic.iter().find(|info| info.type_name != type_name) {
            return Err(BagError::TopicType {
                path: path.into(),
                topic: topic.into(),
                found: other.type_name.clone(),
                expected: type_name.into(),
            });
        }
        if of_topic.iter().all(|info| info.message_count == 0) {
            let none = BagError::NoMessages { path: path.into(), topic: topic.into() };
            return Err(self.damage().unwrap_or(none));
        }
        let topics = Some(vec![topic.into()]);
        Ok(self.select(&Selection { topics, ..Selection::default() }))
    }

    /// The frames of a topic, in the order of their log time.
    ///
    /// # Errors
    /// As [`BagReader::messages_of`] with the type `eddy_msgs/msg/ParticleFrame`.
    pub fn frames(&self, topic: &str) -> Result<Frames, BagError> {
        let messages = self.messages_of(topic, ParticleFrame::TYPE)?;
        Ok(self.frames_in(messages, topic))
    }

    /// The frames of a topic that were logged from `from` to `until`, both included. Only the pieces
    /// of the files that hold them are read.
    ///
    /// # Errors
    /// As [`BagReader::frames`].
    pub fn frames_between(
        &self,
        topic: &str,
        from: Stamp,
        until: Stamp,
    ) -> Result<Frames, BagError> {
        self.messages_of(topic, ParticleFrame::TYPE)?;
        let topics = Some(vec![topic.into()]);
        let (from, until) = (Some(from), Some(until));
        Ok(self.frames_in(self.select(&Selection { topics, from, until }), topic))
    }

    fn frames_in(&self, messages: Messages, topic: &str) -> Frames {
        let path = self.path().into();
        Frames { messages, path, topic: topic.into(), read: 0, log_time: Stamp::default() }
    }

    /// For messages: each topic with its type.
    fn topics_in_words(&self) -> String {
        if self.topics().is_empty() {
            return "no topic".to_owned();
        }
        let words = |topic: &TopicInfo| format!("{} ({})", topic.name, topic.type_name);
        self.topics().iter().map(words).collect::<Vec<_>>().join(", ")
    }
}

/// Channels, each once.
#[derive(Default)]
struct IndexedChannels {
    known: HashSet<Arc<Channel>>,
    in_order: Vec<Arc<Channel>>,
}

impl IndexedChannels {
    /// The one that equals `channel`.
    fn share(&mut self, channel: &Arc<Channel>) -> Arc<Channel> {
        if let Some(known) = self.known.get(channel) {
            return Arc::clone(known);
        }
        self.known.insert(Arc::clone(channel));
        self.in_order.push(Arc::clone(channel));
        Arc::clone(channel)
    }
}

/// Times that ROS cannot tell are found when the messages are read.
fn saturated(time: u64) -> Stamp {
    Stamp(i64::try_from(time).unwrap_or(i64::MAX))
}

/// The frames of a topic. A message that is no usable frame is an [`BagError::Frame`]; the frames
/// after it follow. Damage of the bag comes last.
#[derive(Debug)]
pub struct Frames {
    messages: Messages,
    path: PathBuf,
    topic: String,
    read: u64,
    log_time: Stamp,
}

impl Frames {
    /// Log time of the message that came last; zero before the first.
    pub fn log_time(&self) -> Stamp {
        self.log_time
    }
}

impl Iterator for Frames {
    type Item = Result<Frame, BagError>;

    fn next(&mut self) -> Option<Self::Item> {
        let data = match self.messages.next()? {
            Ok(message) => {
                self.log_time = message.log_time;
                message.data
            }
            Err(error) => return Some(Err(error)),
        };
        let message = self.read;
        self.read += 1;
        Some(Frame::from_cdr(&data).map_err(|reason| BagError::Frame {
            path: self.path.clone(),
            topic: self.topic.clone(),
            message,
            reason,
        }))
    }
}
