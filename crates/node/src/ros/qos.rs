//! QoS of single topics from parameters, as in rclcpp: `qos_overrides.TOPIC.publisher.POLICY` and
//! `qos_overrides.TOPIC.subscription.POLICY` (<https://design.ros2.org/articles/qos_configurability.html>). TOPIC is the full
//! name after remapping.

use std::collections::{BTreeMap, BTreeSet};

use super::{InvalidArgument, ParameterOverride, remap::quoted};
use eddy_messages::{
    QosProfile,
    qos::{DurabilityPolicy, HistoryPolicy, ReliabilityPolicy},
    services::{ParameterKind, ParameterValue},
};
use eddy_transport::is_absolute_name;

/// First part of the names of these parameters.
const PREFIX: &str = "qos_overrides.";
/// The form of their names.
const FORM: &str = "qos_overrides.TOPIC.publisher.POLICY or qos_overrides.TOPIC.subscription.POLICY, for example qos_overrides./prediction.publisher.reliability";
/// The supported policies, for error messages.
const POLICIES: &str = "reliability, durability, history or depth";
/// The other policies of ROS 2 (`rclcpp::QosPolicyKind`), which are accepted without an effect.
const OTHERS: [&str; 5] = [
    "avoid_ros_namespace_conventions",
    "deadline",
    "lifespan",
    "liveliness",
    "liveliness_lease_duration",
];
/// Values that leave a policy as it is: that of the middleware, or one that suits the other side.
const AS_IT_IS: [&str; 2] = ["system_default", "best_available"];

/// Depth of ROS 2's default profile.
const DEPTH: usize = 10;

/// Side of a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Side {
    Publisher,
    Subscription,
}

/// Overrides of single policies of a QoS profile.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Policies {
    reliability: Option<ReliabilityPolicy>,
    durability: Option<DurabilityPolicy>,
    keep_all: Option<bool>,
    depth: Option<usize>,
}

/// QoS of single topics of a node.
#[derive(Debug, Default)]
pub struct TopicQos {
    policies: BTreeMap<(Side, String), Policies>,
    used: BTreeSet<(Side, String)>,
}

impl TopicQos {
    /// Whether a parameter of this name sets QoS.
    pub fn is_parameter(name: &str) -> bool {
        name.starts_with(PREFIX)
    }

    /// The QoS in the parameters of a node; the last value of each takes precedence.
    ///
    /// # Errors
    /// [`InvalidArgument`] with the first parameter of this kind that cannot be used.
    pub fn from_parameters(parameters: &[ParameterOverride]) -> Result<Self, InvalidArgument> {
        let mut qos = Self::default();
        for ParameterOverride { parameter, argument, .. } in parameters {
            let Some(name) = parameter.name.strip_prefix(PREFIX) else { continue };
            let invalid =
                |found: String, expected: &str| InvalidArgument::new(argument, found, expected);
            let parsed = name.rsplit_once('.').and_then(|(rest, policy)| {
                let (topic, side) = rest.rsplit_once('.')?;
                // `publisher_ID` is for the publisher of a topic that a node has given this ID.
                let (side, id) = side.split_once('_').map_or((side, None), |(a, b)| (a, Some(b)));
                let side = match side {
                    "publisher" => Side::Publisher,
                    "subscription" => Side::Subscription,
                    _ => return None,
                };
                is_absolute_name(topic).then(|| (side, topic.to_owned(), policy, id))
            });
            let (side, topic, policy, id) =
                parsed.ok_or_else(|| invalid(quoted(&parameter.name), FORM))?;
            let mut without_effect = Policies::default();
            let policies = match id {
                None => qos.policies.entry((side, topic)).or_default(),
                Some(_) => {
                    let name = &parameter.name;
                    tracing::warn!("{name}: no effect, as no topic of eddy has a QoS override ID");
                    &mut without_effect
                }
            };
            policies
                .set(policy, &parameter.value)
                .map_err(|(found, expected)| invalid(found, &expected))?;
        }
        Ok(qos)
    }

    /// What the publisher of a topic offers instead of `default`; `None` without parameters.
    pub fn publisher(&mut self, topic: &str, default: QosProfile) -> Option<QosProfile> {
        self.apply(Side::Publisher, topic, default)
    }

