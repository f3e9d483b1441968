//! The node in the ROS graph, and matched endpoints.
//!
//! Each process publishes the endpoints of its node on the topic `ros_discovery_info`
//! (<https://design.ros2.org/articles/Node_to_Participant_mapping.html>). RustDDS reports matched endpoints as events,
//! which are read by a thread.

use std::{
    collections::{BTreeMap, BTreeSet},
    io,
    sync::{Arc, Mutex},
};

use ros2_client::{
    Gid, NodeName, builtin_topics,
    dds::rustdds::{
        self, DomainParticipant, DomainParticipantStatusEvent as Event,
        DomainParticipantStatusListener, GUID, RTPSEntity, StatusEvented, TopicKind,
        mio1::{Interest, Token, Waker},
        no_key::DataWriterCdr,
    },
    entities_info::{NodeEntitiesInfo, ParticipantEntitiesInfo},
};

use super::{event_loop::EventLoop, middleware};
use crate::{Link, TransportError, TransportOptions, lock};

/// Largest number of incompatible writers per reader. They are kept when they disappear, since their last messages may not
/// have been received yet.
const MAX_MISMATCHED: usize = 1_024;

pub(super) struct Graph {
    state: Arc<Mutex<State>>,
    announcer: Mutex<Announcer>,
    _events: EventLoop,
}

/// Shared by the thread and the endpoints.
#[derive(Default)]
struct State {
    /// Readers matched with each local writer.
    readers: BTreeMap<GUID, BTreeSet<GUID>>,
    /// Writers with a QoS that is incompatible with each local reader.
    mismatched: BTreeMap<GUID, BTreeSet<GUID>>,
    /// Wakers of local readers for incompatible writers.
    wakers: BTreeMap<GUID, Arc<Waker>>,
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
        let events = watch(participant.status_listener(), Arc::clone(&state))
            .map_err(|error| middleware(link, "watch the graph", &error))?;
        let graph = Self { state, announcer: Mutex::new(announcer), _events: events };
        graph.announce(|_| {});
        Ok(graph)
    }

    /// Announces a local writer.
    pub(super) fn add_writer(&self, writer: GUID) {
        self.announce(|announcer| {
            announcer.writers.insert(writer);
        });
    }

    pub(super) fn remove_writer(&self, writer: GUID) {
        self.announce(|announcer| {
            announcer.writers.remove(&writer);
        });
        lock(&self.state).readers.remove(&writer);
    }

    /// Announces a local reader.
    pub(super) fn add_reader(&self, reader: GUID) {
        self.announce(|announcer| {
            announcer.readers.insert(reader);
        });
    }

    pub(super) fn remove_reader(&self, reader: GUID) {
        self.announce(|announcer| {
            announcer.readers.remove(&reader);
        });
        let mut state = lock(&self.state);
        state.mismatched.remove(&reader);
        state.wakers.remove(&reader);
    }

    /// Wakes `waker` whenever an incompatible writer for `reader` appears.
    pub(super) fn watch(&self, reader: GUID, waker: &Arc<Waker>) {
        lock(&self.state).wakers.insert(reader, Arc::clone(waker));
    }

    /// Writers with a QoS that is incompatible with `reader`.
    pub(super) fn mismatched(&self, reader: GUID) -> BTreeSet<GUID> {
        lock(&self.state).mismatched.get(&reader).cloned().unwrap_or_default()
    }

    /// Number of readers matched with a local writer.
    pub(super) fn matched(&self, writer: GUID) -> usize {
        lock(&self.state).readers.get(&writer).map_or(0, BTreeSet::len)
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
        let info = ParticipantEntitiesInfo::new(self.participant, vec![node]);
        if let Err(error) = self.writer.write(info, None) {
            tracing::warn!("ros_discovery_info: {error}");
        }
    }
}

/// Starts the thread that reads the events of RustDDS.
fn watch(
    mut listener: DomainParticipantStatusListener,
    state: Arc<Mutex<State>>,
) -> io::Result<EventLoop> {
    let wait = EventLoop::poll()?;
    wait.0.registry().register(&mut listener, Token(1), Interest::READABLE)?;
    EventLoop::start("dds graph", "DDS graph", wait, move |_| {
        while let Some(event) = listener.try_recv_status() {
            lock(&state).handle(event);
        }
    })
}

impl State {
    fn handle(&mut self, event: Event) {
        match event {
            Event::RemoteReaderMatched { local_writer, remote_reader } => {
                self.readers.entry(local_writer).or_default().insert(remote_reader);
            }
            Event::ReaderLost { guid, .. } => {
                self.readers.values_mut().for_each(|readers| {
                    readers.remove(&guid);
                });
            }
            Event::ParticipantLost { id, .. } => {
                self.readers
                    .values_mut()
                    .for_each(|readers| readers.retain(|reader| reader.prefix != id));
            }
            Event::RemoteWriterQosIncompatible { local_reader, remote_writer, .. } => {
                let writers = self.mismatched.entry(local_reader).or_default();
                writers.insert(remote_writer);
                if writers.len() > MAX_MISMATCHED {
                    writers.pop_first();
                }
                if let Some(Err(error)) = self.wakers.get(&local_reader).map(|w| w.wake()) {
                    tracing::warn!("cannot wake a DDS subscriber: {error}");
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
