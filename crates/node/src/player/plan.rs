//! What of a bag is published, where and as which type; what is left out, and why.

use std::{
    collections::{BTreeMap, HashMap, HashSet},
    sync::Arc,
};

use crate::ros::RosNode;
use eddy_bag::{BagReader, Channel, QosOverrides, TopicInfo};
use eddy_messages::{QosProfile, TypeSupport, type_support};
use eddy_transport::{InvalidLink, Link, Reliability, TransportKind, is_absolute_name};

/// The topic of simulated time in ROS.
const CLOCK: &str = "/clock";

/// What is published, where and how.
#[derive(Clone, Debug)]
pub struct OutputOptions {
    /// The transport of all topics.
    pub transport: TransportKind,
    /// Names of the topics to publish; all that the transport can carry if empty.
    pub topics: Vec<String>,
    /// New names, each `FROM:=TO`.
    pub remap: Vec<String>,
    /// Whether to publish the recorded time on `/clock`.
    pub clock: bool,
    /// What happens when a subscriber cannot keep up.
    pub reliability: Reliability,
    /// Quality of service to offer in place of the recorded one, by the name of the topic in the bag.
    pub overrides: QosOverrides,
}

/// Why a topic cannot be published.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the message says what the fields are")]
pub enum PlanError {
    /// The transport needs the type hash, which the bag lacks and which cannot be computed.
    #[error(
        "topic {topic}: {transport} needs the type hash of {type_name}, which the bag lacks; {reason}"
    )]
    NoHash { topic: String, transport: TransportKind, type_name: String, reason: String },
    /// The type has no name.
    #[error("topic {topic}: no message type in the bag")]
    NoType { topic: String },
    /// The topic would be published under a name that another topic has.
    #[error(
        "topic {topic} ({type_name}): found another topic at {link}, expected a free name, which --remap can give"
    )]
    Taken { topic: String, type_name: String, link: Link },
    /// A rule for a new name is not of the form `FROM:=TO`.
    #[error("--remap: found `{found}`, expected FROM:=TO, for example /particles:=/truth")]
    Rule { found: String },
    /// A rule names a topic that is not published.
    #[error("--remap: found topic `{found}`, expected one of {expected}")]
    RuleTopic { found: String, expected: String },
    /// A new name is not the name of a topic.
    #[error(transparent)]
    Link(#[from] InvalidLink),
}

/// A topic of the bag as it is to be published: its messages of one type, and of one version of the type if the transport
/// tells versions apart.
pub struct PlannedTopic {
    /// Name in the bag.
    pub name: String,
    /// Type, as the transport needs it.
    pub support: TypeSupport,
    /// Where it is published.
    pub link: Link,
    /// Quality of service to offer; what follows from the reliability if `None`.
    pub offered: Option<QosProfile>,
    /// Whether it is published beside another type, or another version of the type, of the same topic. Nobody is waited for
    /// there.
    pub is_aside: bool,
    /// Its descriptions in the bag.
    pub(super) channels: Vec<Arc<Channel>>,
}

/// The topics of a bag to publish.
pub struct PlaybackPlan {
    /// In the order of the bag.
    pub topics: Vec<PlannedTopic>,
    /// Why topics are left out, once for each.
    pub left_out: Vec<String>,
    /// Where to publish the recorded time.
    pub(super) clock: Option<Link>,
}

impl PlaybackPlan {
    /// Topics that the transport cannot carry are left out, unless they were named. Those whose name ROS does not allow are
    /// published under a similar one. Types that a transport cannot carry on one topic, and versions of a type that it
    /// tells apart, are published apart. A recorded clock is left out if a new one is published.
    ///
    /// # Errors
    /// [`PlanError`] when a named topic cannot be carried, and for wrong rules.
    pub fn new(bag: &BagReader, ros: &RosNode, options: &OutputOptions) -> Result<Self, PlanError> {
        let mut plan = Self { topics: Vec::new(), left_out: Vec::new(), clock: None };
        let names = Names::of(bag, ros, options)?;
        for topic in bag.topics() {
            let is_named = options.topics.contains(&topic.name);
            if !options.topics.is_empty() && !is_named {
                continue;
            }
            if options.clock && topic.name == CLOCK {
                tracing::warn!(
                    "topic {CLOCK} of the bag is not published: --clock publishes its own"
                );
                continue;
            }
            for version in versions(bag, topic, options.transport) {
                match plan.add(version, &names, options) {
                    Ok(()) => {}
                    Err(error @ PlanError::Link(_)) => return Err(error),
                    Err(error) if is_named => return Err(error),
                    Err(error) => plan.leave_out(error.to_string()),
                }
            }
        }
        if options.clock {
            plan.clock = Some(names.link(CLOCK)?);
        }
        names.check_rules(&plan, options)?;
        Ok(plan)
    }

    /// Leaves something out and says so.
    pub(super) fn leave_out(&mut self, reason: String) {
        tracing::warn!("not published: {reason}");
        self.left_out.push(reason);
    }

