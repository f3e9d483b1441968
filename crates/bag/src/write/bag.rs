//! Writes messages into a bag as rosbag2 does: a directory of MCAP files, split by size and duration.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    sync::Arc,
};

use mcap::records::MessageHeader;

use super::{
    file::FileWriter,
    options::{Split, WriterOptions},
};
use crate::{
    error::BagError,
    format::{
        channel::Channel,
        custom_data::MESSAGES_NOT_RECORDED,
        layout, metadata,
        summary::{BagSummary, OURS, WrittenFile, WrittenTopic},
    },
    read::{auxiliary::AuxiliaryRecord, index::ChannelKey, messages::BagMessage},
};
use eddy_frames::Stamp;
use eddy_messages::{QosProfile, TypeSupport, type_support};

/// A topic of one [`BagWriter`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct TopicId(usize);

/// Writes one bag.
///
/// The file being written is called `*.mcap.active` until [`BagWriter::finish`]. Dropped before, it keeps that
/// name and is complete and readable. Equal calls give equal bytes.
pub struct BagWriter {
    file: FileWriter,
    options: WriterOptions,
    directory: PathBuf,
    /// Prefix of the file names.
    name: String,
    finished: Vec<WrittenFile>,
    topics: Vec<WrittenTopic>,
    /// For each topic, the channel id in the current file and the number of messages written there.
    channels: Vec<(u16, u64)>,
    /// Messages that did not fit on the disk.
    lost: u64,
    /// Messages that were received and not passed to the writer.
    dropped: u64,
    custom_data: BTreeMap<String, String>,
    distro: String,
    /// Whether the disk is full: the bag ends early.
    disk_full: bool,
    /// Where times of [`BagWriter::write_stamped`] count from.
    zero: Option<Stamp>,
}

impl BagWriter {
    /// Creates the bag directory and its first file.
    ///
    /// # Errors
    /// [`BagError::Exists`] when `path` exists, [`BagError::NotABag`] when it does not end in a name for the
    /// files, [`BagError::Io`].
    pub fn create(path: &Path, options: WriterOptions) -> Result<Self, BagError> {
        let name = layout::name_of(path)?;
        if fs::symlink_metadata(path).is_ok() {
            return Err(BagError::Exists { path: path.into() });
        }
        fs::create_dir_all(path).map_err(BagError::io(path, "creating the bag"))?;
        Ok(Self {
            file: FileWriter::create(layout::numbered(path, &name, 0), &options)?,
            options,
            directory: path.into(),
            name,
            finished: Vec::new(),
            topics: Vec::new(),
            channels: Vec::new(),
            lost: 0,
            dropped: 0,
            custom_data: BTreeMap::new(),
            distro: OURS.to_owned(),
            disk_full: false,
            zero: None,
        })
    }

    /// Path of the file being written.
    pub fn active_file(&self) -> &Path {
        self.file.active()
    }

    /// Number of messages written.
    pub fn messages(&self) -> u64 {
        self.topics.iter().map(|topic| topic.messages).sum()
    }

    /// The topics so far, in the order in which they were added.
    pub fn topics(&self) -> &[WrittenTopic] {
        &self.topics
    }

    /// Sets the distribution of ROS with which the messages were recorded.
    pub(crate) fn set_distro(&mut self, distro: String) {
        self.distro = distro;
    }

    /// Sets entries of `custom_data` in `metadata.yaml`.
    pub fn extend_custom_data(&mut self, entries: impl IntoIterator<Item = (String, String)>) {
        self.custom_data.extend(entries);
    }

    /// Sets an entry of `custom_data` in `metadata.yaml`.
    pub fn set_custom_data(&mut self, key: &str, value: String) {
        self.custom_data.insert(key.to_owned(), value);
    }

    /// Counts messages that were received and not passed to the writer: `metadata.yaml` states their number,
    /// together with that of messages that did not fit on the disk.
    pub fn count_dropped(&mut self, messages: u64) {
        self.dropped += messages;
    }

