//! Subscribes to one topic.
//!
//! A reader receives nothing from writers that offer less than it requests, and each side reports such a pair as an
//! error. A reader that requests less gets neither repairs nor the messages that writers keep for late-joining readers.
//! So there is a reader for each kind of writers ([`Kind`]): it is opened when their first writer appears, receives
//! their messages and no others, and is closed when only writers of other kinds are left. Before the first writer
//! appears, a reliable and volatile reader is open. It stays while all known writers keep messages, since a volatile writer
//! that is not discovered yet may have matched it, and what that writer sends before it matches another reader would be
//! lost.

use std::{
    collections::BTreeMap,
    io,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use ros2_client::dds::rustdds::{
    GUID, QosPolicies, Topic,
    mio1::{Interest, Registry, Token},
    no_key::SimpleDataReader,
};

use super::{DdsNode, cdr::PassThrough, event_loop::EventLoop, middleware, qos};
use crate::{Link, Payload, Subscriber, TransportError, queue::Queue};
use eddy_messages::{
    Clock, Message as _, QosProfile, TypeSupport,
    qos::{DurabilityPolicy, ReliabilityPolicy},
};

/// Capacity of the queue (messages).
const DEPTH: usize = 1_024;
/// Capacity of the queue (bytes).
const MAX_BYTES: usize = 64 << 20;
/// Largest number of writers whose gaps are counted.
const MAX_WRITERS: usize = 64;
/// Largest number of writers whose kind is remembered.
const MAX_KINDS: usize = 1_024;

type Reader = SimpleDataReader<Vec<u8>, PassThrough>;

pub(crate) struct DdsSubscriber {
    shared: Arc<Shared>,
    _events: EventLoop,
}

struct Shared {
    link: Link,
    queue: Queue<Vec<u8>>,
    /// Messages that did not arrive.
    lost: AtomicU64,
}

impl DdsSubscriber {
    /// Requests `requested` from all writers; from each what it offers if `None`.
    pub(super) fn open(
        node: &Arc<DdsNode>,
        link: &Link,
        support: &TypeSupport,
        requested: Option<QosProfile>,
    ) -> Result<Self, TransportError> {
        let failed = |error: io::Error| middleware(link, "create the subscriber", &error);
        let ours = Arc::new(Shared::new(link.clone()));
        let wait = EventLoop::poll().map_err(failed)?;
        // As subscribers of ROS: the next time on the clock replaces a lost one.
        let only = requested
            .map(|qos| Kind::of(&qos))
            .or_else(|| (support.name == Clock::TYPE).then_some(Kind::BestEffort));
        let mut receiver = Receiver {
            topic: node.topic(link, &support.name)?,
            type_name: support.name.clone(),
            only,
            readers: [const { None }; Kind::ALL.len()],
            kinds: BTreeMap::new(),
            changes: None,
            gaps: Gaps::default(),
            shared: Arc::clone(&ours),
            node: Arc::clone(node),
        };
        node.graph.watch(&wait.1);
        receiver.adapt(wait.0.registry())?;
        let events = EventLoop::start("dds subscriber", link.clone(), wait, move |registry| {
            receiver.receive(registry);
        });
        Ok(Self { shared: ours, _events: events.map_err(failed)? })
    }
}

impl Subscriber for DdsSubscriber {
    fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError> {
        Ok(self.shared.queue.pop(timeout).map(Payload::Cdr))
    }

    fn lost(&self) -> u64 {
        self.shared.lost.load(Ordering::Relaxed) + self.shared.queue.dropped()
    }
}

impl Shared {
    fn new(link: Link) -> Self {
        let queue = Queue::with_cost(DEPTH, MAX_BYTES, Vec::len);
        Self { link, queue, lost: AtomicU64::new(0) }
    }
}

/// Kinds of writers, by what they offer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// Reliable and transient local.
    Latched,
    /// Reliable and volatile.
    Reliable,
    /// Best effort. Messages kept by such writers are not repaired, hence not requested.
    BestEffort,
}

impl Kind {
    const ALL: [Self; 3] = [Self::Latched, Self::Reliable, Self::BestEffort];

    fn of(qos: &QosProfile) -> Self {
        match (qos.reliability, qos.durability) {
            (ReliabilityPolicy::Reliable, DurabilityPolicy::TransientLocal) => Self::Latched,
            (ReliabilityPolicy::Reliable, DurabilityPolicy::Volatile) => Self::Reliable,
            (ReliabilityPolicy::BestEffort, _) => Self::BestEffort,
        }
    }