    /// Whether another topic of the bag is published there.
    fn has_other(&self, link: &Link, name: &str) -> bool {
        self.topics.iter().any(|other| other.name != name && other.link == *link)
    }

    fn add(
        &mut self,
        Version { topic, channels }: Version,
        names: &Names<'_>,
        options: &OutputOptions,
    ) -> Result<(), PlanError> {
        let transport = options.transport;
        let support = support(&topic, transport)?;
        let mut link = names.link(&topic.name)?;
        let (name, type_name) = (topic.name.clone(), topic.type_name.clone());
        let shown = name.escape_debug();
        let taken = |link: &Link| PlanError::Taken {
            topic: shown.to_string(),
            type_name: type_name.clone(),
            link: link.clone(),
        };
        if names.is_changed(&name) && (self.has_other(&link, &name) || names.is_other(&link, &name))
        {
            return Err(taken(&link));
        }
        let mut is_aside = false;
        if let Some(other) = self.topics.iter().find(|other| other.link == link) {
            if other.name != name {
                // Two topics under one name are what the user asked for with a rule, if they have one type.
                if other.support.name != support.name {
                    return Err(taken(&link));
                }
            } else if transport.is_of_ros() {
                is_aside = true;
                // Versions of one type were named before.
                if other.support.name != support.name {
                    tracing::warn!(
                        "topic {shown}: found {type_name} beside {} in the bag; both are published on {link}, \
                         subscribers receive the one they ask for",
                        other.support.name
                    );
                }
            } else {
                is_aside = true;
                let aside = link.with_topic(&aside(&link.topic, &type_name));
                if self.has_other(&aside, &name) || names.is_other(&aside, &name) {
                    return Err(taken(&aside));
                }
                tracing::warn!(
                    "topic {shown}: found {type_name} beside {} in the bag, and {transport} carries one type on a topic; \
                     published apart, on {aside}",
                    other.support.name
                );
                link = aside;
            }
        }
        let recorded = QosProfile::in_place_of(&topic.offered);
        let offered = options.overrides.get(&name).copied().or(recorded);
        self.topics.push(PlannedTopic { name, support, link, offered, is_aside, channels });
        Ok(())
    }
}

/// The name of a topic of another type beside the topic: `/scan/sensor_msgs/LaserScan`.
fn aside(topic: &str, type_name: &str) -> String {
    let parts: Vec<&str> = type_name.split('/').collect();
    let name = match parts[..] {
        [package, .., last] => format!("{topic}/{package}/{last}"),
        _ => format!("{topic}/{type_name}"),
    };
    allowed_name(&name)
}

/// The messages of a topic that have one type, in one version.
struct Version {
    topic: TopicInfo,
    channels: Vec<Arc<Channel>>,
}

/// The versions of the type of a topic. A transport without type hashes cannot tell them apart: there it is one, with a
/// warning.
fn versions(bag: &BagReader, topic: &TopicInfo, transport: TransportKind) -> Vec<Version> {
    let of_topic = |channel: &&Arc<Channel>| {
        channel.topic == topic.name && channel.type_name() == topic.type_name
    };
    let all: Vec<_> = bag.channels().iter().filter(of_topic).cloned().collect();
    let mut versions: BTreeMap<String, Version> = BTreeMap::new();
    let mut undefined = Vec::new();
    for channel in &all {
        let described = described(topic, channel);
        let hash = described.hash.clone().or_else(|| Some(described.defined_type()?.ok()?.hash));
        let key = match hash {
            Some(hash) => hash,
            None if described.has_definition() => described.schema.clone(),
            None => {
                undefined.push(Arc::clone(channel));
                continue;
            }
        };
        let version = Version { topic: described, channels: Vec::new() };
        versions.entry(key).or_insert(version).channels.push(Arc::clone(channel));
    }
    if versions.len() < 2 {
        return vec![Version { topic: topic.clone(), channels: all }];
    }
    let (shown, type_name) = (topic.name.escape_debug(), &topic.type_name);
    let count = versions.len();
    if transport != TransportKind::Zenoh {
        tracing::warn!(
            "topic {shown}: found {count} versions of {type_name} in the bag, which {transport} does not tell apart: \
             subscribers receive all of them and may misread some"
        );
        return vec![Version { topic: topic.clone(), channels: all }];
    }
    tracing::warn!(
        "topic {shown}: found {count} versions of {type_name} in the bag, published under a type hash each: subscribers \
         receive the version they know"
    );
    let mut versions: Vec<_> = versions.into_values().collect();
    if !undefined.is_empty() {
        versions.push(Version {
            topic: TopicInfo {
                schema: String::new(),
                schema_encoding: String::new(),
                hash: None,
                ..topic.clone()
            },
            channels: undefined,
        });
    }
    versions
}

/// The topic as one of its channels describes it.
fn described(topic: &TopicInfo, channel: &Channel) -> TopicInfo {
    let (schema, schema_encoding) = match &channel.schema {
        Some(schema) => {
            (String::from_utf8_lossy(&schema.data).into_owned(), schema.encoding.clone())
        }
        None => (String::new(), String::new()),
    };
    let hash = channel.type_hash().map(str::to_owned);
    TopicInfo { schema, schema_encoding, hash, ..topic.clone() }
}

