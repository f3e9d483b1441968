//! A publisher for every topic of a bag, and one for the clock.

use std::{collections::HashMap, sync::Arc};

use crate::ros::RosNode;
use eddy_bag::{BagMessage, BagReader, QosOverrides, TopicInfo};
use eddy_frames::Stamp;
use eddy_messages::{Clock, Message, QosProfile, TypeSupport, cdr, type_support};
use eddy_transport::{
    InvalidLink, Link, Publisher, Reliability, TransportError, TransportKind, Transports,
};

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
pub enum OutputError {
    /// The transport needs the type hash, which the bag lacks and which cannot be computed.
    #[error(
        "topic {topic}: {transport} needs the type hash of {type_name}, which the bag lacks; {reason}"
    )]
    NoHash { topic: String, transport: TransportKind, type_name: String, reason: String },
    /// The type has no name.
    #[error("topic {topic}: no message type in the bag")]
    NoType { topic: String },
    /// A rule for a new name is not of the form `FROM:=TO`.
    #[error("--remap: found `{found}`, expected FROM:=TO, for example /particles:=/truth")]
    Rule { found: String },
    /// A rule names a topic that is not published.
    #[error("--remap: found topic `{found}`, expected one of {expected}")]
    RuleTopic { found: String, expected: String },
    /// A new name is not the name of a topic.
    #[error(transparent)]
    Link(#[from] InvalidLink),
    /// The transport fails.
    #[error(transparent)]
    Transport(#[from] TransportError),
}

/// The topics to publish. Topics that the transport cannot carry are left out with a warning, unless they were named; a
/// recorded clock is left out if a new one is published. A topic with two types appears twice.
///
/// # Errors
/// [`OutputError`] when a named topic cannot be carried.
pub fn playable_topics<'b>(
    bag: &'b BagReader,
    options: &OutputOptions,
) -> Result<Vec<&'b TopicInfo>, OutputError> {
    let mut topics = Vec::new();
    for topic in bag.topics() {
        let is_named = options.topics.contains(&topic.name);
        if !options.topics.is_empty() && !is_named {
            continue;
        }
        if options.clock && topic.name == CLOCK {
            tracing::warn!("topic {CLOCK} of the bag is not published: --clock publishes its own");
            continue;
        }
        match support(topic, options.transport) {
            Ok(_) => topics.push(topic),
            Err(error) if is_named => return Err(error),
            Err(error) => tracing::warn!("not published: {error}"),
        }
    }
    Ok(topics)
}

/// The type of a topic as the transport needs it. Without a type hash in the bag it is that of the definition in the
/// bag, or that of the built-in type. Only Zenoh needs one: subscribers would not find the topic otherwise.
fn support(topic: &TopicInfo, transport: TransportKind) -> Result<TypeSupport, OutputError> {
    let TopicInfo { name, type_name, hash, .. } = topic;
    let built_in = type_support(type_name);
    if let Some(hash) = hash {
        return Ok(match built_in {
            Ok(ours) if ours.hash == *hash => ours.clone(),
            _ => TypeSupport::foreign(type_name, hash),
        });
    }
    if type_name.is_empty() {
        return Err(OutputError::NoType { topic: name.clone() });
    }
    let reason = match (topic.defined_type(), built_in) {
        (Some(Ok(defined)), _) => return Ok(defined),
        (None, Ok(ours)) => return Ok(ours.clone()),
        (Some(Err(error)), _) => error.to_string(),
        (None, Err(_)) if topic.schema.is_empty() => "the bag has no definition of it".to_owned(),
        (None, Err(_)) => format!("its definition is {}, expected ros2msg", topic.schema_encoding),
    };
    match transport {
        TransportKind::Zenoh => {
            let (topic, type_name) = (name.clone(), type_name.clone());
            Err(OutputError::NoHash { topic, transport, type_name, reason })
        }
        _ => Ok(TypeSupport::foreign(type_name, "")),
    }
}