    /// What its reader requests.
    fn qos(self) -> QosPolicies {
        match self {
            Self::Latched => qos::latched_reader(),
            Self::Reliable => qos::reliable_reader(),
            Self::BestEffort => qos::best_effort_reader(),
        }
    }

    /// Whether its reader is to be closed while there are writers of the kinds `needed`.
    fn is_superfluous(self, needed: &[Self]) -> bool {
        let may_be_matched = self == Self::Reliable && needed.iter().all(|&it| it == Self::Latched);
        !needed.is_empty() && !needed.contains(&self) && !may_be_matched
    }

    /// Of its reader's events; the waker has 0.
    fn token(self) -> Token {
        Token(1 + self as usize)
    }
}

/// Receives messages from RustDDS on a thread of its own.
struct Receiver {
    topic: Topic,
    type_name: String,
    /// The kind of the only reader, if not that of each writer.
    only: Option<Kind>,
    /// Indexed by [`Kind`].
    readers: [Option<Reader>; Kind::ALL.len()],
    /// Whose reader receives the messages of each writer; `None` for messages of other types. Writers that disappear
    /// are kept, since their last messages may not have been received yet.
    kinds: BTreeMap<GUID, Option<Kind>>,
    /// [`Graph::changes`](super::graph::Graph::changes) when the readers were chosen.
    changes: Option<u64>,
    gaps: Gaps,
    shared: Arc<Shared>,
    node: Arc<DdsNode>,
}

impl Receiver {
    /// Receives all available messages: from each reader those of its writers, since all readers see the whole topic.
    fn receive(&mut self, registry: &Registry) {
        if let Err(error) = self.adapt(registry) {
            tracing::warn!("{error}");
        }
        for kind in Kind::ALL {
            self.drain(kind);
        }
    }

    /// Opens and closes readers, if writers have appeared or disappeared since the last call.
    fn adapt(&mut self, registry: &Registry) -> Result<(), TransportError> {
        let changes = self.node.graph.changes();
        if self.changes.replace(changes) == Some(changes) {
            return Ok(());
        }
        let mut needed = Vec::new();
        for writer in self.node.writers().filter(|writer| writer.topic == self.shared.link.topic) {
            let kind = (writer.type_name == self.type_name)
                .then(|| self.only.unwrap_or_else(|| Kind::of(&writer.offered)));
            needed.extend(kind);
            self.kinds.insert(writer.guid, kind);
        }
        while self.kinds.len() > MAX_KINDS {
            self.kinds.pop_first();
        }
        if needed.is_empty() && self.readers.iter().all(Option::is_none) {
            needed.push(self.only.unwrap_or(Kind::Reliable));
        }
        for &kind in &needed {
            if self.readers[kind as usize].is_none() {
                let is_only = self.only.is_some();
                let (node, link) = (&self.node, &self.shared.link);
                let reader = open(node, link, &self.topic, kind, is_only, registry)?;
                self.readers[kind as usize] = Some(reader);
            }
        }
        for kind in Kind::ALL.into_iter().filter(|kind| kind.is_superfluous(&needed)) {
            self.drain(kind);
            self.close(kind, registry);
        }
        Ok(())
    }

    fn close(&mut self, kind: Kind, registry: &Registry) {
        if let Some(mut reader) = self.readers[kind as usize].take() {
            if let Err(error) = registry.deregister(&mut reader) {
                tracing::debug!("{}: {error}", self.shared.link);
            }
            self.node.graph.remove_reader(reader.guid());
        }
    }

    /// Receives the messages of the writers of a kind.
    fn drain(&mut self, kind: Kind) {
        let Self { readers, kinds, type_name, only, gaps, shared, node, .. } = self;
        let Some(reader) = &readers[kind as usize] else { return };
        reader.drain_read_notifications();
        loop {
            match reader.try_take_one() {
                Ok(Some(sample)) => {
                    let of_writer = kinds.entry(sample.writer_guid).or_insert_with(|| {
                        // The message was faster than the event.
                        match node.writers().find(|writer| writer.guid == sample.writer_guid) {
                            Some(writer) if writer.type_name != *type_name => None,
                            Some(writer) => only.or_else(|| Some(Kind::of(&writer.offered))),
                            None => Some(kind),
                        }
                    });
                    if *of_writer != Some(kind) {
                        continue;
                    }
                    let number = i64::from(sample.sequence_number);
                    let lost = gaps.count(sample.writer_guid, number);
                    shared.lost.fetch_add(lost, Ordering::Relaxed);
                    shared.queue.push_or_drop_oldest(sample.into_value());
                }
                Ok(None) => break,
                Err(error) => {
                    tracing::debug!("{}: {error}", shared.link);
                    shared.lost.fetch_add(1, Ordering::Relaxed);
                }
            }
        }
    }
}

