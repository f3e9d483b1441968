//! Topics that are published, now or later: the chosen ones are subscribed to.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, HashSet},
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
use eddy_transport::{Link, Producer, SeenTopic, TransportError, TransportKind};

/// Interval between searches. Messages published before their topic is found are missed.
const SEARCH_INTERVAL: Duration = Duration::from_millis(200);
/// The same while a topic that was asked for by name is not published yet.
const WAITING_INTERVAL: Duration = Duration::from_millis(50);
/// Longest sleep before the stop flag is checked.
const MAX_SLEEP: Duration = Duration::from_millis(20);

/// Searches for topics to record.
pub struct TopicDiscovery {
    opener: TopicOpener,
    links: Vec<Link>,
    from: Vec<TransportKind>,
    choice: TopicFilter,
    found: Mutex<Found>,
}

#[derive(Default)]
struct Found {
    /// Topics that are recorded, or were, by name.
    recorded: HashMap<String, SeenTopic>,
    /// Topics that cannot be recorded, by name, with the error on each link.
    failed: BTreeMap<String, Reasons>,
    /// Further types of recorded topics.
    other_types: Reasons,
    /// Transports that cannot be searched.
    closed: BTreeMap<TransportKind, String>,
    /// Links that were recorded until they failed.
    ended: Reasons,
}

/// Links that are not recorded, or no longer, with the reason.
pub type Reasons = BTreeMap<String, String>;

impl TopicDiscovery {
    /// Waits for the publishers of `links`, and searches the transports `from` for chosen topics.
    pub fn new(
        opener: TopicOpener,
        links: Vec<Link>,
        from: Vec<TransportKind>,
        choice: TopicFilter,
    ) -> Self {
        Self { opener, links, from, choice, found: Mutex::default() }
    }

    /// Finds the definitions of the types of topics.
    pub(super) fn opener(&self) -> &TopicOpener {
        &self.opener
    }

    /// Opens the transports, so that a recording that cannot begin is known before anything is written.
    ///
    /// # Errors
    /// The first [`TransportError`] when none of the transports works. If some do, the others are noted.
    pub fn open(&self) -> Result<(), TransportError> {
        let (mut first, mut works) = (None, false);
        for transport in self.searched() {
            match self.opener.transports().topics(transport) {
                Ok(_) => works = true,
                Err(error) => {
                    self.note_closed(transport, &error);
                    first.get_or_insert(error);
                }
            }
        }
        first.filter(|_| !works).map_or(Ok(()), Err)
    }

    /// The transports to search.
    fn searched(&self) -> BTreeSet<TransportKind> {
        let from = if self.choice.is_empty() { &[][..] } else { &self.from };
        self.links.iter().map(|link| link.transport).chain(from.iter().copied()).collect()
    }

    /// Subscribes to every wanted topic as soon as it is published, until `stop` is raised. A chosen topic on several
    /// transports is recorded where it is found first. A failed subscription is retried at every search.
    pub(super) fn run(&self, producer: &Producer<Event>, stop: &AtomicBool) {
        // A transport that takes long to answer does not delay the others.
        thread::scope(|scope| {
            for transport in self.searched() {
                scope.spawn(move || self.search_again(transport, producer, stop));
            }
        });
    }

    fn search_again(
        &self,
        transport: TransportKind,
        producer: &Producer<Event>,
        stop: &AtomicBool,
    ) {
        while !stop.load(Ordering::Relaxed) {
            self.search(transport, producer);
            let is_waiting = self.unpublished().iter().any(|link| link.transport == transport);
            let interval = if is_waiting { WAITING_INTERVAL } else { SEARCH_INTERVAL };
            let clock = Clock::start();
            while clock.now() < interval && !stop.load(Ordering::Relaxed) {
                thread::sleep(MAX_SLEEP);
            }
        }
    }

    fn search(&self, transport: TransportKind, producer: &Producer<Event>) {
        let topics = match self.opener.transports().topics(transport) {
            Ok(topics) => topics,
            Err(error) => return self.note_closed(transport, &error),
        };
        self.lock().closed.remove(&transport);
        for topic in topics.into_iter().filter(|topic| self.is_wanted(&topic.link)) {
            if !self.reserve(&topic) {
                continue;
            }
            let link = topic.link.clone();
            match self.opener.open(topic) {
                Ok(opened) => {
                    self.lock().failed.remove(&link.topic);
                    let _ = producer.push_or_wait(Event::Opened(Box::new(opened)), Duration::MAX);
                }
                Err(error) => {
                    self.lock().recorded.remove(&link.topic);
                    self.note_failed(&link, &error);
                }
            }
        }
    }

