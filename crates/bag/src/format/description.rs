//! What a bag says of itself beside its messages: in `metadata.yaml`, and in the metadata record in which rosbag2 repeats it in a
//! file. Of version 1 and later; fields that are missing or unreadable are unknown.

use std::collections::BTreeMap;

use serde::{Deserialize, de::IgnoredAny};

use super::{
    channel::{Channel, OFFERED_QOS, TYPE_HASH},
    custom_data::CustomData,
    qos::{self, YamlProfile},
};

/// The metadata record of rosbag2 in a file.
pub(crate) const RECORD: &str = "rosbag2";
/// Its entries: the text of `metadata.yaml`, and the distribution of ROS that recorded the file.
const SERIALIZED: &str = "serialized_metadata";
const DISTRO: &str = "ROS_DISTRO";

/// What a bag says of itself.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Description {
    /// Distribution of ROS; empty if unknown.
    pub(crate) distro: String,
    pub(crate) custom_data: CustomData,
    /// Each topic and type once.
    pub(crate) topics: Vec<DescribedTopic>,
    /// Number of messages.
    pub(crate) message_count: Option<u64>,
    /// Log time of the first message (ns), and time from there to the last (ns).
    pub(crate) times: Option<[i64; 2]>,
    /// The files by their names.
    pub(crate) files: BTreeMap<String, DescribedFile>,
}

/// A topic of a [`Description`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct DescribedTopic {
    pub(crate) name: String,
    pub(crate) type_name: String,
    /// Empty if unknown.
    pub(crate) hash: String,
    /// Empty if unknown.
    pub(crate) offered: Vec<YamlProfile>,
    pub(crate) messages: Option<u64>,
}

/// A file of a [`Description`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct DescribedFile {
    pub(crate) messages: u64,
    /// Log time of the first message (ns), and time from there to the last (ns).
    pub(crate) times: [i64; 2],
}

impl Description {
    /// Parses the text of `metadata.yaml`, with the line `rosbag2_bagfile_information` or without. Empty where it cannot be read.
    pub(crate) fn parse(text: &str) -> Self {
        let document =
            serde_saphyr::from_str::<Document>(text).map(|of| of.rosbag2_bagfile_information);
        let information = document.or_else(|_| serde_saphyr::from_str(text));
        information.map(Information::description).unwrap_or_default()
    }

    /// The content of the metadata record of rosbag2.
    pub(crate) fn of_record(entries: &BTreeMap<String, String>) -> Self {
        let described = entries.get(SERIALIZED).map(|text| Self::parse(text)).unwrap_or_default();
        let distro = entries.get(DISTRO).filter(|distro| !distro.is_empty());
        Self { distro: distro.cloned().unwrap_or(described.distro), ..described }
    }

    /// What this says, and beyond that what the `other` does.
    pub(crate) fn or(mut self, other: &Self) -> Self {
        if self.distro.is_empty() {
            self.distro.clone_from(&other.distro);
        }
        for (key, value) in &other.custom_data {
            self.custom_data.entry(key.clone()).or_insert_with(|| value.clone());
        }
        for topic in &other.topics {
            match self.topics.iter_mut().find(|known| known.is_of(&topic.name, &topic.type_name)) {
                Some(known) => known.complete(&topic.hash, &topic.offered),
                None => self.topics.push(topic.clone()),
            }
        }
        self
    }

    /// What it says of a topic.
    pub(crate) fn topic(&self, name: &str, type_name: &str) -> Option<&DescribedTopic> {
        self.topics.iter().find(|topic| topic.is_of(name, type_name))
    }
}

impl DescribedTopic {
    fn is_of(&self, name: &str, type_name: &str) -> bool {
        self.name == name && self.type_name == type_name
    }

    fn complete(&mut self, hash: &str, offered: &[YamlProfile]) {
        if self.hash.is_empty() {
            hash.clone_into(&mut self.hash);
        }
        if self.offered.is_empty() {
            self.offered = offered.to_vec();
        }
    }

    /// Whether its profiles, if it has any, are those of `channels`, if they have any.
    pub(crate) fn offers_as(&self, channels: &[&Channel]) -> bool {
        let offered: Vec<_> =
            channels.iter().flat_map(|channel| qos::parse(channel.offered_qos())).collect();
        let same =
            |one: &[YamlProfile], other: &[YamlProfile]| one.iter().all(|p| other.contains(p));
        self.offered.is_empty()
            || offered.is_empty()
            || (same(&self.offered, &offered) && same(&offered, &self.offered))
    }
}

