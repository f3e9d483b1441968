//! A bag that was written: its files and topics.

use std::{collections::BTreeMap, path::PathBuf, sync::Arc};

use super::channel::{Channel, defines};
use eddy_frames::Stamp;

/// A topic that was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WrittenTopic {
    /// Name of the topic.
    pub name: String,
    /// Name of its message type.
    pub type_name: String,
    /// RIHS01 type hash; empty if unknown.
    pub hash: String,
    /// Number of messages.
    pub messages: u64,
    /// Its description in the files.
    pub channel: Arc<Channel>,
}

impl WrittenTopic {
    /// Whether the bag has a definition of its type.
    pub fn has_definition(&self) -> bool {
        let schema = self.channel.schema.as_ref();
        schema.is_some_and(|schema| defines(&schema.encoding, &schema.data))
    }

    /// A topic without messages.
    pub(crate) fn new(channel: &Arc<Channel>) -> Self {
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
    /// Path of the file.
    pub path: PathBuf,
    /// Number of messages.
    pub messages: u64,
    /// Smallest log time; `None` without messages.
    pub start: Option<Stamp>,
    /// Largest log time; `None` without messages.
    pub end: Option<Stamp>,
    /// Size (bytes).
    pub size: u64,
}

/// A bag that was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BagSummary {
    /// Directory of the bag.
    pub directory: PathBuf,
    /// Its MCAP files, in the order of their messages.
    pub files: Vec<WrittenFile>,
    /// Number of messages.
    pub messages: u64,
    /// Number of messages that were passed to the writer and did not fit on the disk.
    pub lost: u64,
    /// Smallest log time; `None` without messages.
    pub start: Option<Stamp>,
    /// Largest log time; `None` without messages.
    pub end: Option<Stamp>,
    /// The topics, in the order in which they were added.
    pub topics: Vec<WrittenTopic>,
    /// `custom_data` of `metadata.yaml`.
    pub custom_data: BTreeMap<String, String>,
    /// Distribution of ROS that the messages were recorded with, or `eddy`; empty if unknown.
    pub distro: String,
}

/// `ros_distro` of the bags that eddy records.
pub(crate) const OURS: &str = "eddy";

impl BagSummary {
    /// A bag of these files and topics; message count and times follow from the files.
    pub(crate) fn new(
        directory: PathBuf,
        files: Vec<WrittenFile>,
        topics: Vec<WrittenTopic>,
        custom_data: BTreeMap<String, String>,
        distro: String,
    ) -> Self {
        Self {
            directory,
            messages: files.iter().map(|file| file.messages).sum(),
            lost: 0,
            start: files.iter().filter_map(|file| file.start).min(),
            end: files.iter().filter_map(|file| file.end).max(),
            files,
            topics,
            custom_data,
            distro,
        }
    }
}
