//! Topics, messages and frames of a bag.

use std::{
    collections::BTreeSet,
    marker::PhantomData,
    path::{Path, PathBuf},
    sync::Arc,
};

use mcap::records::op;

use super::{
    auxiliary::AuxiliaryRecord,
    contents::{Contents, FileChannel, TopicInfo},
    index::FileIndex,
    kept,
    messages::{BagMessage, Messages, Selection},
    open::Source,
};
use crate::{
    error::BagError,
    format::{
        channel::Channel, custom_data::CustomData, description::Description, layout,
        summary::WrittenTopic,
    },
};
use eddy_frames::{Frame, Stamp};
use eddy_messages::{FrameCdr, Message, ParticleFrame, cdr::place_of_frame};

/// A bag opened for reading. Cheap to clone.
///
/// Files with a summary section are indexed from it. Files without one (still being written, truncated, or
/// from other programs) are scanned when the bag is opened.
#[derive(Clone, Debug)]
pub struct BagReader {
    contents: Arc<Contents>,
}

impl BagReader {
    /// Opens a bag directory, an `.mcap` file or an `.mcap.active` file.
    ///
    /// # Errors
    /// [`BagError::Io`], [`BagError::NotABag`], [`BagError::Metadata`], [`BagError::Magic`]. A bag
    /// with damage after its first bytes can be opened: [`BagReader::damage`] returns the damage, and its
    /// messages end with the error.
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let (files, in_yaml) = layout::files_of(path)?;
        let files = files.iter().enumerate();
        let files = files.map(|(number, file)| FileIndex::open(file, number));
        Ok(Self::from_files(path, files.collect::<Result<_, _>>()?, in_yaml))
    }

    /// Indexed files, in this order, as the bag `path`, which `metadata.yaml` describes as `in_yaml`.
    pub(crate) fn from_files(
        path: &Path,
        files: Vec<FileIndex>,
        in_yaml: Option<Description>,
    ) -> Self {
        Self { contents: Arc::new(Contents::new(path, files, in_yaml)) }
    }

    pub(super) fn contents(&self) -> &Contents {
        &self.contents
    }

    /// For each file, what it says twice and differently, and the number of further cases. Files that were not scanned are scanned.
    pub(super) fn contradictions(
        &self,
    ) -> impl Iterator<Item = Result<(Vec<BagError>, u64), BagError>> {
        self.contents.files.iter().map(|file| {
            let listed = |file: &FileIndex| {
                let (found, further) = file.contradictions();
                (found.collect(), further)
            };
            if file.scanned {
                return Ok(listed(file));
            }
            let scanned = FileIndex::open_by(&file.path, file.number, Source::Scan, &mut |_| true)?;
            Ok(listed(&scanned))
        })
    }

    /// The path it was opened with.
    pub fn path(&self) -> &Path {
        &self.contents.path
    }

    /// The MCAP files.
    pub fn files(&self) -> impl Iterator<Item = &Path> {
        self.contents.files.iter().map(|file| file.path.as_path())
    }

    /// `custom_data` in its `metadata.yaml`, and beyond that in the metadata records of rosbag2 in its files.
    pub fn custom_data(&self) -> &CustomData {
        &self.contents.described.custom_data
    }

    /// Distribution of ROS that recorded it, by the same sources; empty if unknown.
    pub(crate) fn distro(&self) -> &str {
        &self.contents.described.distro
    }

    /// Total size of the MCAP files (bytes).
    pub fn size(&self) -> u64 {
        self.contents.files.iter().map(|file| file.size).sum()
    }

    /// Compressions of the chunks, each once: `zstd`, `lz4` or `none`.
    pub fn compressions(&self) -> BTreeSet<&str> {
        let names = self.contents.files.iter().flat_map(|file| &file.compressions);
        names.map(|name| if name.is_empty() { "none" } else { name }).collect()
    }

    /// Whether a file is still being written, or its writer was killed.
    pub fn is_unfinished(&self) -> bool {
        self.files().any(layout::is_active)
    }

    /// The first damage found when the bag was opened. Reading may find more.
    pub fn damage(&self) -> Option<BagError> {
        self.contents.damage()
    }

    /// The topics, sorted by name. A topic with messages of two types is listed twice. Versions of a type are told apart
    /// by [`BagReader::channels`].
    pub fn topics(&self) -> &[TopicInfo] {
        &self.contents.topics
    }

    /// The index in [`BagReader::channels`] of the channel of a message of this bag, and that in [`BagReader::topics`] of its topic;
    /// `None` for a message of another bag.
    pub(super) fn place_of(&self, message: &BagMessage) -> Option<(usize, usize)> {
        let mut channels = self.contents.distinct.iter();
        let number = channels.position(|channel| Arc::ptr_eq(channel, &message.channel))?;
        Some((number, self.contents.topic_of[number]))
    }

    /// The channels, in the order of the files and of the channel ids. A topic that several writers described
    /// differently has several channels.
    pub fn channels(&self) -> &[Arc<Channel>] {
        &self.contents.distinct
    }

    /// Each channel with its messages.
    pub(crate) fn written_topics(&self) -> Vec<WrittenTopic> {
        let Contents { files, channels, distinct, .. } = &*self.contents;
        let mut topics: Vec<_> = distinct.iter().map(WrittenTopic::new).collect();
        for (file, channels) in files.iter().zip(channels) {
            for (key, FileChannel { channel, .. }) in channels {
                let number = distinct.iter().position(|known| Arc::ptr_eq(known, channel));
                if let Some(number) = number {
                    topics[number].messages += file.counts.get(key).copied().unwrap_or_default();
                }
            }
        }
        topics
    }

    /// Number of messages.
    pub fn message_count(&self) -> u64 {
        self.topics().iter().map(|topic| topic.message_count).sum()
    }

    /// Smallest log time; `None` without messages.
    pub fn start(&self) -> Option<Stamp> {
        let first =
            self.contents.files.iter().filter_map(|file| file.times).map(|(first, _)| first);
        first.min().map(saturated)
    }

    /// Largest log time; `None` without messages.
    pub fn end(&self) -> Option<Stamp> {
        let last = self.contents.files.iter().filter_map(|file| file.times).map(|(_, last)| last);
        last.max().map(saturated)
    }

    /// Time from the first to the last message (s).
    pub fn duration(&self) -> f64 {
        match (self.start(), self.end()) {
            (Some(start), Some(end)) => Stamp(end.0 - start.0).seconds(),
            _ => 0.0,
        }
    }

    /// Number of attachments, and of metadata records.
    pub fn auxiliary_counts(&self) -> [usize; 2] {
        [op::ATTACHMENT, op::METADATA].map(|opcode| {
            let records = self.contents.files.iter().flat_map(|file| &file.auxiliary);
            records.filter(|record| record.opcode == opcode).count()
        })
    }

    /// The attachments and metadata records, in the order of the files.
    pub(crate) fn auxiliary(&self) -> impl Iterator<Item = Result<AuxiliaryRecord, BagError>> {
        self.contents.files.iter().flat_map(|file| {
            file.auxiliary
                .iter()
                .map(|record| AuxiliaryRecord::read(&file.path, &file.file, record))
        })
    }

    /// All messages, in the order of their log time.
    pub fn messages(&self) -> Messages {
        self.select(&Selection::default())
    }

    /// The selected messages, in the order of their log time.
    pub fn select(&self, selection: &Selection) -> Messages {
        Messages::new(self.contents.clone(), selection)
    }

    /// The messages that transient-local publishers have kept at `at` for late subscribers: of each topic the last ones
    /// before, as many as `depth_of` says, in the order of their log time; then the damage that was met. Only the chunks
    /// that hold them are read, as far as the index names the topics of each chunk.
    pub fn kept_at(
        &self,
        at: Stamp,
        depth_of: impl Fn(&TopicInfo) -> usize,
    ) -> Vec<Result<BagMessage, BagError>> {
        kept::kept_at(&self.contents, at, depth_of)
    }

    /// The messages of a topic of type `type_name`, in the order of their log time.
    ///
    /// # Errors
    /// [`BagError::NoTopic`] when the bag does not have the topic, [`BagError::TopicType`] when it has another
    /// type, [`BagError::NoMessages`] when it is empty; the damage of the bag when nothing of the topic is left.
    pub fn messages_of(&self, topic: &str, type_name: &str) -> Result<Messages, BagError> {
        let path = self.path();
        let of_topic: Vec<_> = self.topics().iter().filter(|info| info.name == topic).collect();
        if of_topic.is_empty() {
            let found = self.list_topics();
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

    /// The frames of a topic, of two dimensions, in the order of their log time.
    ///
    /// # Errors
    /// As [`BagReader::messages_of`] with the type `eddy_msgs/msg/ParticleFrame`.
    pub fn frames(&self, topic: &str) -> Result<Frames, BagError> {
        self.frames_of(topic)
    }

    /// The same of three dimensions, as `Frame<3>`, or of either, as [`AnyFrame`](eddy_frames::AnyFrame).
    ///
    /// # Errors
    /// As [`BagReader::frames`].
    pub fn frames_of<F: FrameCdr>(&self, topic: &str) -> Result<Frames<F>, BagError> {
        let messages = self.messages_of(topic, ParticleFrame::TYPE)?;
        Ok(self.frames_in(messages, topic))
    }

    /// The frames of a topic with log times from `from` to `until`, inclusive. Only the chunks that contain them
    /// are read.
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

    fn frames_in<F>(&self, messages: Messages, topic: &str) -> Frames<F> {
        let (path, log_time) = (self.path().into(), Stamp::default());
        Frames { messages, path, topic: topic.into(), read: 0, log_time, frame: PhantomData }
    }

    /// The topics with their types, for error messages.
    fn list_topics(&self) -> String {
        if self.topics().is_empty() {
            return "no topic".to_owned();
        }
        let describe = |topic: &TopicInfo| format!("{} ({})", topic.name, topic.type_name);
        self.topics().iter().map(describe).collect::<Vec<_>>().join(", ")
    }
}

/// Times beyond the range of ROS are an error when the messages are read.
fn saturated(time: u64) -> Stamp {
    Stamp(i64::try_from(time).unwrap_or(i64::MAX))
}

/// The frames of a topic. A message that is not a valid frame, or one of another dimension, is a [`BagError::Frame`], followed by the
/// other frames. Damage of the bag comes last.
#[derive(Debug)]
pub struct Frames<F = Frame> {
    messages: Messages,
    path: PathBuf,
    topic: String,
    read: u64,
    log_time: Stamp,
    frame: PhantomData<F>,
}

impl<F> Frames<F> {
    /// Log time of the last frame; zero before the first.
    pub fn log_time(&self) -> Stamp {
        self.log_time
    }
}

impl<F: FrameCdr> Iterator for Frames<F> {
    type Item = Result<F, BagError>;

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
        Some(F::from_cdr(&data).map_err(|reason| BagError::Frame {
            path: self.path.clone(),
            topic: self.topic.clone(),
            message,
            place: place_of_frame(&data),
            reason: Box::new(reason),
        }))
    }
}
