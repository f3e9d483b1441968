//! The node in the ROS graph, and matched endpoints.
//!
//! Each process publishes the endpoints of its node on the topic `ros_discovery_info`
//! (<https://design.ros2.org/articles/Node_to_Participant_mapping.html>). RustDDS reports matched endpoints as events,
//! which are read by a thread.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    io,
    sync::{
        Arc, Mutex, Weak,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use ros2_client::{
    Gid, NodeName, builtin_topics,
    dds::rustdds::{
        self, DomainParticipant, DomainParticipantStatusEvent as Event,
        DomainParticipantStatusListener, GUID, LostReason, QosPolicies, RTPSEntity, StatusEvented,
        Timestamp, TopicKind,
        dds::CreateResult,
        mio1::{Interest, Token, Waker},
        no_key::DataWriterCdr,
        policy::Durability,
    },
    entities_info::{NodeEntitiesInfo, ParticipantEntitiesInfo},
};

use super::{event_loop::EventLoop, middleware};
use crate::{Link, TransportError, TransportOptions, lock};

/// Number of endpoints that are remembered after their end, the latest.
const MAX_ENDED: usize = 1_024;

/// Longest wait for the others to know that the node leaves.
const LEAVING: Duration = Duration::from_millis(500);

pub(super) struct Graph {
    state: Arc<Mutex<State>>,
    /// Number of changes of the writers of other participants.
    changes: Arc<AtomicU64>,
    announcer: Mutex<Announcer>,
    _events: EventLoop,
}

/// Shared by the thread and the endpoints.
#[derive(Default)]
struct State {
    /// Readers matched with each local writer.
    readers: BTreeMap<GUID, BTreeSet<GUID>>,
    /// Writers matched with each local reader.
    writers: BTreeMap<GUID, BTreeSet<GUID>>,
    /// Readers and writers of others that ended. RustDDS may report a match with one of them after its end, since the two
    /// events come from different threads.
    ended: VecDeque<GUID>,
    /// Wakers of subscribers for writers that appear or disappear.
    wakers: Vec<Weak<Waker>>,
    /// Readers of each local writer whose lease ended without a farewell.
    vanished: BTreeMap<GUID, u64>,
    /// The topics of local writers, and of local readers that request certain policies, for messages.
    links: BTreeMap<GUID, Link>,
}

struct Announcer {
    writer: DataWriterCdr<ParticipantEntitiesInfo>,
    participant: Gid,
    name: NodeName,
    readers: BTreeSet<GUID>,
    writers: BTreeSet<GUID>,
}

impl Graph {
    pub(super) fn open(
        link: &Link,
        participant: &DomainParticipant,
        publisher: &rustdds::Publisher,
        options: &TransportOptions,
    ) -> Result<Self, TransportError> {
        let announcer = Announcer::open(link, participant, publisher, options)?;
        let state = Arc::<Mutex<State>>::default();
        let changes = Arc::<AtomicU64>::default();
        let events = watch(participant.status_listener(), Arc::clone(&state), Arc::clone(&changes))
            .map_err(|error| middleware(link, "watch the graph", &error))?;
        let graph = Self { state, changes, announcer: Mutex::new(announcer), _events: events };
        graph.announce(|_| {});
        Ok(graph)
    }

    /// Creates a local endpoint. RustDDS may report a match before `create` returns: its event waits until the link of the
    /// endpoint is known.
    fn create<E: RTPSEntity>(
        &self,
        link: Option<&Link>,
        create: impl FnOnce() -> CreateResult<E>,
    ) -> CreateResult<E> {
        let mut state = lock(&self.state);
        let endpoint = create()?;
        if let Some(link) = link {
            state.links.insert(endpoint.guid(), link.clone());
        }
        Ok(endpoint)
    }

    /// Creates and announces a local writer.
    pub(super) fn add_writer<W: RTPSEntity>(
        &self,
        link: &Link,
        create: impl FnOnce() -> CreateResult<W>,
    ) -> CreateResult<W> {
        let writer = self.create(Some(link), create)?;
        self.announce(|announcer| {
            announcer.writers.insert(writer.guid());
        });
        Ok(writer)
    }

    pub(super) fn remove_writer(&self, writer: GUID) {
        self.announce(|announcer| {
            announcer.writers.remove(&writer);
        });
        let mut state = lock(&self.state);
        state.readers.remove(&writer);
        state.vanished.remove(&writer);
        state.links.remove(&writer);
    }

    /// Creates and announces a local reader. `link`: what to log writers under whose messages it does not receive; others that
    /// it cannot read have a reader of their own.
    pub(super) fn add_reader<R: RTPSEntity>(
        &self,
        link: Option<&Link>,
        create: impl FnOnce() -> CreateResult<R>,
    ) -> CreateResult<R> {
        let reader = self.create(link, create)?;
        self.announce(|announcer| {
            announcer.readers.insert(reader.guid());
        });
        Ok(reader)
    }

    pub(super) fn remove_reader(&self, reader: GUID) {
        self.announce(|announcer| {
            announcer.readers.remove(&reader);
        });
        let mut state = lock(&self.state);
        state.writers.remove(&reader);
        state.links.remove(&reader);
    }

    /// Wakes `waker`, as long as it lives, whenever a writer appears or disappears.
    pub(super) fn watch(&self, waker: &Arc<Waker>) {
        lock(&self.state).wakers.push(Arc::downgrade(waker));
    }

    /// Number of times that writers have appeared or disappeared.
    pub(super) fn changes(&self) -> u64 {
        self.changes.load(Ordering::Acquire)
    }

    /// Whether a local reader is matched with a writer.
    pub(super) fn has_writer(&self, reader: GUID) -> bool {
        lock(&self.state).writers.get(&reader).is_some_and(|writers| !writers.is_empty())
    }

    /// Whether a local writer is matched with a reader for which this holds.
    pub(super) fn has_reader(&self, writer: GUID, is_wanted: impl Fn(&GUID) -> bool) -> bool {
        lock(&self.state).readers.get(&writer).is_some_and(|readers| readers.iter().any(is_wanted))
    }

    /// Number of readers matched with a local writer.
    pub(super) fn matched(&self, writer: GUID) -> usize {
        lock(&self.state).readers.get(&writer).map_or(0, BTreeSet::len)
    }

    /// Number of readers of a local writer that vanished without a farewell.
    pub(super) fn vanished(&self, writer: GUID) -> u64 {
        lock(&self.state).vanished.get(&writer).copied().unwrap_or_default()
    }

    /// Removes the node from the graph, and waits until the others know. A participant that is still listed would come back for
    /// a process that handles an earlier announcement after the end of the participant.
    pub(super) fn leave(&self) {
        lock(&self.announcer).leave();
    }

    fn announce(&self, change: impl FnOnce(&mut Announcer)) {
        let mut announcer = lock(&self.announcer);
        change(&mut announcer);
        announcer.announce();
    }
}

impl Announcer {
    fn open(
        link: &Link,
        participant: &DomainParticipant,
        publisher: &rustdds::Publisher,
        options: &TransportOptions,
    ) -> Result<Self, TransportError> {
        use builtin_topics::ros_discovery::{QOS_PUB, TOPIC_NAME, TYPE_NAME};
        let name = NodeName::new(&options.namespace, &options.node_name)
            .map_err(|error| middleware(link, "name the node", &error))?;
        let failed = |error| middleware(link, "declare the node", &error);
        let topic = participant
            .create_topic(TOPIC_NAME.to_owned(), TYPE_NAME.to_owned(), &QOS_PUB, TopicKind::NoKey)
            .map_err(failed)?;
        let writer = publisher.create_datawriter_no_key_cdr(&topic, None).map_err(failed)?;
        let participant = Gid::from(participant.guid());
        let (readers, writers) = (BTreeSet::new(), BTreeSet::new());
        Ok(Self { writer, participant, name, readers, writers })
    }

    fn announce(&self) {
        let mut node = NodeEntitiesInfo::new(self.name.clone());
        self.readers.iter().for_each(|&reader| node.add_reader(reader.into()));
        self.writers.iter().for_each(|&writer| node.add_writer(writer.into()));
        self.write(vec![node]);
    }

    fn leave(&self) {
        self.write(Vec::new());
        match self.writer.wait_for_acknowledgments(LEAVING) {
            Ok(true) => {}
            Ok(false) => tracing::debug!("ros_discovery_info: not everybody knows of the end"),
            Err(error) => tracing::debug!("ros_discovery_info: {error}"),
        }
    }

    fn write(&self, nodes: Vec<NodeEntitiesInfo>) {
        let info = ParticipantEntitiesInfo::new(self.participant, nodes);
        if let Err(error) = self.writer.write(info, Some(Timestamp::now())) {
            tracing::warn!("ros_discovery_info: {error}");
        }
    }
}

/// Starts the thread that reads the events of RustDDS.
fn watch(
    mut listener: DomainParticipantStatusListener,
    state: Arc<Mutex<State>>,
    changes: Arc<AtomicU64>,
) -> io::Result<EventLoop> {
    let wait = EventLoop::poll()?;
    wait.0.registry().register(&mut listener, Token(1), Interest::READABLE)?;
    EventLoop::start("dds graph", "DDS graph", wait, move |_| {
        let mut changed = false;
        while let Some(event) = listener.try_recv_status() {
            changed |= matches!(
                event,
                Event::WriterDetected { .. }
                    | Event::WriterLost { .. }
                    | Event::ParticipantLost { .. }
            );
            lock(&state).handle(event);
        }
        if changed {
            changes.fetch_add(1, Ordering::Release);
            lock(&state).wake();
        }
    })
}

/// The policy of a publisher that does not meet a subscriber's request.
fn incompatible(requested: &QosPolicies, offered: &QosPolicies) -> &'static str {
    let is_transient = |qos: &QosPolicies| {
        qos.durability().is_some_and(|durability| durability > Durability::Volatile)
    };
    if requested.is_reliable() && !offered.is_reliable() {
        "RELIABILITY"
    } else if is_transient(requested) && !is_transient(offered) {
        "DURABILITY"
    } else {
        "another one"
    }
}

