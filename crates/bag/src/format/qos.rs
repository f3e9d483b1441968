//! QoS profiles offered by publishers: a YAML list in the metadata of a channel and in `metadata.yaml`.
//!
//! Up to version 8 of `metadata.yaml` policies are numbers (`rmw/types.h`), from version 9 names
//! (`rosbag2_storage/src/rosbag2_storage/qos.cpp`). Both are read; names are written.

use std::{collections::BTreeMap, fs, path::Path};

use serde::{Deserialize, Deserializer, Serialize};

use crate::error::BagError;
use eddy_messages::{
    QosProfile,
    qos::{DurabilityPolicy, HistoryPolicy, ReliabilityPolicy},
};

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

/// Names of policies.
const KEEP_LAST: &str = "keep_last";
const KEEP_ALL: &str = "keep_all";
const BEST_EFFORT: &str = "best_effort";
const TRANSIENT_LOCAL: &str = "transient_local";
const UNKNOWN: &str = "unknown";

/// `rmw_time_t` for an infinite duration: 2^63 - 1 nanoseconds.
const INFINITE: QosTime = QosTime { sec: 9_223_372_036, nsec: 854_775_807 };

/// One QoS profile, with the policy names of version 9.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct YamlProfile {
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

impl Default for YamlProfile {
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

impl YamlProfile {
    /// The profile as ROS 2 describes it, with infinite times.
    fn of(profile: &QosProfile) -> Self {
        let (history, depth) = match profile.history {
            HistoryPolicy::KeepLast(depth) => (KEEP_LAST, depth),
            HistoryPolicy::KeepAll => (KEEP_ALL, 0),
            HistoryPolicy::Unknown => (UNKNOWN, 0),
        };
        Self {
            history: history.to_owned(),
            depth: depth as u64,
            reliability: match profile.reliability {
                ReliabilityPolicy::Reliable => "reliable",
                ReliabilityPolicy::BestEffort => BEST_EFFORT,
            }
            .to_owned(),
            durability: match profile.durability {
                DurabilityPolicy::Volatile => "volatile",
                DurabilityPolicy::TransientLocal => TRANSIENT_LOCAL,
            }
            .to_owned(),
            ..Self::default()
        }
    }

    fn profile(&self) -> QosProfile {
        let depth = usize::try_from(self.depth).unwrap_or(usize::MAX);
        QosProfile {
            reliability: match self.reliability.as_str() {
                BEST_EFFORT => ReliabilityPolicy::BestEffort,
                _ => ReliabilityPolicy::Reliable,
            },
            durability: match self.durability.as_str() {
                TRANSIENT_LOCAL => DurabilityPolicy::TransientLocal,
                _ => DurabilityPolicy::Volatile,
            },
            history: match self.history.as_str() {
                KEEP_LAST => HistoryPolicy::KeepLast(depth),
                KEEP_ALL => HistoryPolicy::KeepAll,
                _ => HistoryPolicy::Unknown,
            },
        }
    }
}

/// An error in YAML without advice on settings of the library, in one line.
pub(super) fn yaml_words(error: &serde_saphyr::Error) -> String {
    let text = error.without_snippet().render_with_formatter(&serde_saphyr::UserMessageFormatter);
    text.lines().next().unwrap_or_default().to_owned()
}

/// The value of `offered_qos_profiles`.
pub(crate) fn offered_profiles(offered: &[QosProfile]) -> String {
    let profiles: Vec<_> = offered.iter().map(YamlProfile::of).collect();
    text(&profiles)
}

/// The text of a list of profiles.
pub(crate) fn text(profiles: &[YamlProfile]) -> String {
    serde_saphyr::to_string(&profiles)
        .expect("structs of numbers and strings with fixed keys are always YAML")
}

/// Parses the value of `offered_qos_profiles`; empty if it is not a list of profiles.
pub(crate) fn parse(text: &str) -> Vec<YamlProfile> {
    serde_saphyr::from_str(text).unwrap_or_default()
}

/// The profiles in the value of `offered_qos_profiles`.
pub(crate) fn profiles(text: &str) -> Vec<QosProfile> {
    parse(text).iter().map(YamlProfile::profile).collect()
}

/// A profile in a file of overrides; missing policies have ROS 2's defaults.
#[derive(Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Override {
    #[serde(deserialize_with = "history")]
    history: String,
    depth: u64,
    #[serde(deserialize_with = "reliability")]
    reliability: String,
    #[serde(deserialize_with = "durability")]
    durability: String,
    // Of no effect: rosbag2's files may have them.
    #[serde(rename = "deadline")]
    _deadline: Option<PartialTime>,
    #[serde(rename = "lifespan")]
    _lifespan: Option<PartialTime>,
    #[serde(rename = "liveliness")]
    _liveliness: Option<Policy>,
    #[serde(rename = "liveliness_lease_duration")]
    _liveliness_lease_duration: Option<PartialTime>,
    #[serde(rename = "avoid_ros_namespace_conventions")]
    _avoid_ros_namespace_conventions: Option<bool>,
}

/// A time in a file of overrides.
#[derive(Deserialize)]
#[serde(default, deny_unknown_fields)]
#[derive(Default)]
struct PartialTime {
    #[serde(rename = "sec")]
    _sec: u64,
    #[serde(rename = "nsec")]
    _nsec: u64,
}

