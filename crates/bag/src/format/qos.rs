//! QoS profiles offered by publishers: a YAML list in the metadata of a channel and in `metadata.yaml`.
//!
//! Up to version 8 of `metadata.yaml` policies are numbers (`rmw/types.h`), from version 9 names
//! (`rosbag2_storage/src/rosbag2_storage/qos.cpp`). Both are read; names are written.

use serde::{Deserialize, Deserializer, Serialize};

/// Names of `rmw_qos_history_policy_e`, by number.
const HISTORY: &[&str] = &["system_default", "keep_last", "keep_all", "unknown"];
/// `rmw_qos_reliability_policy_e`.
const RELIABILITY: &[&str] =
    &["system_default", "reliable", "best_effort", "unknown", "best_available"];
/// `rmw_qos_durability_policy_e`.
const DURABILITY: &[&str] =
    &["system_default", "transient_local", "volatile", "unknown", "best_available"];
/// `rmw_qos_liveliness_policy_e`.
const LIVELINESS: &[&str] = &[
    "system_default",
    "automatic",
    "manual_by_node",
    "manual_by_topic",
    "unknown",
    "best_available",
];

/// Durability of publishers that keep messages for late-joining subscribers.
const TRANSIENT_LOCAL: &str = "transient_local";

/// `rmw_time_t` for an infinite duration: 2^63 - 1 nanoseconds.
const INFINITE: QosTime = QosTime { sec: 9_223_372_036, nsec: 854_775_807 };

/// One QoS profile, with the policy names of version 9.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct QosProfile {
    #[serde(deserialize_with = "history")]
    history: String,
    depth: u64,
    #[serde(deserialize_with = "reliability")]
    reliability: String,
    #[serde(deserialize_with = "durability")]
    durability: String,
    deadline: QosTime,
    lifespan: QosTime,
    #[serde(deserialize_with = "liveliness")]
    liveliness: String,
    liveliness_lease_duration: QosTime,
    avoid_ros_namespace_conventions: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct QosTime {
    sec: u64,
    nsec: u64,
}

impl Default for QosProfile {
    /// ROS 2's default profile; a player offers it again, so that replay is reliable.
    fn default() -> Self {
        Self {
            history: "keep_last".to_owned(),
            depth: 10,
            reliability: "reliable".to_owned(),
            durability: "volatile".to_owned(),
            deadline: INFINITE,
            lifespan: INFINITE,
            liveliness: "automatic".to_owned(),
            liveliness_lease_duration: INFINITE,
            avoid_ros_namespace_conventions: false,
        }
    }
}

impl QosProfile {
    /// The profile of a publisher that keeps `kept` messages for late-joining subscribers.
    pub(crate) fn keeping(kept: usize) -> Self {
        match kept {
            0 => Self::default(),
            kept => Self {
                depth: kept as u64,
                durability: TRANSIENT_LOCAL.to_owned(),
                ..Self::default()
            },
        }
    }
}

/// Number of messages that publishers with these profiles keep together for late-joining subscribers; 0
/// unless all of them are transient local.
pub(crate) fn kept(profiles: &[QosProfile]) -> usize {
    if profiles.iter().any(|profile| profile.durability != TRANSIENT_LOCAL) {
        return 0;
    }
    let depth = |profile: &QosProfile| usize::try_from(profile.depth.max(1)).unwrap_or(usize::MAX);
    profiles.iter().map(depth).fold(0, usize::saturating_add)
}

/// The value of `offered_qos_profiles` for publishers that keep `kept` messages.
pub(crate) fn offered_profiles(kept: usize) -> String {
    serde_saphyr::to_string(&[QosProfile::keeping(kept)])
        .expect("structs of numbers and strings with fixed keys are always YAML")
}

/// Parses the value of `offered_qos_profiles`; empty if it is not a list of profiles.
pub(crate) fn parse(text: &str) -> Vec<QosProfile> {
    serde_saphyr::from_str(text).unwrap_or_default()
}

/// A policy as a number or a name.
#[derive(Deserialize)]
#[serde(untagged)]
enum Policy {
    Number(usize),
    Name(String),
}

fn policy<'de, D: Deserializer<'de>>(from: D, names: &[&str]) -> Result<String, D::Error> {
    Ok(match Policy::deserialize(from)? {
        Policy::Name(name) => name,
        Policy::Number(number) => names.get(number).copied().unwrap_or("unknown").to_owned(),
    })
}

fn history<'de, D: Deserializer<'de>>(from: D) -> Result<String, D::Error> {
    policy(from, HISTORY)
}

fn reliability<'de, D: Deserializer<'de>>(from: D) -> Result<String, D::Error> {
    policy(from, RELIABILITY)
}

fn durability<'de, D: Deserializer<'de>>(from: D) -> Result<String, D::Error> {
    policy(from, DURABILITY)
}

fn liveliness<'de, D: Deserializer<'de>>(from: D) -> Result<String, D::Error> {
    policy(from, LIVELINESS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn policies_are_read_as_numbers_and_as_names() {
        let numbers = "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2\n  deadline:\n    sec: \
            9223372036\n    nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  \
            liveliness: 1\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n  \
            avoid_ros_namespace_conventions: false\n";
        let expected = QosProfile { history: "unknown".into(), depth: 0, ..QosProfile::default() };
        assert_eq!(parse(numbers), [expected]);
        let names = serde_saphyr::to_string(&[QosProfile::default()]).unwrap();
        assert_eq!(parse(&names), [QosProfile::default()]);
    }

    #[test]
    fn kept_messages_add_up_if_all_publishers_are_transient_local() {
        let profiles = [3, 0, 2].map(QosProfile::keeping);
        assert_eq!(kept(&profiles), 0);
        assert_eq!(kept(&[profiles[0].clone(), profiles[2].clone()]), 5);
        assert_eq!(kept(&[]), 0);
        // rosbag2 does not know the depth of publishers whose history is unknown.
        let unknown = QosProfile { depth: 0, ..QosProfile::keeping(1) };
        assert_eq!(kept(&[unknown]), 1);
    }

    #[test]
    fn other_texts_have_no_profiles() {
        for text in ["", "[]", "nothing", "- history: 1\n", "{"] {
            assert_eq!(parse(text), [], "{text}");
        }
    }
}