/// The channels of a topic as `metadata.yaml` describes them: what it says counts, as in rosbag2, since users edit it. Of several
/// versions of a type, each keeps its hash. What `in_files` says completes channels that say nothing.
pub(crate) fn described(
    channels: &[&Channel],
    in_yaml: Option<&DescribedTopic>,
    in_files: Option<&DescribedTopic>,
) -> Vec<Channel> {
    let hashes = channels.iter().filter_map(|channel| channel.type_hash());
    let one_version = hashes.clone().all(|hash| Some(hash) == hashes.clone().next());
    let differs = in_yaml.is_some_and(|topic| !topic.offers_as(channels));
    let mut changed: Vec<Channel> = channels.iter().map(|channel| (*channel).clone()).collect();
    for channel in &mut changed {
        let set = |channel: &mut Channel, key: &str, value: String| {
            channel.metadata.insert(key.to_owned(), value);
        };
        for (topic, is_yaml) in [(in_yaml, true), (in_files, false)] {
            let Some(topic) = topic else { continue };
            let is_silent = qos::parse(channel.offered_qos()).is_empty();
            if !topic.offered.is_empty() && (is_silent || is_yaml && differs) {
                set(channel, OFFERED_QOS, qos::text(&topic.offered));
            }
            let has_hash = channel.type_hash().is_some();
            if !topic.hash.is_empty() && one_version && (!has_hash || is_yaml) {
                set(channel, TYPE_HASH, topic.hash.clone());
            }
        }
    }
    changed
}

#[derive(Deserialize)]
struct Document {
    rosbag2_bagfile_information: Information,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct Information {
    duration: Option<Lenient<Nanoseconds>>,
    starting_time: Option<Lenient<SinceEpoch>>,
    message_count: Option<u64>,
    topics_with_message_count: Vec<Lenient<TopicWithCount>>,
    files: Vec<Lenient<FileInformation>>,
    custom_data: Option<CustomData>,
    ros_distro: Option<String>,
}

/// A value, or whatever else there is in its place.
#[derive(Deserialize)]
#[serde(untagged)]
enum Lenient<T> {
    Known(T),
    Other(IgnoredAny),
}

impl<T> Lenient<T> {
    fn known(self) -> Option<T> {
        match self {
            Self::Known(value) => Some(value),
            Self::Other(_) => None,
        }
    }
}

#[derive(Deserialize)]
struct Nanoseconds {
    nanoseconds: i64,
}

#[derive(Deserialize)]
struct SinceEpoch {
    nanoseconds_since_epoch: i64,
}

#[derive(Deserialize)]
struct TopicWithCount {
    topic_metadata: TopicMetadata,
    message_count: Option<u64>,
}

#[derive(Deserialize)]
struct TopicMetadata {
    name: String,
    r#type: String,
    offered_qos_profiles: Option<Profiles>,
    #[serde(default)]
    type_description_hash: Option<String>,
}

/// Up to version 8 a text, then a list.
#[derive(Deserialize)]
#[serde(untagged)]
enum Profiles {
    List(Vec<YamlProfile>),
    Text(String),
    Other(IgnoredAny),
}

#[derive(Deserialize)]
struct FileInformation {
    path: String,
    starting_time: SinceEpoch,
    duration: Nanoseconds,
    message_count: u64,
}

impl Information {
    fn description(self) -> Description {
        let topics = self.topics_with_message_count.into_iter().filter_map(Lenient::known);
        let files = self.files.into_iter().filter_map(Lenient::known);
        let start = self.starting_time.and_then(Lenient::known);
        let start = start.map(|start| start.nanoseconds_since_epoch);
        let duration = self.duration.and_then(Lenient::known).map(|duration| duration.nanoseconds);
        Description {
            distro: self.ros_distro.unwrap_or_default(),
            custom_data: self.custom_data.unwrap_or_default(),
            topics: topics.map(TopicWithCount::described).collect(),
            message_count: self.message_count,
            times: start.zip(duration).map(|(start, duration)| [start, duration]),
            files: files.map(FileInformation::described).collect(),
        }
    }
}

impl TopicWithCount {
    fn described(self) -> DescribedTopic {
        let TopicMetadata { name, r#type: type_name, offered_qos_profiles, type_description_hash } =
            self.topic_metadata;
        DescribedTopic {
            name,
            type_name,
            hash: type_description_hash.unwrap_or_default(),
            offered: match offered_qos_profiles {
                Some(Profiles::List(profiles)) => profiles,
                Some(Profiles::Text(text)) => qos::parse(&text),
                Some(Profiles::Other(_)) | None => Vec::new(),
            },
            messages: self.message_count,
        }
    }
}

impl FileInformation {
    fn described(self) -> (String, DescribedFile) {
        let Self { path, starting_time, duration, message_count: messages } = self;
        // Only the name of the file counts.
        let name = path.rsplit('/').next().unwrap_or_default().to_owned();
        let times = [starting_time.nanoseconds_since_epoch, duration.nanoseconds];
        (name, DescribedFile { messages, times })
    }
}