impl Default for Override {
    fn default() -> Self {
        let YamlProfile { history, depth, reliability, durability, .. } = YamlProfile::default();
        Self {
            history,
            depth,
            reliability,
            durability,
            _deadline: None,
            _lifespan: None,
            _liveliness: None,
            _liveliness_lease_duration: None,
            _avoid_ros_namespace_conventions: None,
        }
    }
}

/// QoS profiles by topic.
pub type QosOverrides = BTreeMap<String, QosProfile>;

/// Reads a file of QoS profiles by topic, as rosbag2's `--qos-profile-overrides-path` does. Policies that the file lacks
/// have ROS 2's defaults; deadline, lifespan and liveliness have no effect.
///
/// # Errors
/// [`BagError::Io`], and [`BagError::Metadata`] when a topic or a policy is invalid.
pub fn read_qos_overrides(path: &Path) -> Result<QosOverrides, BagError> {
    let wrong = |field, found: String, expected| BagError::Metadata {
        path: path.into(),
        field,
        found,
        expected,
    };
    let text = fs::read_to_string(path).map_err(BagError::io(path, "reading the QoS profiles"))?;
    let overrides: BTreeMap<String, Override> = serde_saphyr::from_str(&text).map_err(|error| {
        let expected = "topics with QoS policies, such as `/scan: {reliability: best_effort}`";
        wrong("topics", yaml_words(&error), expected)
    })?;
    let mut profiles = QosOverrides::new();
    for (topic, policies) in overrides {
        if !topic.starts_with('/') {
            return Err(wrong("topics", topic, "names that start with `/`"));
        }
        let checks = [
            ("history", &policies.history, HISTORY, "keep_last or keep_all"),
            ("reliability", &policies.reliability, RELIABILITY, "reliable or best_effort"),
            ("durability", &policies.durability, DURABILITY, "volatile or transient_local"),
        ];
        for (field, found, names, expected) in checks {
            if !names.contains(&found.as_str()) || found == UNKNOWN {
                return Err(wrong(field, format!("{found} for {topic}"), expected));
            }
        }
        let Override { history, depth, reliability, durability, .. } = policies;
        // `system_default` is the default of ROS 2.
        let history = if history == KEEP_ALL { history } else { KEEP_LAST.to_owned() };
        let profile =
            YamlProfile { history, depth, reliability, durability, ..YamlProfile::default() };
        profiles.insert(topic, profile.profile());
    }
    Ok(profiles)
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
        let numbers = "- history: 3\n  depth: 0\n  reliability: 2\n  durability: 1\n  deadline:\n    sec: \
            9223372036\n    nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  \
            liveliness: 1\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n  \
            avoid_ros_namespace_conventions: false\n";
        let expected = QosProfile {
            reliability: ReliabilityPolicy::BestEffort,
            durability: DurabilityPolicy::TransientLocal,
            history: HistoryPolicy::Unknown,
        };
        assert_eq!(profiles(numbers), [expected]);
    }

    #[test]
    fn profiles_are_read_back() {
        let histories =
            [HistoryPolicy::KeepLast(7), HistoryPolicy::KeepAll, HistoryPolicy::Unknown];
        let offered = histories.map(|history| QosProfile { history, ..QosProfile::default() });
        assert_eq!(profiles(&offered_profiles(&offered)), offered);
        assert_eq!(profiles(&offered_profiles(&[])), []);
    }

    #[test]
    fn other_texts_have_no_profiles() {
        for text in ["", "[]", "nothing", "- history: 1\n", "{"] {
            assert_eq!(parse(text), [], "{text}");
        }
    }

    fn overrides(text: &str) -> Result<QosOverrides, BagError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("qos.yaml");
        fs::write(&path, text).unwrap();
        read_qos_overrides(&path)
    }

    #[test]
    fn overrides_are_read_as_rosbag2_writes_them() {
        let text = "/scan:\n  reliability: best_effort\n  history: keep_all\n/map:\n  durability: transient_local\n  \
            depth: 1\n  history: keep_last\n  deadline:\n    sec: 0\n    nsec: 0\n  liveliness: automatic\n\
            /odom:\n  reliability: system_default\n";
        let expected = [
            (
                "/map",
                QosProfile {
                    durability: DurabilityPolicy::TransientLocal,
                    history: HistoryPolicy::KeepLast(1),
                    ..QosProfile::default()
                },
            ),
            ("/odom", QosProfile::default()),
            (
                "/scan",
                QosProfile {
                    reliability: ReliabilityPolicy::BestEffort,
                    history: HistoryPolicy::KeepAll,
                    ..QosProfile::default()
                },
            ),
        ];
        let expected = expected.map(|(topic, profile)| (topic.to_owned(), profile));
        assert_eq!(overrides(text).unwrap(), QosOverrides::from(expected));
    }

    #[test]
    fn invalid_overrides_are_rejected_with_field_found_and_expected() {
        for (text, expected) in [
            ("scan: {depth: 1}", "topics: found scan, expected names that start with `/`"),
            (
                "/scan: {reliability: sometimes}",
                "reliability: found sometimes for /scan, expected reliable or best_effort",
            ),
            ("/scan: {reliable: true}", "topics: found "),
            ("/scan: {depth: few}", "topics: found "),
        ] {
            let message = overrides(text).unwrap_err().to_string();
            assert!(message.contains(&format!("qos.yaml: {expected}")), "{message}");
        }
    }
}
