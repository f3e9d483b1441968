//! The files and topics of an open bag.

use std::{
    collections::{BTreeMap, HashMap, HashSet},
    path::{Path, PathBuf},
    sync::Arc,
};

use super::index::{ChannelKey, FileIndex};
use crate::{
    error::BagError,
    format::{
        channel::{Channel, ROS2MSG, defines},
        description::{Description, described},
    },
};
use eddy_messages::{InvalidDefinition, QosProfile, TypeSupport};

/// A topic of a bag.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicInfo {
    /// Name of the topic.
    pub name: String,
    /// Name of its message type; empty if unknown.
    pub type_name: String,
    /// Definition of the type: in bags of ROS 2 the `.msg` text and that of every dependency; empty if unknown.
    pub schema: String,
    /// Language of the definition: `ros2msg` or `ros2idl` in bags of ROS 2; empty if there is none.
    pub schema_encoding: String,
    /// RIHS01 type hash, if known.
    pub hash: Option<String>,
    /// Number of messages.
    pub message_count: u64,
    /// QoS offered by each of its publishers; empty if unknown.
    pub offered: Vec<QosProfile>,
}

impl TopicInfo {
    /// Whether the bag has a definition of its type.
    pub fn has_definition(&self) -> bool {
        defines(&self.schema_encoding, self.schema.as_bytes())
    }

    /// Number of messages that its publishers keep for late subscribers; 0 unless all of them are transient local.
    pub fn kept(&self) -> usize {
        QosProfile::in_place_of(&self.offered).map_or(0, |offered| offered.kept())
    }

    /// The type as the bag defines it; `None` if it does not, or in another language than `.msg`.
    ///
    /// # Errors
    /// [`InvalidDefinition`] when the definition cannot be parsed.
    pub fn defined_type(&self) -> Option<Result<TypeSupport, InvalidDefinition>> {
        (self.schema_encoding == ROS2MSG)
            .then(|| TypeSupport::from_schema(&self.type_name, &self.schema))
    }
}

/// Name and type of a topic, shared by its messages.
#[derive(Debug)]
pub(super) struct TopicNames {
    pub(super) name: Arc<str>,
    pub(super) type_name: Arc<str>,
}

/// A channel of a file, and the index of its topic.
#[derive(Debug)]
pub(super) struct FileChannel {
    pub(super) topic: usize,
    pub(super) channel: Arc<Channel>,
}

/// Files and topics.
#[derive(Debug)]
pub(super) struct Contents {
    pub(super) path: PathBuf,
    pub(super) files: Vec<FileIndex>,
    /// Sorted by name, then by type.
    pub(super) topics: Vec<TopicInfo>,
    /// For each topic.
    pub(super) names: Vec<TopicNames>,
    /// For each file, by channel. Equal channels of several files are shared.
    pub(super) channels: Vec<BTreeMap<ChannelKey, FileChannel>>,
    /// Each channel once, in the order of the files and of the channel ids.
    pub(super) distinct: Vec<Arc<Channel>>,
    /// For each of them, the index of its topic.
    pub(super) topic_of: Vec<usize>,
    /// What `metadata.yaml` says; `None` without one.
    pub(super) in_yaml: Option<Description>,
    /// What the files say in the metadata record of rosbag2.
    pub(super) in_files: Description,
    /// Both, of which `metadata.yaml` counts first.
    pub(super) described: Description,
}

impl Contents {
    /// The files, in this order, as the bag `path`, which `metadata.yaml` describes as `in_yaml`.
    pub(super) fn new(path: &Path, files: Vec<FileIndex>, in_yaml: Option<Description>) -> Self {
        let mut in_files = Description::default();
        for file in &files {
            in_files = in_files.or(&file.description);
        }
        let described = in_yaml.clone().unwrap_or_default().or(&in_files);
        let channels = described_channels(&files, in_yaml.as_ref(), &in_files);
        let (mut known, mut distinct) = (HashSet::new(), Vec::new());
        let channels: Vec<BTreeMap<ChannelKey, Arc<Channel>>> = channels
            .into_iter()
            .map(|of_file| {
                let shared = of_file.into_iter().map(|(key, channel)| {
                    if known.insert(Arc::clone(&channel)) {
                        distinct.push(Arc::clone(&channel));
                    }
                    let channel = known.get(&channel).map_or(channel.clone(), Arc::clone);
                    (key, channel)
                });
                shared.collect()
            })
            .collect();
        let (mut topics, topic_of) = topics(&distinct);
        let index_of = |channel: &Arc<Channel>| {
            let number = distinct.iter().position(|known| Arc::ptr_eq(known, channel));
            number.map_or(0, |number| topic_of[number])
        };
        let channels = files.iter().zip(channels).map(|(file, channels)| {
            let of_file = channels.into_iter().map(|(key, channel)| {
                let topic = index_of(&channel);
                topics[topic].message_count += file.counts.get(&key).copied().unwrap_or_default();
                (key, FileChannel { topic, channel })
            });
            of_file.collect()
        });
        let channels: Vec<BTreeMap<ChannelKey, FileChannel>> = channels.collect();
        let names = topics.iter().map(|topic| TopicNames {
            name: topic.name.as_str().into(),
            type_name: topic.type_name.as_str().into(),
        });
        let (path, names) = (path.into(), names.collect());
        Self {
            path,
            files,
            names,
            topics,
            channels,
            distinct,
            topic_of,
            in_yaml,
            in_files,
            described,
        }
    }