/// The type of a topic as the transport needs it. Without a type hash in the bag it is that of the definition in the
/// bag, or that of the built-in type. Only Zenoh needs one: subscribers would not find the topic otherwise.
fn support(topic: &TopicInfo, transport: TransportKind) -> Result<TypeSupport, PlanError> {
    let TopicInfo { name, type_name, hash, .. } = topic;
    let built_in = type_support(type_name);
    if type_name.is_empty() {
        return Err(PlanError::NoType { topic: name.escape_debug().to_string() });
    }
    if let Some(hash) = hash {
        return Ok(match built_in {
            Ok(ours) if ours.hash == *hash => ours.clone(),
            _ => TypeSupport::foreign(type_name, hash),
        });
    }
    let reason = match (topic.defined_type(), built_in) {
        (Some(Ok(defined)), _) => return Ok(defined),
        (None, Ok(ours)) => return Ok(ours.clone()),
        (Some(Err(error)), _) => error.to_string(),
        (None, Err(_)) if !topic.has_definition() => "the bag has no definition of it".to_owned(),
        (None, Err(_)) => format!("its definition is {}, expected ros2msg", topic.schema_encoding),
    };
    match transport {
        TransportKind::Zenoh => {
            let (topic, type_name) = (name.escape_debug().to_string(), type_name.clone());
            Err(PlanError::NoHash { topic, transport, type_name, reason })
        }
        _ => Ok(TypeSupport::foreign(type_name, "")),
    }
}

/// The names under which topics are published.
struct Names<'a> {
    transport: TransportKind,
    ros: &'a RosNode,
    /// Those that differ, by the name in the bag.
    new: HashMap<&'a str, String>,
    /// Names in the bag that ROS does not allow.
    changed: HashSet<&'a str>,
    /// All of the bag.
    all: Vec<&'a str>,
}

impl<'a> Names<'a> {
    fn of(
        bag: &'a BagReader,
        ros: &'a RosNode,
        options: &'a OutputOptions,
    ) -> Result<Self, PlanError> {
        let mut all: Vec<&str> = bag.topics().iter().map(|topic| topic.name.as_str()).collect();
        all.dedup();
        let (mut new, mut changed) = (HashMap::new(), HashSet::new());
        for rule in &options.remap {
            let Some((from, to)) = rule.split_once(":=") else {
                return Err(PlanError::Rule { found: rule.clone() });
            };
            new.insert(from, to.to_owned());
        }
        let is_played = |name: &&&str| {
            options.topics.is_empty() || options.topics.iter().any(|named| named == **name)
        };
        for name in all.iter().filter(is_played) {
            if is_absolute_name(name) || new.contains_key(*name) {
                continue;
            }
            let allowed = allowed_name(name);
            tracing::warn!(
                "topic {}: ROS does not allow this name (letters, digits and _; no part starts with a digit); published \
                 as {allowed}, or as --remap says",
                name.escape_debug()
            );
            new.insert(*name, allowed);
            changed.insert(*name);
        }
        Ok(Self { transport: options.transport, ros, new, changed, all })
    }

    /// Where a topic of the bag is published.
    fn link(&self, topic: &str) -> Result<Link, InvalidLink> {
        let name = self.new.get(topic).map_or(topic, String::as_str);
        Ok(self.ros.link(&format!("{}:{name}", self.transport).parse()?))
    }

    /// Whether the name was changed because ROS does not allow it.
    fn is_changed(&self, topic: &str) -> bool {
        self.changed.contains(topic)
    }

    /// Whether this is the place of another topic whose name was not changed.
    fn is_other(&self, link: &Link, topic: &str) -> bool {
        let mut others = self.all.iter().filter(|name| **name != topic && !self.is_changed(name));
        others.any(|name| self.link(name).is_ok_and(|other| other == *link))
    }

    fn check_rules(&self, plan: &PlaybackPlan, options: &OutputOptions) -> Result<(), PlanError> {
        for rule in &options.remap {
            let from = rule.split_once(":=").map_or(rule.as_str(), |(from, _)| from);
            let is_clock = options.clock && from == CLOCK;
            if !is_clock && !self.all.contains(&from) {
                let mut names: Vec<&str> =
                    plan.topics.iter().map(|topic| topic.name.as_str()).collect();
                names.dedup();
                let (found, expected) = (from.to_owned(), names.join(", "));
                return Err(PlanError::RuleTopic { found, expected });
            }
        }
        Ok(())
    }
}

/// The name that ROS allows and that is most like this one: other characters become `_`.
fn allowed_name(name: &str) -> String {
    let part = |part: &str| {
        let digit = part.starts_with(|c: char| c.is_ascii_digit());
        let allowed = part.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' });
        format!("/{}{}", if digit { "_" } else { "" }, allowed.collect::<String>())
    };
    let parts: String = name.split('/').filter(|part| !part.is_empty()).map(part).collect();
    if parts.is_empty() { "/unnamed".to_owned() } else { parts }
}

#[cfg(test)]
mod tests;
