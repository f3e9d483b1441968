//! Topics that are published, now and later: those that are wanted are subscribed to.

use std::{
    collections::{BTreeMap, HashSet},
    sync::{
        Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use super::{cache::Producer, intake::Received};
use eddy_bag::TopicFilter;
use eddy_frames::clock::Clock;
use eddy_transport::{Link, TransportKind, Transports};

/// Between two looks at what there is: messages published before their topic is found are missed.
const INTERVAL: Duration = Duration::from_millis(200);
/// Longest sleep, so that the end of the recording is soon seen.
const NAP: Duration = Duration::from_millis(20);

/// Looks for topics that are to be recorded.
pub struct TopicSearch {
    transports: Transports,
    from: Vec<TransportKind>,
    choice: TopicFilter,
    found: Mutex<Found>,
}

/// What is known of the topics that there are.
struct Found {
    /// Names of those that are recorded, or were.
    known: HashSet<String>,
    /// Those that cannot be recorded, by name: for each link what is against it.
    failed: BTreeMap<String, Reasons>,
    /// Those that were recorded until nothing more could be had from them.
    ended: Reasons,
}

/// Links, and why nothing, or nothing more, is recorded from them.
pub type Reasons = BTreeMap<String, String>;

impl TopicSearch {
    /// Looks on the transports `from` for topics that are chosen, but for those with the names `known`, which are
    /// recorded already.
    pub fn new(
        transports: Transports,
        from: Vec<TransportKind>,
        choice: TopicFilter,
        known: HashSet<String>,
    ) -> Self {
        let found = Found { known, failed: BTreeMap::new(), ended: Reasons::new() };
        Self { transports, from, choice, found: Mutex::new(found) }
    }

    /// Whether no topic can be chosen.
    pub(super) fn is_empty(&self) -> bool {
        self.choice.is_empty()
    }

    /// Subscribes to every wanted topic that appears, until `stop`. A topic that is on several
    /// transports is recorded from where it is found first; so is one with several types. One that
    /// cannot be subscribed to is tried again at every look.
    pub(super) fn run(&self, producer: &Producer<Received>, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            for &transport in &self.from {
                self.look(transport, producer);
            }
            let clock = Clock::start();
            while clock.now() < INTERVAL && !stop.load(Ordering::Relaxed) {
                thread::sleep(NAP);
            }
        }
    }

    /// Counts a topic that cannot be recorded from there.
    pub(super) fn fails(&self, link: &Link, error: &dyn std::error::Error) {
        let mut found = self.lock();
        let reasons = found.failed.entry(link.topic.clone()).or_default();
        let known = reasons.insert(link.to_string(), error.to_string());
        drop(found);
        if known.is_none() {
            tracing::warn!("{link} is not recorded: {error}");
        }
    }

    /// Notes a topic that is recorded no longer.
    pub(super) fn ends(&self, link: &Link, error: &dyn std::error::Error) {
        tracing::warn!("{link} is recorded no longer: {error}");
        self.lock().ended.insert(link.to_string(), error.to_string());
    }

    /// The topics that cannot be recorded from anywhere, by name.
    pub fn failed(&self) -> BTreeMap<String, Reasons> {
        self.lock().failed.clone()
    }

    /// The topics that were recorded in part.
    pub fn ended(&self) -> Reasons {
        self.lock().ended.clone()
    }

    fn look(&self, transport: TransportKind, producer: &Producer<Received>) {
        let topics = match self.transports.topics(transport) {
            Ok(topics) => topics,
            Err(error) => {
                // Once: it will hardly be another one the next time.
                if self.lock().known.insert(format!("{transport}:")) {
                    tracing::warn!("the topics on {transport} cannot be listed: {error}");
                }
                return;
            }
        };
        for topic in topics.into_iter().filter(|topic| self.choice.matches(&topic.link.topic)) {
            if self.lock().known.contains(&topic.link.topic) {
                continue;
            }
            match self.transports.subscriber_of(&topic.link, &topic.type_support()) {
                Ok(subscriber) => {
                    let mut found = self.lock();
                    found.known.insert(topic.link.topic.clone());
                    found.failed.remove(&topic.link.topic);
                    drop(found);
                    producer.bring(Received::Opened(topic, subscriber), 0, Duration::MAX);
                }
                Err(error) => self.fails(&topic.link, &error),
            }
        }
    }

    /// A panic elsewhere cannot leave it half changed: every change is one insertion or removal.
    fn lock(&self) -> MutexGuard<'_, Found> {
        self.found.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