    /// Adds a topic with a message type of eddy-messages, or returns its id if it exists.
    ///
    /// # Errors
    /// [`BagError::Type`] when the type is unknown, [`BagError::TopicType`] when the topic exists with another
    /// type, otherwise as [`BagWriter::write`].
    pub fn topic(&mut self, name: &str, type_name: &str) -> Result<TopicId, BagError> {
        let support = type_support(type_name)
            .map_err(|reason| BagError::Type { topic: name.into(), reason })?;
        self.offered_topic(name, support, &[QosProfile::usual(type_name)])
    }

    /// Adds a topic of any type, whose publishers offer `offered`, or returns its id if it exists.
    ///
    /// # Errors
    /// As [`BagWriter::topic`].
    pub fn offered_topic(
        &mut self,
        name: &str,
        of: &TypeSupport,
        offered: &[QosProfile],
    ) -> Result<TopicId, BagError> {
        let type_name = &of.name;
        if let Some(known) = self.topics.iter().position(|topic| topic.name == name) {
            if self.topics[known].type_name != *type_name {
                return Err(BagError::TopicType {
                    path: self.directory.clone(),
                    topic: name.into(),
                    found: type_name.clone(),
                    expected: self.topics[known].type_name.clone(),
                });
            }
            return Ok(TopicId(known));
        }
        self.channel(&Arc::new(Channel::ros(name, of, offered)))
    }

