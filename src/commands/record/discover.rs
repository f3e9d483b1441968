//! Which topics there are, now and later.

use std::{
    collections::HashSet,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use super::intake::Received;
use eddy::{
    bag::TopicChoice,
    clock::Clock,
    node::Producer,
    transport::{TransportKind, Transports},
};

/// Between two looks at what there is: messages published before their topic is found are missed.
const INTERVAL: Duration = Duration::from_millis(200);
/// Longest sleep, so that the end of the recording is soon seen.
const NAP: Duration = Duration::from_millis(20);

/// What is looked for, and where.
pub(super) struct Search {
    pub(super) transports: Transports,
    pub(super) from: Vec<TransportKind>,
    pub(super) choice: TopicChoice,
}

impl Search {
    /// Subscribes to every wanted topic that appears, until `stop`. A topic that is on several
    /// transports is recorded from where it is found first; so is one with several types.
    pub(super) fn run(
        &self,
        mut known: HashSet<String>,
        producer: &Producer<Received>,
        stop: &AtomicBool,
    ) {
        while !stop.load(Ordering::Relaxed) {
            for &transport in &self.from {
                self.look(transport, &mut known, producer);
            }
            let clock = Clock::start();
            while clock.now() < INTERVAL && !stop.load(Ordering::Relaxed) {
                thread::sleep(NAP);
            }
        }
    }

    fn look(
        &self,
        transport: TransportKind,
        known: &mut HashSet<String>,
        producer: &Producer<Received>,
    ) {
        let topics = match self.transports.topics(transport) {
            Ok(topics) => topics,
            Err(error) => {
                // Once: it will hardly be another one the next time.
                if known.insert(format!("{transport}:")) {
                    tracing::warn!("the topics on {transport} cannot be listed: {error}");
                }
                return;
            }
        };
        for topic in topics.into_iter().filter(|topic| self.choice.wants(&topic.link.topic)) {
            if !known.insert(topic.link.topic.clone()) {
                continue;
            }
            match self.transports.subscriber_of(&topic.link, &topic.type_support()) {
                Ok(subscriber) => {
                    producer.bring(Received::Opened(topic, subscriber), 0, Duration::MAX);
                }
                Err(error) => tracing::warn!("{} is not recorded: {error}", topic.link),
            }
        }
    }
}
