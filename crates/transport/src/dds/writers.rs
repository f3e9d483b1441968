//! Writers of other participants: topic, type, type hash and QoS, as discovery announces them.

use ros2_client::dds::rustdds::{
    DomainParticipant, GUID,
    discovery::DiscoveredWriterData,
    policy::{Durability, Reliability},
};

use eddy_messages::{
    QosProfile,
    qos::{DurabilityPolicy, HistoryPolicy, ReliabilityPolicy},
    ros_type,
};

/// Prefix of ROS topics in DDS.
const TOPIC: &str = "rt";
/// Key of the type hash in the user data of an endpoint, `typehash=RIHS01_...;`
/// (`rmw_dds_common/src/qos.cpp`, `parse_type_hash_from_user_data`). Other keys are skipped, such as those of ROS 2 Lyrical for the
/// memory that an endpoint accepts (`bufbe=...;`, `BUFBE:...;`).
const TYPE_HASH: &str = "typehash";
/// Bytes of the length before the user data.
const LENGTH: usize = 4;

/// A writer of a ROS topic.
pub(super) struct RemoteWriter {
    pub(super) guid: GUID,
    /// Name of the topic in ROS, such as `/particles`.
    pub(super) topic: String,
    /// Name of the type in ROS.
    pub(super) type_name: String,
    /// RIHS01 type hash, from ROS 2 Iron on.
    pub(super) hash: Option<String>,
    pub(super) offered: QosProfile,
}

/// The writers of ROS topics of all other participants.
pub(super) fn discovered(participant: &DomainParticipant) -> Vec<RemoteWriter> {
    participant.discovered_writers().iter().filter_map(of_ros).collect()
}

fn of_ros(writer: &DiscoveredWriterData) -> Option<RemoteWriter> {
    let data = &writer.publication_topic_data;
    let topic = data.topic_name.strip_prefix(TOPIC).filter(|name| name.starts_with('/'))?;
    Some(RemoteWriter {
        guid: writer.writer_proxy.remote_writer_guid,
        topic: topic.to_owned(),
        type_name: ros_type(&data.type_name)?,
        hash: type_hash(&writer.user_data),
        offered: QosProfile {
            reliability: match data.reliability {
                Some(Reliability::BestEffort) => ReliabilityPolicy::BestEffort,
                // The default of writers (DDS 1.4, 2.2.3).
                Some(Reliability::Reliable { .. }) | None => ReliabilityPolicy::Reliable,
            },
            durability: match data.durability {
                Some(Durability::Volatile) | None => DurabilityPolicy::Volatile,
                Some(_) => DurabilityPolicy::TransientLocal,
            },
            history: HistoryPolicy::Unknown,
        },
    })
}

/// The type hash in the user data of an endpoint, which RustDDS returns as on the wire: after its length.
fn type_hash(user_data: &[u8]) -> Option<String> {
    let text = String::from_utf8_lossy(user_data.get(LENGTH..)?);
    let mut pairs = text.split(';').filter_map(|pair| pair.split_once('='));
    let (_, hash) = pairs.find(|(key, _)| *key == TYPE_HASH)?;
    hash.starts_with("RIHS01_").then(|| hash.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_type_hash_is_found_in_the_user_data() {
        let hash = format!("RIHS01_{}", "a".repeat(64));
        for text in [
            format!("typehash={hash};"),
            format!("other=1;typehash={hash};more=2;"),
            format!("typehash={hash};\0\0\0"),
            // As in ROS 2 Lyrical.
            format!("typehash={hash};bufbe=cpu;"),
            format!("BUFBE:cpu,cuda;typehash={hash};"),
            format!("bufbe=typehash=RIHS01_0;typehash={hash};"),
        ] {
            assert_eq!(type_hash(&on_the_wire(&text)), Some(hash.clone()), "{text}");
        }
        for text in
            ["", "typehash=;", "typehash=INVALID;", "\u{ff}enclave=/;", "notypehash=RIHS01_0;"]
        {
            assert_eq!(type_hash(&on_the_wire(text)), None, "{text}");
        }
        assert_eq!(type_hash(b""), None);
    }

    fn on_the_wire(text: &str) -> Vec<u8> {
        [&(text.len() as u32).to_le_bytes(), text.as_bytes()].concat()
    }
}