/// Says in the words of ROS, which people search for, that a subscriber does not accept what a local publisher offers.
fn warn_of_reader(link: &Link, policy: &str) {
    let remedy = match policy {
        "RELIABILITY" => " (publish with --reliability block, or subscribe with best effort)",
        _ => "",
    };
    tracing::warn!(
        "{link}: new subscription discovered, requesting incompatible QoS; no messages will be sent to it; incompatible policy: {policy}{remedy}"
    );
}

/// Says in the words of ROS that a publisher does not offer what a local subscriber requests.
fn warn_of_writer(link: &Link, policy: &str) {
    tracing::warn!(
        "{link}: new publisher discovered, offering incompatible QoS; no messages will be received from it; incompatible policy: {policy}"
    );
}

impl State {
    /// Wakes the subscribers.
    fn wake(&mut self) {
        self.wakers.retain(|waker| match waker.upgrade() {
            Some(waker) => {
                if let Err(error) = waker.wake() {
                    tracing::warn!("cannot wake a DDS subscriber: {error}");
                }
                true
            }
            None => false,
        });
    }

    /// Remembers an endpoint that its participant has removed; one whose lease ended may come back.
    fn end(&mut self, endpoint: GUID, reason: &LostReason) {
        if matches!(reason, LostReason::Disposed) {
            if self.ended.len() == MAX_ENDED {
                self.ended.pop_front();
            }
            self.ended.push_back(endpoint);
        }
    }

