//! A topic as its writer described it: what has to stay the same when messages are copied.

use std::{collections::BTreeMap, sync::Arc};

use super::{metadata, qos};

/// Key of a channel's metadata: its RIHS01 type hash.
pub(super) const TYPE_HASH: &str = "topic_type_hash";
/// Key of a channel's metadata: the quality of service its publishers offered, a list in YAML.
pub(super) const OFFERED_QOS: &str = "offered_qos_profiles";

/// A message type as an MCAP file describes it.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Schema {
    /// The type's name, such as `eddy_msgs/msg/ParticleFrame`.
    pub name: String,
    /// How the definition is written: `ros2msg` from ROS 2, `ros2idl`; empty if there is none.
    pub encoding: String,
    /// The definition.
    pub data: Vec<u8>,
}

/// A topic of one writer (an MCAP channel), with its type and what the writer said about both.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Channel {
    /// The topic.
    pub topic: String,
    /// The type; `None` if the file does not tell.
    pub schema: Option<Arc<Schema>>,
    /// How messages are written: `cdr` from ROS 2.
    pub encoding: String,
    /// What else the writer said, such as `topic_type_hash` and `offered_qos_profiles`.
    pub metadata: BTreeMap<String, String>,
}

impl Channel {
    /// A topic as rosbag2 describes it: `schema` is the type's `.msg` text with that of every dependency,
    /// `hash` its RIHS01 type hash, each empty if unknown; its publishers keep the last `kept` messages for
    /// subscribers that come later (transient local).
    pub fn ros(topic: &str, type_name: &str, schema: &str, hash: &str, kept: usize) -> Self {
        Self {
            topic: topic.to_owned(),
            schema: Some(Arc::new(Schema {
                name: type_name.to_owned(),
                encoding: "ros2msg".to_owned(),
                data: schema.as_bytes().to_vec(),
            })),
            encoding: "cdr".to_owned(),
            metadata: BTreeMap::from([
                (OFFERED_QOS.to_owned(), metadata::offered_qos_profiles(kept)),
                (TYPE_HASH.to_owned(), hash.to_owned()),
            ]),
        }
    }

    /// The type's name; empty if the file does not tell.
    pub fn type_name(&self) -> &str {
        self.schema.as_ref().map_or("", |schema| &schema.name)
    }

    /// RIHS01 type hash, if the writer told.
    pub fn type_hash(&self) -> Option<&str> {
        self.metadata.get(TYPE_HASH).map(String::as_str).filter(|hash| !hash.is_empty())
    }

    /// The type's definition as a text; empty if the file does not tell.
    pub(super) fn definition(&self) -> String {
        let data = self.schema.as_ref().map_or(&[][..], |schema| &schema.data);
        String::from_utf8_lossy(data).into_owned()
    }

    /// How many messages its publishers kept for subscribers that came later.
    pub(super) fn kept(&self) -> usize {
        qos::kept(&qos::parse(self.offered_qos()))
    }

    /// What the writer said about quality of service; empty if nothing.
    pub(super) fn offered_qos(&self) -> &str {
        self.metadata.get(OFFERED_QOS).map_or("", String::as_str)
    }
}
