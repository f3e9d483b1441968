//! The files and topics of an open bag.

use std::{
    collections::{BTreeMap, HashSet},
    path::{Path, PathBuf},
    sync::Arc,
};

use super::index::FileIndex;
use crate::{
    error::BagError,
    format::{
        channel::{Channel, ROS2MSG},
        custom_data::CustomData,
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
    /// The type as the bag defines it; `None` if it does not, or in another language than `.msg`.
    ///
    /// # Errors
    /// [`InvalidDefinition`] when the definition cannot be parsed.
    pub fn defined_type(&self) -> Option<Result<TypeSupport, InvalidDefinition>> {
        let is_msg = self.schema_encoding == ROS2MSG && !self.schema.is_empty();
        is_msg.then(|| TypeSupport::from_schema(&self.type_name, &self.schema))
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
    /// For each file, by channel id. Equal channels of several files are shared.
    pub(super) channels: Vec<BTreeMap<u16, FileChannel>>,
    /// Each channel once, in the order of the files and of the channel ids.
    pub(super) distinct: Vec<Arc<Channel>>,
    /// `custom_data` of `metadata.yaml`.
    pub(super) custom_data: CustomData,
}

impl Contents {
    /// The files, in this order, as the bag `path`.
    pub(super) fn new(path: &Path, files: Vec<FileIndex>, custom_data: CustomData) -> Self {
        let topics = topics(&files);
        let (mut known, mut distinct) = (HashSet::new(), Vec::new());
        let channels = files
            .iter()
            .map(|file| {
                let of_file = |(id, channel): (&u16, &Arc<Channel>)| {
                    let topic = topics.iter().position(|topic| {
                        topic.name == channel.topic && topic.type_name == channel.type_name()
                    })?;
                    if known.insert(Arc::clone(channel)) {
                        distinct.push(Arc::clone(channel));
                    }
                    let channel = Arc::clone(known.get(channel)?);
                    Some((*id, FileChannel { topic, channel }))
                };
                file.channels.iter().filter_map(of_file).collect()
            })
            .collect();
        let names = topics
            .iter()
            .map(|topic| TopicNames {
                name: topic.name.as_str().into(),
                type_name: topic.type_name.as_str().into(),
            })
            .collect();
        Self { path: path.into(), files, topics, names, channels, distinct, custom_data }
    }

    /// The first damage found when the bag was opened.
    pub(super) fn damage(&self) -> Option<BagError> {
        self.files.iter().flat_map(FileIndex::errors).next()
    }
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

/// The topics of all files, sorted by name, then by type.
fn topics(files: &[FileIndex]) -> Vec<TopicInfo> {
    let mut topics = BTreeMap::new();
    for file in files {
        for (id, channel) in &file.channels {
            let key = (channel.topic.as_str(), channel.type_name());
            let topic = topics.entry(key).or_insert_with(|| TopicInfo {
                name: channel.topic.clone(),
                type_name: channel.type_name().to_owned(),
                schema: channel.definition(),
                schema_encoding: channel.definition_encoding().to_owned(),
                hash: channel.type_hash().map(str::to_owned),
                message_count: 0,
                offered: Vec::new(),
            });
            merge_offered(&mut topic.offered, channel.offered());
            topic.message_count += file.counts.get(id).copied().unwrap_or_default();
        }
    }
    topics.into_values().collect()
}