fn open(
    node: &DdsNode,
    link: &Link,
    topic: &Topic,
    kind: Kind,
    is_only: bool,
    registry: &Registry,
) -> Result<Reader, TransportError> {
    let mut reader: Reader = node
        .graph
        .add_reader(is_only.then_some(link), || {
            node.subscriber.create_simple_datareader_no_key(topic, Some(kind.qos()))
        })
        .map_err(|error| middleware(link, "create the subscriber", &error))?;
    if let Err(error) = registry.register(&mut reader, kind.token(), Interest::READABLE) {
        node.graph.remove_reader(reader.guid());
        return Err(middleware(link, "create the subscriber", &error));
    }
    Ok(reader)
}

impl Drop for Receiver {
    fn drop(&mut self) {
        for reader in self.readers.iter().flatten() {
            self.node.graph.remove_reader(reader.guid());
        }
    }
}

/// The last message of each writer.
#[derive(Default)]
struct Gaps(BTreeMap<GUID, i64>);

impl Gaps {
    /// Number of messages between the last one and this one that did not arrive.
    fn count(&mut self, writer: GUID, number: i64) -> u64 {
        if self.0.len() >= MAX_WRITERS && !self.0.contains_key(&writer) {
            self.0.clear();
        }
        match self.0.insert(writer, number) {
            Some(last) => u64::try_from(number.saturating_sub(last).saturating_sub(1)).unwrap_or(0),
            None => 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shared() -> Shared {
        Shared::new("dds:/test".parse().unwrap())
    }

    #[test]
    fn the_oldest_of_too_many_messages_is_dropped_and_counted() {
        let shared = shared();
        for number in 0..DEPTH + 3 {
            shared.queue.push_or_drop_oldest(number.to_le_bytes().to_vec());
        }
        assert_eq!(shared.queue.pop(Duration::ZERO), Some(3usize.to_le_bytes().to_vec()));
        assert_eq!(shared.queue.dropped(), 3);
        assert_eq!(shared.queue.cost(), (DEPTH - 1) * size_of::<usize>());
    }

    #[test]
    fn too_many_bytes_count_as_too_many_messages() {
        let shared = shared();
        for number in 0..6 {
            shared.queue.push_or_drop_oldest(vec![number; MAX_BYTES / 4]);
        }
        assert_eq!(shared.queue.pop(Duration::ZERO).unwrap()[0], 2);
        assert_eq!(shared.queue.dropped(), 2);
    }

    #[test]
    fn writers_are_read_as_they_offer() {
        let (best_effort, latched) =
            (ReliabilityPolicy::BestEffort, DurabilityPolicy::TransientLocal);
        let default = QosProfile::default();
        let cases = [
            (default, Kind::Reliable),
            (QosProfile { durability: latched, ..default }, Kind::Latched),
            (QosProfile { reliability: best_effort, ..default }, Kind::BestEffort),
            (
                QosProfile { reliability: best_effort, durability: latched, ..default },
                Kind::BestEffort,
            ),
        ];
        for (offered, kind) in cases {
            assert_eq!(Kind::of(&offered), kind, "{offered:?}");
        }
    }

    #[test]
    fn the_first_reader_stays_while_all_known_writers_keep_messages() {
        use Kind::{BestEffort, Latched, Reliable};
        let cases: [(&[Kind], &[Kind]); 6] = [
            (&[], &[]),
            (&[Latched], &[BestEffort]),
            (&[Reliable], &[Latched, BestEffort]),
            (&[BestEffort], &[Latched, Reliable]),
            (&[Latched, BestEffort], &[Reliable]),
            (&[Latched, Reliable, BestEffort], &[]),
        ];
        for (needed, closed) in cases {
            let found = Kind::ALL.into_iter().filter(|kind| kind.is_superfluous(needed));
            assert_eq!(found.collect::<Vec<_>>(), closed, "{needed:?}");
        }
    }

    #[test]
    fn gaps_are_counted_for_each_writer_from_its_first_message() {
        let [one, two] = [GUID::new_participant_guid(), GUID::new_participant_guid()];
        let mut gaps = Gaps::default();
        let counts = [(one, 5), (one, 6), (two, 1), (one, 9), (two, 2), (one, 9), (one, 1)]
            .map(|(writer, number)| gaps.count(writer, number));
        assert_eq!(counts, [0, 0, 0, 2, 0, 0, 0]);
    }
}