    /// What the subscriber to a topic requests instead of `default`; `None` without parameters.
    pub fn subscription(&mut self, topic: &str, default: QosProfile) -> Option<QosProfile> {
        self.apply(Side::Subscription, topic, default)
    }

    fn apply(&mut self, side: Side, topic: &str, default: QosProfile) -> Option<QosProfile> {
        let key = (side, topic.to_owned());
        let policies = self.policies.get(&key)?.over(default);
        self.used.insert(key);
        Some(policies)
    }

    /// The topics with overrides that no publisher or subscriber of the node has used.
    pub fn unused(&self) -> impl Iterator<Item = &str> {
        let unused = self.policies.keys().filter(|key| !self.used.contains(key));
        unused.map(|(_, topic)| topic.as_str())
    }
}

impl Policies {
    /// Sets a policy; else what was found and what was expected.
    fn set(&mut self, policy: &str, value: &ParameterValue) -> Result<(), (String, String)> {
        let kind = value.kind().unwrap_or(ParameterKind::NotSet);
        let text = match kind {
            ParameterKind::String => value.string_value.as_str(),
            _ => "",
        };
        let found = || match kind {
            ParameterKind::String => quoted(text),
            ParameterKind::Integer => value.integer_value.to_string(),
            other => other.name().to_owned(),
        };
        let invalid = |expected: &str| Err((found(), expected.to_owned()));
        if OTHERS.contains(&policy) {
            tracing::warn!("qos_overrides: {policy} has no effect, eddy supports {POLICIES}");
            return Ok(());
        }
        let is_chosen = matches!(policy, "reliability" | "durability" | "history");
        if is_chosen && AS_IT_IS.contains(&text) {
            return Ok(());
        }
        match (policy, text) {
            ("reliability", "reliable") => self.reliability = Some(ReliabilityPolicy::Reliable),
            ("reliability", "best_effort") => {
                self.reliability = Some(ReliabilityPolicy::BestEffort);
            }
            ("reliability", _) => return invalid("reliable or best_effort"),
            ("durability", "volatile") => self.durability = Some(DurabilityPolicy::Volatile),
            ("durability", "transient_local") => {
                self.durability = Some(DurabilityPolicy::TransientLocal);
            }
            ("durability", _) => return invalid("volatile or transient_local"),
            ("history", "keep_last") => self.keep_all = Some(false),
            ("history", "keep_all") => self.keep_all = Some(true),
            ("history", _) => return invalid("keep_last or keep_all"),
            ("depth", _) => match usize::try_from(value.integer_value) {
                Ok(depth) if kind == ParameterKind::Integer && depth > 0 => {
                    self.depth = Some(depth);
                }
                _ => return invalid("a positive number of messages"),
            },
            _ => return Err((quoted(policy), POLICIES.to_owned())),
        }
        Ok(())
    }

