//! A publisher for every topic, and one for the clock.

use std::{collections::HashMap, num::NonZeroUsize, sync::Arc};

use anyhow::{Context, bail};

use crate::{
    cli::ReplayArgs,
    commands::{Interrupt, leaves_the_process, wait_for_subscribers},
};
use eddy_bag::{BagMessage, BagReader, TopicInfo};
use eddy_frames::Stamp;
use eddy_messages::{Clock, Message, TypeSupport, cdr, type_support};
use eddy_node::ros::RosNode;
use eddy_transport::{Link, Publisher, Reliability, TransportError, TransportKind, Transports};

/// Where ROS looks for simulated time.
const CLOCK: &str = "/clock";

/// The topics to play. Those that the transport cannot carry are left out, unless they were asked for;
/// a recorded clock is left out when there is a new one. A name with two types is there twice, if both can
/// be carried.
pub(super) fn playable<'b>(
    bag: &'b BagReader,
    args: &ReplayArgs,
) -> anyhow::Result<Vec<&'b TopicInfo>> {
    let wanted = &args.topics;
    let mut topics = Vec::new();
    for topic in bag.topics() {
        let asked_for = wanted.contains(&topic.name);
        if !wanted.is_empty() && !asked_for {
            continue;
        }
        if args.clock.is_some() && topic.name == CLOCK {
            tracing::warn!("topic {CLOCK} is left out: --clock publishes its own");
            continue;
        }
        match support(topic, args.to) {
            Ok(_) => topics.push(topic),
            Err(error) if asked_for => {
                return Err(error).with_context(|| format!("topic {}", topic.name));
            }
            Err(error) => {
                let TopicInfo { name, type_name, .. } = topic;
                tracing::warn!("topic {name} ({type_name}) is left out: {error}");
            }
        }
    }
    Ok(topics)
}

/// The names to play, each once; also those that were asked for and that the bag lacks, which are the
/// player's to refuse.
pub(super) fn names(playable: &[&TopicInfo], bag: &BagReader, args: &ReplayArgs) -> Vec<String> {
    let lacks = |name: &&String| !bag.topics().iter().any(|topic| topic.name == **name);
    let mut names: Vec<String> = playable.iter().map(|topic| topic.name.clone()).collect();
    names.dedup();
    names.extend(args.topics.iter().filter(lacks).cloned());
    names
}

/// What the transport has to know of a topic's type. Types that are unknown here pass through as bytes,
/// with the type hash that the bag gives, without which nobody on Zenoh would find them.
fn support(topic: &TopicInfo, to: TransportKind) -> anyhow::Result<TypeSupport> {
    let TopicInfo { type_name, hash, .. } = topic;
    let unknown = match type_support(type_name) {
        Ok(ours) if hash.as_ref().is_none_or(|hash| *hash == ours.hash) => return Ok(ours.clone()),
        Ok(_) => None,
        Err(unknown) => Some(unknown),
    };
    match (hash, unknown) {
        (Some(hash), _) => Ok(TypeSupport::foreign(type_name, hash)),
        (None, _) if to == TransportKind::Shm && !type_name.is_empty() => {
            Ok(TypeSupport::foreign(type_name, ""))
        }
        (None, Some(unknown)) => {
            Err(unknown).with_context(|| format!("on {to}, without a type hash in the bag"))
        }
        (None, None) => bail!("found no type hash in the bag, expected one"),
    }
}

/// A topic's name and type: a bag may hold a name with two types.
type TopicKey = (Arc<str>, Arc<str>);

/// The publishers of the topics of the bag.
pub(super) struct Outputs {
    publishers: HashMap<TopicKey, (Link, Box<dyn Publisher>)>,
    clock: Option<Box<dyn Publisher>>,
    pub(super) sent: u64,
    /// Messages that the transport cannot carry because they are no frames.
    pub(super) refused: u64,
}

impl Outputs {
    pub(super) fn open(
        transports: &Transports,
        ros: &RosNode,
        args: &ReplayArgs,
        bag: &BagReader,
        playable: &[&TopicInfo],
    ) -> anyhow::Result<Self> {
        let renamed = renamed(args, bag, playable)?;
        let link_of = |topic: &str| -> anyhow::Result<Link> {
            let name = renamed.get(topic).copied().unwrap_or(topic);
            let link = ros.link(&format!("{}:{name}", args.to).parse()?);
            leaves_the_process(&link)?;
            Ok(link)
        };
        let mut publishers = HashMap::new();
        for topic in playable {
            let link = link_of(&topic.name)?;
            let support = support(topic, args.to)?;
            let kept = NonZeroUsize::new(topic.kept);
            let publisher =
                transports.keeping_publisher_of(&link, &support, args.reliability, kept)?;
            println!("publishing {} on {link} ({})", topic.name, topic.type_name);
            let key = (topic.name.as_str().into(), topic.type_name.as_str().into());
            publishers.insert(key, (link, publisher));
        }
        let mut clock = None;
        if args.clock.is_some() {
            let link = link_of(CLOCK)?;
            // Whoever reads the clock wants the newest, not each.
            clock = Some(transports.publisher(&link, Clock::TYPE, Reliability::Drop)?);
            println!("publishing the recorded time on {link} ({})", Clock::TYPE);
        }
        Ok(Self { publishers, clock, sent: 0, refused: 0 })
    }

    pub(super) fn publish(&mut self, message: &BagMessage) -> anyhow::Result<()> {
        let key = (message.topic.clone(), message.type_name.clone());
        let Some((_, publisher)) = self.publishers.get_mut(&key) else { return Ok(()) };
        match publisher.publish_cdr(&message.data) {
            Ok(()) => self.sent += 1,
            Err(error @ TransportError::Frame { .. }) => {
                tracing::warn!("{error}");
                self.refused += 1;
            }
            Err(error) => return Err(error.into()),
        }
        Ok(())
    }

    /// Publishes the recorded time.
    pub(super) fn tell(&mut self, recorded: Stamp) -> anyhow::Result<()> {
        let Some(clock) = &mut self.clock else { return Ok(()) };
        Ok(clock.publish_cdr(&cdr::encode(&Clock { clock: recorded.into() }))?)
    }

    /// Waits until every topic has `wanted` subscribers. `false` when a signal came first.
    pub(super) fn wait_for(&self, wanted: usize, interrupt: &Interrupt) -> anyhow::Result<bool> {
        for (link, publisher) in self.publishers.values() {
            if !wait_for_subscribers(link, publisher.as_ref(), wanted, interrupt)? {
                return Ok(false);
            }
        }
        Ok(true)
    }
}

/// The new names of topics.
fn renamed<'a>(
    args: &'a ReplayArgs,
    bag: &BagReader,
    playable: &[&TopicInfo],
) -> anyhow::Result<HashMap<&'a str, &'a str>> {
    let mut renamed = HashMap::new();
    for rule in &args.remap {
        let Some((from, to)) = rule.split_once(":=") else {
            bail!("--remap: found `{rule}`, expected FROM:=TO, for example /particles:=/truth");
        };
        let is_clock = args.clock.is_some() && from == CLOCK;
        if !is_clock && !bag.topics().iter().any(|topic| topic.name == from) {
            let names: Vec<&str> = playable.iter().map(|topic| topic.name.as_str()).collect();
            bail!("--remap: found topic `{from}`, expected one of {}", names.join(", "));
        }
        renamed.insert(from, to);
    }
    Ok(renamed)
}
