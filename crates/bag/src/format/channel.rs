//! MCAP channels and schemas, with the metadata keys that rosbag2 uses. Copies of a bag keep them as they are.

use std::{collections::BTreeMap, sync::Arc};

use super::qos;
use eddy_messages::{QosProfile, TypeSupport};

/// Encoding of `.msg` definitions.
pub(crate) const ROS2MSG: &str = "ros2msg";

/// Metadata key of a channel: the RIHS01 type hash.
pub(crate) const TYPE_HASH: &str = "topic_type_hash";
/// Metadata key of a channel: the QoS profiles its publishers offered, a YAML list.
pub(crate) const OFFERED_QOS: &str = "offered_qos_profiles";

/// Whether this is a definition. The definition of a type without fields is empty.
pub(crate) fn defines(encoding: &str, data: &[u8]) -> bool {
    encoding == ROS2MSG || !data.is_empty()
}

/// An MCAP schema: a message type and its definition.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Schema {
    /// Name of the type, such as `eddy_msgs/msg/ParticleFrame`.
    pub name: String,
    /// Language of the definition: `ros2msg` or `ros2idl` in ROS 2; empty if there is none.
    pub encoding: String,
    /// The definition; for `ros2msg` the `.msg` text followed by that of every dependency.
    pub data: Vec<u8>,
}

/// An MCAP channel: a topic as one writer described it.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Channel {
    /// Name of the topic.
    pub topic: String,
    /// The message type; `None` if the file has no schema for it.
    pub schema: Option<Arc<Schema>>,
    /// Encoding of the messages: `cdr` in ROS 2.
    pub encoding: String,
    /// Other properties, such as `topic_type_hash` and `offered_qos_profiles`.
    pub metadata: BTreeMap<String, String>,
}

impl Channel {
    /// A topic as rosbag2 describes it, whose publishers offer `offered`. A type without a definition has a schema with
    /// its name only: readers reject an empty definition, or decode empty messages with it.
    pub fn ros(topic: &str, of: &TypeSupport, offered: &[QosProfile]) -> Self {
        let encoding = if of.schema.is_empty() { "" } else { ROS2MSG };
        Self {
            topic: topic.to_owned(),
            schema: Some(Arc::new(Schema {
                name: of.name.clone(),
                encoding: encoding.to_owned(),
                data: of.schema.as_bytes().to_vec(),
            })),
            encoding: "cdr".to_owned(),
            metadata: BTreeMap::from([
                (OFFERED_QOS.to_owned(), qos::offered_profiles(offered)),
                (TYPE_HASH.to_owned(), of.hash.clone()),
            ]),
        }
    }

    /// Name of the type; empty if unknown.
    pub fn type_name(&self) -> &str {
        self.schema.as_ref().map_or("", |schema| &schema.name)
    }

    /// RIHS01 type hash, if known.
    pub fn type_hash(&self) -> Option<&str> {
        self.metadata.get(TYPE_HASH).map(String::as_str).filter(|hash| !hash.is_empty())
    }

    /// Whether its type is the same version of the type as that of another channel: by their type hashes, else by their
    /// definitions; also where nothing is known of one of them.
    pub(crate) fn is_same_version(&self, other: &Self) -> bool {
        if let (Some(hash), Some(other)) = (self.type_hash(), other.type_hash()) {
            return hash == other;
        }
        let (definition, of_other) = (self.definition(), other.definition());
        let computed = |channel: &Self, definition: &str| {
            let is_msg = channel.definition_encoding() == ROS2MSG;
            let defined =
                is_msg.then(|| TypeSupport::from_schema(self.type_name(), definition).ok());
            let hash = channel.type_hash().map(str::to_owned);
            hash.or_else(|| defined.flatten().map(|defined| defined.hash))
        };
        definition == of_other
            || computed(self, &definition)
                .zip(computed(other, &of_other))
                .map_or(definition.is_empty() || of_other.is_empty(), |(hash, other)| hash == other)
    }

    /// The definition of the type as text; empty if unknown.
    pub(crate) fn definition(&self) -> String {
        let data = self.schema.as_ref().map_or(&[][..], |schema| &schema.data);
        String::from_utf8_lossy(data).into_owned()
    }

    /// Language of the definition, such as `ros2msg`; empty if there is none.
    pub(crate) fn definition_encoding(&self) -> &str {
        self.schema.as_ref().map_or("", |schema| &schema.encoding)
    }

    /// What its publishers offered; empty if unknown.
    pub(crate) fn offered(&self) -> Vec<QosProfile> {
        qos::profiles(self.offered_qos())
    }

    /// The offered QoS profiles as YAML text; empty if unknown.
    pub(crate) fn offered_qos(&self) -> &str {
        self.metadata.get(OFFERED_QOS).map_or("", String::as_str)
    }
}