    /// Removes readers of local writers.
    fn forget(&mut self, is_lost: impl Fn(&GUID) -> bool, reason: &LostReason) {
        for (writer, readers) in &mut self.readers {
            let before = readers.len();
            readers.retain(|reader| !is_lost(reader));
            if matches!(reason, LostReason::Timeout { .. }) {
                *self.vanished.entry(*writer).or_default() += (before - readers.len()) as u64;
            }
        }
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::RemoteReaderMatched { local_writer, remote_reader }
                if !self.ended.contains(&remote_reader) =>
            {
                self.readers.entry(local_writer).or_default().insert(remote_reader);
            }
            Event::ReaderLost { guid, reason } => {
                self.end(guid, &reason);
                self.forget(|reader| *reader == guid, &reason);
            }
            Event::RemoteWriterMatched { local_reader, remote_writer }
                if !self.ended.contains(&remote_writer) =>
            {
                self.writers.entry(local_reader).or_default().insert(remote_writer);
            }
            Event::WriterLost { guid, reason } => {
                self.end(guid, &reason);
                self.writers.values_mut().for_each(|writers| {
                    writers.remove(&guid);
                });
            }
            Event::ParticipantLost { id, reason } => {
                self.forget(|reader| reader.prefix == id, &reason);
                for writers in self.writers.values_mut() {
                    writers.retain(|writer| writer.prefix != id);
                }
            }
            Event::RemoteReaderQosIncompatible {
                local_writer, requested_qos, offered_qos, ..
            } => {
                if let Some(link) = self.links.get(&local_writer) {
                    warn_of_reader(link, incompatible(&requested_qos, &offered_qos));
                }
            }
            Event::RemoteWriterQosIncompatible {
                local_reader, requested_qos, offered_qos, ..
            } => {
                if let Some(link) = self.links.get(&local_reader) {
                    warn_of_writer(link, incompatible(&requested_qos, &offered_qos));
                }
            }
            Event::InconsistentTopic { previous_topic_data, discovered_topic_data, .. } => {
                tracing::warn!(
                    "topic {}: found message type {}, expected {}",
                    discovered_topic_data.name,
                    discovered_topic_data.type_name,
                    previous_topic_data.type_name
                );
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_that_ended_are_not_matched_afterwards() {
        let [local, remote] = [(); 2].map(|()| GUID::new_participant_guid());
        let mut state = State::default();
        let lost = |reason| Event::ReaderLost { guid: remote, reason };
        let matched = || Event::RemoteReaderMatched { local_writer: local, remote_reader: remote };
        let readers = |state: &State| state.readers.get(&local).map_or(0, BTreeSet::len);
        state.handle(matched());
        assert_eq!(readers(&state), 1);
        // A process that was not heard of for long comes back with the same endpoints.
        state.handle(lost(LostReason::Timeout {
            lease: rustdds::Duration::ZERO,
            elapsed: rustdds::Duration::ZERO,
        }));
        assert_eq!(readers(&state), 0);
        state.handle(matched());
        assert_eq!(readers(&state), 1);
        state.handle(lost(LostReason::Disposed));
        state.handle(matched());
        assert_eq!(readers(&state), 0);

        state.handle(Event::WriterLost { guid: local, reason: LostReason::Disposed });
        state.handle(Event::RemoteWriterMatched { local_reader: remote, remote_writer: local });
        assert_eq!(state.writers.get(&remote).map_or(0, BTreeSet::len), 0);
    }
}