/// The publisher of one topic of the bag.
pub struct PlayedTopic {
    /// Name in the bag.
    pub name: String,
    /// Type, such as `eddy_msgs/msg/ParticleFrame`.
    pub type_name: String,
    /// Where it is published.
    pub link: Link,
    /// Its publisher.
    pub publisher: Box<dyn Publisher>,
    /// Whether a subscriber that reads nothing was logged.
    has_stalled: bool,
}

/// Name and type: a bag may have two types under one name.
type TopicKey = (Arc<str>, Arc<str>);

/// The publishers of a player.
pub struct TopicOutputs {
    topics: Vec<PlayedTopic>,
    by_key: HashMap<TopicKey, usize>,
    clock: Option<(Link, Box<dyn Publisher>)>,
    /// Messages published.
    pub sent: u64,
    /// Messages that are not valid frames, on a transport that carries frames only.
    pub skipped: u64,
    /// Messages that were not delivered to all subscribers.
    pub undelivered: u64,
}

impl TopicOutputs {
    /// Opens a publisher for each of the `playable` topics.
    ///
    /// # Errors
    /// [`OutputError`].
    pub fn open(
        transports: &Transports,
        ros: &RosNode,
        options: &OutputOptions,
        bag: &BagReader,
        playable: &[&TopicInfo],
    ) -> Result<Self, OutputError> {
        let renamed = renamed(options, bag, playable)?;
        let link_of = |topic: &str| -> Result<Link, OutputError> {
            let name = renamed.get(topic).copied().unwrap_or(topic);
            Ok(ros.link(&format!("{}:{name}", options.transport).parse()?))
        };
        let (mut topics, mut by_key) = (Vec::new(), HashMap::new());
        for topic in playable {
            let link = link_of(&topic.name)?;
            let support = support(topic, options.transport)?;
            let recorded = QosProfile::in_place_of(&topic.offered);
            let offered = options.overrides.get(&topic.name).copied().or(recorded);
            let publisher =
                transports.offering_publisher_of(&link, &support, options.reliability, offered)?;
            let (name, type_name) = (topic.name.clone(), topic.type_name.clone());
            by_key.insert((name.as_str().into(), type_name.as_str().into()), topics.len());
            topics.push(PlayedTopic { name, type_name, link, publisher, has_stalled: false });
        }
        let mut clock = None;
        if options.clock {
            let link = link_of(CLOCK)?;
            // Subscribers of the clock need the latest time, not every one.
            let publisher = transports.publisher(&link, Clock::TYPE, Reliability::Drop)?;
            clock = Some((link, publisher));
        }
        Ok(Self { topics, by_key, clock, sent: 0, skipped: 0, undelivered: 0 })
    }

    /// The topics, in the order of the bag.
    pub fn topics(&self) -> &[PlayedTopic] {
        &self.topics
    }

    /// Where the recorded time is published, if it is.
    pub fn clock(&self) -> Option<&Link> {
        self.clock.as_ref().map(|(link, _)| link)
    }

    /// Publishes a message of the bag.
    ///
    /// # Errors
    /// [`TransportError`].
    pub fn publish(&mut self, message: &BagMessage) -> Result<(), TransportError> {
        let key = (message.topic.clone(), message.type_name.clone());
        let Some(&index) = self.by_key.get(&key) else { return Ok(()) };
        let topic = &mut self.topics[index];
        match topic.publisher.publish_cdr(&message.data) {
            Ok(()) => self.sent += 1,
            Err(error @ TransportError::Frame { .. }) => {
                tracing::warn!("{error}");
                self.skipped += 1;
            }
            Err(error) if error.is_missed() => {
                if !std::mem::replace(&mut topic.has_stalled, true) {
                    tracing::warn!("{error}");
                }
                self.sent += 1;
                self.undelivered += 1;
            }
            Err(error) => return Err(error),
        }
        Ok(())
    }