    fn over(self, default: QosProfile) -> QosProfile {
        let depth = self.depth.unwrap_or(match default.history {
            HistoryPolicy::KeepLast(depth) => depth,
            HistoryPolicy::KeepAll | HistoryPolicy::Unknown => DEPTH,
        });
        let history = match self.keep_all {
            Some(true) => HistoryPolicy::KeepAll,
            Some(false) => HistoryPolicy::KeepLast(depth),
            None if self.depth.is_some() => HistoryPolicy::KeepLast(depth),
            None => default.history,
        };
        QosProfile {
            reliability: self.reliability.unwrap_or(default.reliability),
            durability: self.durability.unwrap_or(default.durability),
            history,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::RosArguments;

    fn parse(words: &[&str]) -> Result<TopicQos, String> {
        let words: Vec<_> = words.iter().map(|word| (*word).to_owned()).collect();
        let node = RosArguments::parse(&words).unwrap().node("eddy_node");
        TopicQos::from_parameters(node.parameters()).map_err(|error| error.to_string())
    }

    #[test]
    fn parameters_replace_single_policies() {
        let mut qos = parse(&[
            "-p",
            "qos_overrides./prediction.publisher.reliability:=reliable",
            "-p",
            "qos_overrides./prediction.publisher.history:=keep_all",
            "-p",
            "qos_overrides./robot1/status.publisher.depth:=3",
            "-p",
            "qos_overrides./particles.subscription.durability:=transient_local",
            "-p",
            "horizon:=3",
        ])
        .unwrap();
        let live =
            QosProfile { reliability: ReliabilityPolicy::BestEffort, ..QosProfile::default() };
        let blocking = QosProfile { history: HistoryPolicy::KeepAll, ..QosProfile::default() };
        assert_eq!(qos.publisher("/prediction", live), Some(blocking));
        let short = QosProfile { history: HistoryPolicy::KeepLast(3), ..live };
        assert_eq!(qos.publisher("/robot1/status", live), Some(short));
        let short = QosProfile { history: HistoryPolicy::KeepLast(3), ..blocking };
        assert_eq!(qos.publisher("/robot1/status", blocking), Some(short));
        assert_eq!(qos.publisher("/particles", live), None, "that is a subscription");
        assert_eq!(qos.unused().collect::<Vec<_>>(), ["/particles"]);
        let latched = QosProfile { durability: DurabilityPolicy::TransientLocal, ..live };
        assert_eq!(qos.subscription("/particles", live), Some(latched));
        assert_eq!(qos.unused().count(), 0);
    }

    #[test]
    fn other_policies_and_defaults_of_ros_are_accepted_and_change_nothing() {
        for override_ in [
            "deadline:=1000",
            "lifespan:=1000",
            "liveliness:=automatic",
            "liveliness_lease_duration:=1000",
            "avoid_ros_namespace_conventions:=false",
            "reliability:=system_default",
            "durability:=best_available",
            "history:=system_default",
        ] {
            let name = format!("qos_overrides./a.publisher.{override_}");
            let default = QosProfile::default();
            let offered = parse(&["-p", &name]).unwrap().publisher("/a", default);
            assert_eq!(offered, Some(default), "{name}");
        }
    }

    #[test]
    fn overrides_for_an_id_are_checked_and_change_nothing() {
        let name = |value: &str| format!("qos_overrides./a.publisher_front.depth:={value}");
        let default = QosProfile::default();
        assert_eq!(parse(&["-p", &name("3")]).unwrap().publisher("/a", default), None);
        assert!(parse(&["-p", &name("0")]).unwrap_err().contains("a positive number"));
    }

    #[test]
    fn a_file_has_the_levels_of_the_name_as_maps() {
        let text = "eddy_node:\n  ros__parameters:\n    qos_overrides:\n      /diagnostics:\n        publisher: {reliability: best_effort, depth: 1}\n";
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        let mut qos = parse(&["--params-file", file.path().to_str().unwrap()]).unwrap();
        let found = qos.publisher("/diagnostics", QosProfile::default()).unwrap();
        let expected = (ReliabilityPolicy::BestEffort, HistoryPolicy::KeepLast(1));
        assert_eq!((found.reliability, found.history), expected);
    }

    #[test]
    fn invalid_parameters_are_named() {
        for (text, expected) in [
            ("prediction.publisher.depth:=1", "found `qos_overrides.prediction.publisher.depth`"),
            ("/prediction.service.depth:=1", "found `qos_overrides./prediction.service.depth`"),
            ("/prediction:=1", "found `qos_overrides./prediction`, expected qos_overrides.TOPIC"),
            ("/a.publisher.depth:=0", "found 0, expected a positive number"),
            ("/a.publisher.depth:=many", "found `many`, expected a positive number"),
            ("/a.publisher.reliability:=1", "found 1, expected reliable or best_effort"),
            ("/a.publisher.durability:=true", "found a bool, expected volatile or"),
            ("/a.publisher.history:=all", "found `all`, expected keep_last or keep_all"),
            ("/a.publisher.delay:=1", "found `delay`, expected reliability, durability"),
            ("/a.publisher.depth:=system_default", "found `system_default`, expected a positive"),
        ] {
            let message = parse(&["-p", &format!("qos_overrides.{text}")]).unwrap_err();
            assert!(
                message.starts_with(&format!("-p qos_overrides.{text}: {expected}")),
                "{message}"
            );
        }
    }
}