    fn is_wanted(&self, link: &Link) -> bool {
        if self.links.iter().any(|named| named.topic == link.topic) {
            return self.links.contains(link);
        }
        self.from.contains(&link.transport) && self.choice.matches(&link.topic)
    }

    /// Whether a topic is to be opened now; notes another type of one that is recorded.
    pub(super) fn reserve(&self, topic: &SeenTopic) -> bool {
        let mut found = self.lock();
        let Some(known) = found.recorded.get(&topic.link.topic).cloned() else {
            found.recorded.insert(topic.link.topic.clone(), topic.clone());
            return true;
        };
        if known.link != topic.link || is_same_type(&known, topic) {
            return false;
        }
        let link = format!("{}({})", topic.link, topic.type_name);
        let of = |topic: &SeenTopic| match &topic.hash {
            Some(hash) => format!("{} ({hash})", topic.type_name),
            None => topic.type_name.clone(),
        };
        let reason = format!("found message type {}, recorded is {}", of(topic), of(&known));
        if found.other_types.insert(link, reason.clone()).is_none() {
            drop(found);
            tracing::warn!("{}: {reason}", topic.link);
        }
        false
    }

    fn note_closed(&self, transport: TransportKind, error: &TransportError) {
        // Logged once: the next search will hardly fail differently.
        if self.lock().closed.insert(transport, error.to_string()).is_none() {
            tracing::warn!("cannot list the topics on {transport}: {error}");
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

    /// Notes a link that failed while it was recorded. Returns whether nothing is left to record.
    pub(super) fn note_ended(&self, link: &Link, error: &dyn std::error::Error) -> bool {
        tracing::warn!("{link} is no longer recorded: {error}");
        let mut found = self.lock();
        found.ended.insert(link.to_string(), error.to_string());
        let is_ended = |link: &Link| found.ended.contains_key(&link.to_string());
        self.choice.is_empty() && self.links.iter().all(is_ended)
    }

    /// The links that were asked for by name and were not published so far.
    pub fn unpublished(&self) -> Vec<Link> {
        let found = self.lock();
        let is_missing = |link: &&Link| {
            !found.recorded.contains_key(&link.topic) && !found.failed.contains_key(&link.topic)
        };
        self.links.iter().filter(is_missing).cloned().collect()
    }

    /// What could not be recorded from any link, and why.
    pub fn not_recorded(&self) -> Reasons {
        let unpublished = self.unpublished();
        let found = self.lock();
        let mut reasons: Reasons = found.failed.values().flatten().map(owned).collect();
        reasons.extend(found.other_types.iter().map(owned));
        let unpublished = unpublished.iter().map(|link| {
            let reason = found.closed.get(&link.transport).map_or("not published", String::as_str);
            (link.to_string(), reason.to_owned())
        });
        reasons.extend(unpublished);
        let from: HashSet<_> = self.from.iter().filter(|_| !self.choice.is_empty()).collect();
        let closed = found.closed.iter().filter(|(transport, _)| from.contains(transport));
        reasons.extend(closed.map(|(transport, reason)| (format!("{transport}:"), reason.clone())));
        reasons
    }

    /// The links that were recorded until they failed.
    pub fn ended(&self) -> Reasons {
        self.lock().ended.clone()
    }

    /// A panic in another thread leaves it consistent: every change is one insertion or removal.
    fn lock(&self) -> MutexGuard<'_, Found> {
        self.found.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn owned((link, reason): (&String, &String)) -> (String, String) {
    (link.clone(), reason.clone())
}

/// Whether two publishers have the same type, as far as they announce it.
fn is_same_type(one: &SeenTopic, other: &SeenTopic) -> bool {
    let same_hash = match (&one.hash, &other.hash) {
        (Some(one), Some(other)) => one == other,
        _ => true,
    };
    one.type_name == other.type_name && same_hash
}