    /// Adds a channel of another bag, or returns its id if it exists. As in MCAP, a topic may have several
    /// channels.
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
        if self.file.start().is_some()
            && size.is_some_and(|most| self.file.finished_size_with_channel(channel) > most)
        {
            self.split()?;
        }
        let id = self.file.add_channel(channel);
        let id = self.check_disk(id)?;
        self.channels.push((id, 0));
        self.topics.push(WrittenTopic::new(channel));
        Ok(TopicId(self.topics.len() - 1))
    }

    /// Appends a message: `cdr` with its 4-byte header, the times of reception and of publication. Messages of
    /// a topic are numbered from 1.
    ///
    /// # Errors
    /// [`BagError::NegativeTime`] for times before 0; the message is not written, the bag stays usable.
    /// [`BagError::Io`] and [`BagError::Format`] when writing failed: nothing more can be written, complete
    /// chunks stay in the file.
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

    /// Appends a message of simulated time, so that two runs give equal files: its times are `stamp`. MCAP's times are unsigned:
    /// if the first stamp is before 0, times count from there. The stamp in the message stays.
    ///
    /// # Errors
    /// As [`BagWriter::write`], but for times before 0.
    pub fn write_stamped(
        &mut self,
        topic: TopicId,
        stamp: Stamp,
        cdr: &[u8],
    ) -> Result<(), BagError> {
        let Stamp(zero) = *self.zero.get_or_insert(stamp.min(Stamp(0)));
        // Another stream may begin earlier still.
        let time = Stamp(stamp.0.saturating_sub(zero).max(0));
        self.write(topic, time, time, cdr)
    }

    /// Appends a message of another bag with its sequence number and times.
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
        // Counted before it is written: `finish` subtracts what did not reach the disk.
        self.topics[index].messages += 1;
        self.channels[index].1 += 1;
        let written = self.file.write(&header, log_time, data);
        self.check_disk(written)
    }

    /// Writes an attachment or a metadata record of another bag.
    ///
    /// # Errors
    /// As [`BagWriter::write`].
    pub(crate) fn write_auxiliary(&mut self, record: &AuxiliaryRecord) -> Result<(), BagError> {
        let written = self.file.write_auxiliary(record);
        self.check_disk(written)
    }

    fn must_split(&self, log_time: Stamp, length: u64) -> bool {
        let Some(start) = self.file.start() else { return false };
        let Split { size, duration } = self.options.split;
        let elapsed = u128::try_from(log_time.0 - start.0).unwrap_or_default();
        size.is_some_and(|most| self.file.finished_size_with_message(length) > most)
            || duration.is_some_and(|most| elapsed >= most.as_nanos())
    }

    /// Finishes the file and starts the next one with the same channels.
    fn split(&mut self) -> Result<(), BagError> {
        let number = self.finished.len() + 1;
        let path = layout::numbered(&self.directory, &self.name, number);
        let next = FileWriter::create(path, &self.options);
        let next = self.check_disk(next)?;
        let done = std::mem::replace(&mut self.file, next);
        match done.finish() {
            Ok(file) => self.finished.push(file),
            Err(failed) => {
                let (error, unfinished) = *failed;
                self.disk_full |= error.is_disk_full();
                if self.disk_full {
                    let (file, kept) = unfinished.finish_on_full_disk()?;
                    self.finished.push(file);
                    self.lost += subtract_lost(&mut self.topics, &mut self.channels, &kept);
                }
                return Err(error);
            }
        }
        let topics = self.topics.iter().map(|topic| Arc::clone(&topic.channel));
        let channels: Vec<_> = topics.collect();
        for (index, channel) in channels.iter().enumerate() {
            let id = self.file.add_channel(channel);
            self.channels[index] = (self.check_disk(id)?, 0);
        }
        Ok(())
    }

    /// Remembers whether the disk is full.
    fn check_disk<T>(&mut self, outcome: Result<T, BagError>) -> Result<T, BagError> {
        if let Err(error) = &outcome {
            self.disk_full |= error.is_disk_full();
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

    /// Ends the chunk and writes it to the file: the messages so far survive if the process is killed.
    ///
    /// # Errors
    /// As [`BagWriter::write`].
    pub fn flush(&mut self) -> Result<(), BagError> {
        let flushed = self.file.flush();
        self.check_disk(flushed)
    }

    /// Finishes and renames the file and writes `metadata.yaml`.
    ///
    /// If the disk is full, now or when a message was written, the last file ends after the chunks that fit;
    /// [`BagSummary::lost`] is the number of messages lost.
    ///
    /// # Errors
    /// [`BagError::Io`] and [`BagError::Format`]. The file then keeps the name `*.active`.
    pub fn finish(self) -> Result<BagSummary, BagError> {
        let Self { file, directory, finished: mut files, mut topics, mut channels, .. } = self;
        let mut custom_data = self.custom_data;
        let mut lost = self.lost;
        files.push(match file.finish() {
            Ok(file) => file,
            Err(failed) => {
                let (error, unfinished) = *failed;
                if !self.disk_full && !error.is_disk_full() {
                    return Err(error);
                }
                let (file, kept) = unfinished.finish_on_full_disk()?;
                lost += subtract_lost(&mut topics, &mut channels, &kept);
                file
            }
        });
        if self.dropped + lost > 0 {
            custom_data.insert(MESSAGES_NOT_RECORDED.to_owned(), (self.dropped + lost).to_string());
        }
        let summary = BagSummary {
            lost,
            ..BagSummary::new(directory, files, topics, custom_data, self.distro)
        };
        metadata::write(&summary)?;
        Ok(summary)
    }
}

/// Subtracts from the topics the messages that were written to a file and are not kept in it; returns their
/// number.
fn subtract_lost(
    topics: &mut [WrittenTopic],
    channels: &mut [(u16, u64)],
    kept: &BTreeMap<ChannelKey, u64>,
) -> u64 {
    let mut lost = 0;
    for (topic, (channel, written)) in topics.iter_mut().zip(channels) {
        let missing = written
            .saturating_sub(kept.get(&ChannelKey::from(*channel)).copied().unwrap_or_default());
        topic.messages -= missing;
        lost += missing;
        *written = 0;
    }
    lost
}
