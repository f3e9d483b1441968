//! Topics that are published, now or later: the chosen ones are subscribed to.

use std::{
    collections::{BTreeMap, HashSet},
    sync::{
        Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use super::{TopicOpener, intake::Event};
use eddy_bag::TopicFilter;
use eddy_frames::clock::Clock;
use eddy_transport::{Link, Producer, SeenTopic, TransportKind};

/// Interval between searches. Messages published before their topic is found are missed.
const SEARCH_INTERVAL: Duration = Duration::from_millis(200);
/// Longest sleep before the stop flag is checked.
const MAX_SLEEP: Duration = Duration::from_millis(20);

/// Searches for topics to record.
pub struct TopicDiscovery {
    opener: TopicOpener,
    from: Vec<TransportKind>,
    choice: TopicFilter,
    found: Mutex<Found>,
}

#[derive(Default)]
struct Found {
    /// Names of topics that are recorded, or were.
    known: HashSet<String>,
    /// Topics that cannot be recorded, by name, with the error on each link.
    failed: BTreeMap<String, Reasons>,
    /// Links that were recorded until they failed.
    ended: Reasons,
}

/// Links that are not recorded, or no longer, with the error.
pub type Reasons = BTreeMap<String, String>;

impl TopicDiscovery {
    /// Searches the transports `from` for chosen topics, except those named in `known`, which are recorded already.
    pub fn new(
        opener: TopicOpener,
        from: Vec<TransportKind>,
        choice: TopicFilter,
        known: HashSet<String>,
    ) -> Self {
        let found = Found { known, ..Found::default() };
        Self { opener, from, choice, found: Mutex::new(found) }
    }

    /// Whether no topic can be chosen.
    pub(super) fn is_empty(&self) -> bool {
        self.choice.is_empty()
    }

    /// Subscribes to every chosen topic that appears, until `stop` is raised. A topic on several transports, or with
    /// several types, is recorded where it is found first. A failed subscription is retried at every search.
    pub(super) fn run(&self, producer: &Producer<Event>, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            for &transport in &self.from {
                self.search(transport, producer);
            }
            let clock = Clock::start();
            while clock.now() < SEARCH_INTERVAL && !stop.load(Ordering::Relaxed) {
                thread::sleep(MAX_SLEEP);
            }
        }
    }

    /// Notes a link that cannot be recorded.
    pub(super) fn note_failed(&self, link: &Link, error: &dyn std::error::Error) {
        let mut found = self.lock();
        let reasons = found.failed.entry(link.topic.clone()).or_default();
        let known = reasons.insert(link.to_string(), error.to_string());
        drop(found);
        if known.is_none() {
            tracing::warn!("{link} is not recorded: {error}");
        }
    }

    /// Notes a link that failed while it was recorded.
    pub(super) fn note_ended(&self, link: &Link, error: &dyn std::error::Error) {
        tracing::warn!("{link} is no longer recorded: {error}");
        self.lock().ended.insert(link.to_string(), error.to_string());
    }

    /// The topics that could not be recorded from any link, by name.
    pub fn failed(&self) -> BTreeMap<String, Reasons> {
        self.lock().failed.clone()
    }

    /// The links that were recorded until they failed.
    pub fn ended(&self) -> Reasons {
        self.lock().ended.clone()
    }

    fn search(&self, transport: TransportKind, producer: &Producer<Event>) {
        let topics = match self.opener.transports().topics(transport) {
            Ok(topics) => topics,
            Err(error) => {
                // Logged once: the next search will hardly fail differently.
                if self.lock().known.insert(format!("{transport}:")) {
                    tracing::warn!("cannot list the topics on {transport}: {error}");
                }
                return;
            }
        };
        let mut names = HashSet::new();
        let new = |topic: &SeenTopic| {
            let name = &topic.link.topic;
            self.choice.matches(name)
                && !self.lock().known.contains(name)
                && names.insert(name.clone())
        };
        let (known, unknown): (Vec<_>, Vec<_>) = topics
            .into_iter()
            .filter(new)
            .partition(|topic| !topic.type_support().schema.is_empty());
        known.into_iter().for_each(|topic| self.open(topic, producer));
        // Publishers may take a while to tell the definitions of their types.
        thread::scope(|scope| {
            for topic in unknown {
                scope.spawn(|| self.open(topic, producer));
            }
        });
    }

    fn open(&self, topic: SeenTopic, producer: &Producer<Event>) {
        let link = topic.link.clone();
        match self.opener.open(topic) {
            Ok(opened) => {
                let mut found = self.lock();
                found.known.insert(link.topic.clone());
                found.failed.remove(&link.topic);
                drop(found);
                let _ = producer.push_or_wait(Event::Opened(Box::new(opened)), Duration::MAX);
            }
            Err(error) => self.note_failed(&link, &error),
        }
    }

    /// A panic in another thread leaves it consistent: every change is one insertion or removal.
    fn lock(&self) -> MutexGuard<'_, Found> {
        self.found.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