    /// Waits until subscribers have everything, as far as the transport knows, and counts what they do not have.
    ///
    /// # Errors
    /// [`TransportError`] other than undelivered messages.
    pub fn flush(&mut self) -> Result<(), TransportError> {
        for topic in &mut self.topics {
            match topic.publisher.flush() {
                Err(error @ TransportError::Undelivered { messages, .. }) => {
                    tracing::warn!("{error}");
                    self.undelivered += messages;
                }
                outcome => outcome?,
            }
        }
        Ok(())
    }

    /// Publishes the recorded time, if that was asked for.
    ///
    /// # Errors
    /// [`TransportError`].
    pub fn publish_clock(&mut self, recorded: Stamp) -> Result<(), TransportError> {
        let Some((_, clock)) = &mut self.clock else { return Ok(()) };
        clock.publish_cdr(&cdr::encode(&Clock { clock: recorded.into() }))
    }
}

/// The new names of topics, by their names in the bag.
fn renamed<'a>(
    options: &'a OutputOptions,
    bag: &BagReader,
    playable: &[&TopicInfo],
) -> Result<HashMap<&'a str, &'a str>, OutputError> {
    let mut renamed = HashMap::new();
    for rule in &options.remap {
        let Some((from, to)) = rule.split_once(":=") else {
            return Err(OutputError::Rule { found: rule.clone() });
        };
        let is_clock = options.clock && from == CLOCK;
        if !is_clock && !bag.topics().iter().any(|topic| topic.name == from) {
            let names: Vec<&str> = playable.iter().map(|topic| topic.name.as_str()).collect();
            let (found, expected) = (from.to_owned(), names.join(", "));
            return Err(OutputError::RuleTopic { found, expected });
        }
        renamed.insert(from, to);
    }
    Ok(renamed)
}

#[cfg(test)]
mod tests {
    use std::{path::Path, time::Duration};

    use super::*;
    use crate::ros::RosArguments;
    use eddy_bag::{BagWriter, WriterOptions};
    use eddy_messages::RosString;
    use eddy_transport::TransportOptions;

    /// A bag with a word on `/words`, a clock, and messages of types that are not built in, without type hashes: with a
    /// definition on `/imu`, without one on `/raw`.
    fn bag(folder: &Path) -> BagReader {
        let path = folder.join("bag");
        let mut writer = BagWriter::create(&path, WriterOptions::default()).unwrap();
        let words = writer.topic("/words", RosString::TYPE).unwrap();
        let clock = writer.topic(CLOCK, Clock::TYPE).unwrap();
        let mut foreign = |name, schema: &str| {
            let support = TypeSupport::foreign("acme_msgs/msg/Imu", "");
            let support = TypeSupport { schema: schema.to_owned(), ..support };
            writer.offered_topic(name, &support, &[]).unwrap()
        };
        let (imu, raw) = (foreign("/imu", "float64 x\n"), foreign("/raw", ""));
        let word = cdr::encode(&RosString { data: "eddy".into() });
        for topic in [words, clock, imu, raw] {
            writer.write(topic, Stamp(1), Stamp(1), &word).unwrap();
        }
        writer.finish().unwrap();
        BagReader::open(&path).unwrap()
    }

    fn options() -> OutputOptions {
        OutputOptions {
            transport: TransportKind::Memory,
            topics: Vec::new(),
            remap: Vec::new(),
            clock: false,
            reliability: Reliability::Block,
            overrides: QosOverrides::new(),
        }
    }

    fn names(topics: &[&TopicInfo]) -> Vec<String> {
        topics.iter().map(|topic| topic.name.clone()).collect()
    }

