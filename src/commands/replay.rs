//! `eddy replay`: a bag onto topics, at its recorded pace.

use std::{collections::HashMap, sync::Arc, thread, time::Duration};

use anyhow::{Context, bail};
use indicatif::HumanCount;

use super::{Interrupt, leaves_the_process, wait_for_subscribers};
use crate::cli::ReplayArgs;
use eddy::{
    bag::{BagMessage, BagReader},
    clock::Clock,
    msg::type_support,
    node::{Due, Player, PlayerOptions},
    transport::{Link, Publisher, TransportError, TransportOptions, Transports},
};

/// Longest sleep, so that a signal ends the replay soon.
const NAP: Duration = Duration::from_millis(20);

/// Publishes the bag's messages until its end or a signal.
pub fn run(args: ReplayArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let bag = BagReader::open(&args.bag)?;
    let topics = playable(&bag, &args.topics)?;
    let mut player = Player::new(
        &bag,
        PlayerOptions {
            rate: args.rate,
            start_offset: args.start_offset,
            duration: args.duration,
            looped: args.looped,
            topics: Some(topics.clone()),
        },
    )?;
    // Sessions end with it: it stays until the last message is out.
    let transports = Transports::new(TransportOptions::from_env("eddy_replay")?);
    let mut outputs = open(&transports, &args, &bag, &topics)?;
    if !wait_for(&outputs, args.wait_for, interrupt)? {
        return Ok(());
    }
    let clock = Clock::start();
    while !interrupt.requested() {
        match player.poll(clock.now())? {
            Due::Now(message) => outputs.publish(&message)?,
            Due::In(wait) => thread::sleep(wait.min(NAP)),
            Due::Never => break,
        }
    }
    if !quiet {
        let seconds = clock.now().as_secs_f64();
        println!(
            "{}: {} messages in {seconds:.1} s",
            bag.path().display(),
            HumanCount(outputs.sent)
        );
    }
    if outputs.refused > 0 {
        bail!(
            "{}: {} messages that are no frames were left out",
            bag.path().display(),
            outputs.refused
        );
    }
    Ok(())
}

/// The topics to play. Those of types we do not know are left out, unless they were asked for.
fn playable(bag: &BagReader, wanted: &[String]) -> anyhow::Result<Vec<String>> {
    let mut topics = Vec::new();
    for topic in bag.topics() {
        let asked_for = wanted.contains(&topic.name);
        if !wanted.is_empty() && !asked_for {
            continue;
        }
        match type_support(&topic.type_name) {
            Ok(_) => topics.push(topic.name.clone()),
            Err(error) if asked_for => {
                return Err(error).with_context(|| format!("topic {}", topic.name));
            }
            Err(error) => tracing::warn!("topic {} is left out: {error}", topic.name),
        }
    }
    // Names the bag lacks are the player's to refuse.
    topics.extend(
        wanted.iter().filter(|name| !bag.topics().iter().any(|t| t.name == **name)).cloned(),
    );
    Ok(topics)
}

/// A topic's name and type: a bag may hold a name with two types.
type TopicKey = (Arc<str>, Arc<str>);

/// The publishers of the topics of the bag.
struct Outputs {
    publishers: HashMap<TopicKey, (Link, Box<dyn Publisher>)>,
    sent: u64,
    /// Messages that the transport cannot carry because they are no frames.
    refused: u64,
}

fn open(
    transports: &Transports,
    args: &ReplayArgs,
    bag: &BagReader,
    topics: &[String],
) -> anyhow::Result<Outputs> {
    let mut renamed = HashMap::new();
    for rule in &args.remap {
        let Some((from, to)) = rule.split_once(":=") else {
            bail!("--remap: found `{rule}`, expected FROM:=TO, for example /particles:=/truth");
        };
        if !bag.topics().iter().any(|topic| topic.name == from) {
            bail!("--remap: found topic `{from}`, expected one of {}", topics.join(", "));
        }
        renamed.insert(from, to);
    }
    let mut publishers = HashMap::new();
    for topic in bag.topics().iter().filter(|topic| topics.contains(&topic.name)) {
        let name = renamed.get(topic.name.as_str()).copied().unwrap_or(&topic.name);
        let link: Link = format!("{}:{name}", args.to).parse()?;
        leaves_the_process(&link)?;
        let publisher = transports.publisher(&link, &topic.type_name, args.reliability)?;
        println!("publishing {} on {link} ({})", topic.name, topic.type_name);
        let key = (topic.name.as_str().into(), topic.type_name.as_str().into());
        publishers.insert(key, (link, publisher));
    }
    Ok(Outputs { publishers, sent: 0, refused: 0 })
}

impl Outputs {
    fn publish(&mut self, message: &BagMessage) -> anyhow::Result<()> {
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
}

/// Waits until every topic has `wanted` subscribers. `false` when a signal came first.
fn wait_for(outputs: &Outputs, wanted: usize, interrupt: &Interrupt) -> anyhow::Result<bool> {
    for (link, publisher) in outputs.publishers.values() {
        if !wait_for_subscribers(link, publisher.as_ref(), wanted, interrupt)? {
            return Ok(false);
        }
    }
    Ok(true)
}