    /// The first damage found when the bag was opened.
    pub(super) fn damage(&self) -> Option<BagError> {
        self.files.iter().flat_map(FileIndex::errors).next()
    }
}

/// The channels of each file with what the bag says of their topics.
fn described_channels(
    files: &[FileIndex],
    in_yaml: Option<&Description>,
    in_files: &Description,
) -> Vec<BTreeMap<ChannelKey, Arc<Channel>>> {
    let mut of_topics: BTreeMap<(&str, &str), Vec<&Channel>> = BTreeMap::new();
    for channel in files.iter().flat_map(|file| file.channels.values()) {
        let of_topic = of_topics.entry((channel.topic.as_str(), channel.type_name())).or_default();
        if !of_topic.contains(&&**channel) {
            of_topic.push(channel);
        }
    }
    let mut changed: HashMap<&Channel, Arc<Channel>> = HashMap::new();
    for ((name, type_name), channels) in of_topics {
        let in_yaml = in_yaml.and_then(|description| description.topic(name, type_name));
        let in_files = in_files.topic(name, type_name);
        if in_yaml.is_some() || in_files.is_some() {
            let described = described(&channels, in_yaml, in_files).into_iter().map(Arc::new);
            changed.extend(channels.into_iter().zip(described));
        }
    }
    let of_file = |file: &FileIndex| {
        let channels = file.channels.iter();
        let described = channels
            .map(|(&key, channel)| (key, changed.get(&**channel).unwrap_or(channel).clone()));
        described.collect()
    };
    files.iter().map(of_file).collect()
}

/// Merges the profiles offered on another channel of a topic. Of equal profiles the larger count is kept, because the files of a split bag
/// repeat their channels.
fn merge_offered(known: &mut Vec<QosProfile>, offered: Vec<QosProfile>) {
    let of = |profiles: &[QosProfile], profile| {
        profiles.iter().filter(|other| **other == profile).count()
    };
    for &profile in &offered {
        if of(known, profile) < of(&offered, profile) {
            known.push(profile);
        }
    }
}

/// The topics of all channels, sorted by name, then by type, without their messages, and the topic of each channel.
fn topics(channels: &[Arc<Channel>]) -> (Vec<TopicInfo>, Vec<usize>) {
    let mut found: BTreeMap<(&str, &str), Vec<usize>> = BTreeMap::new();
    for (number, channel) in channels.iter().enumerate() {
        found.entry((channel.topic.as_str(), channel.type_name())).or_default().push(number);
    }
    let (mut topics, mut topic_of) = (Vec::new(), vec![0; channels.len()]);
    for ((name, type_name), numbers) in found {
        let of_topic = || numbers.iter().map(|&number| &channels[number]);
        let defining = of_topic().find(|channel| !channel.definition_encoding().is_empty());
        let defining = defining.or_else(|| of_topic().next());
        let mut offered = Vec::new();
        of_topic().for_each(|channel| merge_offered(&mut offered, channel.offered()));
        topics.push(TopicInfo {
            name: name.to_owned(),
            type_name: type_name.to_owned(),
            schema: defining.map(|channel| channel.definition()).unwrap_or_default(),
            schema_encoding: defining
                .map_or("", |channel| channel.definition_encoding())
                .to_owned(),
            hash: of_topic().find_map(|channel| channel.type_hash()).map(str::to_owned),
            message_count: 0,
            offered,
        });
        numbers.into_iter().for_each(|number| topic_of[number] = topics.len() - 1);
    }
    (topics, topic_of)
}