    #[test]
    fn topics_that_cannot_be_carried_are_left_out_unless_they_were_named() {
        let folder = tempfile::tempdir().unwrap();
        let bag = bag(folder.path());
        for transport in [TransportKind::Shm, TransportKind::Dds] {
            let options = OutputOptions { transport, ..options() };
            let all = [CLOCK, "/imu", "/raw", "/words"];
            assert_eq!(names(&playable_topics(&bag, &options).unwrap()), all, "{transport}");
        }
        let zenoh = OutputOptions { transport: TransportKind::Zenoh, ..options() };
        assert_eq!(names(&playable_topics(&bag, &zenoh).unwrap()), [CLOCK, "/imu", "/words"]);
        let named = OutputOptions { topics: vec!["/raw".to_owned()], ..zenoh };
        let message = playable_topics(&bag, &named).unwrap_err().to_string();
        let expected = "topic /raw: zenoh needs the type hash of acme_msgs/msg/Imu, which the bag lacks; the bag has no";
        assert!(message.starts_with(expected), "{message}");
    }

    #[test]
    fn a_type_hash_that_the_bag_lacks_is_that_of_its_definition() {
        let folder = tempfile::tempdir().unwrap();
        let bag = bag(folder.path());
        let topic = bag.topics().iter().find(|topic| topic.name == "/imu").unwrap();
        let support = support(topic, TransportKind::Zenoh).unwrap();
        let expected = TypeSupport::from_schema("acme_msgs/msg/Imu", "float64 x").unwrap().hash;
        assert_eq!(support.hash, expected);
    }

    #[test]
    fn a_new_clock_replaces_the_recorded_one() {
        let folder = tempfile::tempdir().unwrap();
        let bag = bag(folder.path());
        let with_clock = OutputOptions { clock: true, ..options() };
        assert_eq!(names(&playable_topics(&bag, &with_clock).unwrap()), ["/imu", "/raw", "/words"]);
    }

    #[test]
    fn rules_that_cannot_be_applied_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let bag = bag(folder.path());
        let transports = Transports::new(TransportOptions::new("outputs"));
        let ros = RosArguments::default().node("outputs");
        for (rule, expected) in [
            ("/words", "--remap: found `/words`, expected FROM:=TO"),
            (
                "/word:=/a",
                "--remap: found topic `/word`, expected one of /clock, /imu, /raw, /words",
            ),
        ] {
            let options = OutputOptions { remap: vec![rule.to_owned()], ..options() };
            let playable = playable_topics(&bag, &options).unwrap();
            let outputs = TopicOutputs::open(&transports, &ros, &options, &bag, &playable);
            let message = outputs.err().unwrap().to_string();
            assert!(message.starts_with(expected), "{message}");
        }
    }

    #[test]
    fn messages_and_the_clock_are_published_under_their_new_names() {
        let folder = tempfile::tempdir().unwrap();
        let bag = bag(folder.path());
        let transports = Transports::new(TransportOptions::new("outputs"));
        let ros = RosArguments::default().node("outputs");
        let remap = ["/words:=/renamed", "/clock:=/time"].map(str::to_owned).to_vec();
        let options = OutputOptions { clock: true, remap, ..options() };
        let playable = playable_topics(&bag, &options).unwrap();
        let mut words = transports.subscriber(&Link::memory("/renamed"), RosString::TYPE).unwrap();
        let mut time = transports.subscriber(&Link::memory("/time"), Clock::TYPE).unwrap();
        let mut outputs = TopicOutputs::open(&transports, &ros, &options, &bag, &playable).unwrap();
        for message in bag.messages() {
            outputs.publish(&message.unwrap()).unwrap();
        }
        outputs.publish_clock(Stamp(7)).unwrap();
        // Not the recorded clock.
        assert_eq!((outputs.sent, outputs.skipped), (3, 0));
        let receive = |subscriber: &mut dyn eddy_transport::Subscriber| {
            subscriber.receive(Duration::from_secs(60)).unwrap().unwrap().into_cdr()
        };
        let word: RosString = cdr::decode(&receive(words.as_mut())).unwrap();
        assert_eq!(word.data, "eddy");
        let clock: Clock = cdr::decode(&receive(time.as_mut())).unwrap();
        assert_eq!(Stamp::from(clock.clock), Stamp(7));
    }
}
