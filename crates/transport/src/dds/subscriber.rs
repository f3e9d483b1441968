//! Subscribes to one topic.
//!
//! A reliable reader does not match best-effort writers, and a best-effort reader gets no repairs, so the choice
//! depends on the writers. The first reader is reliable. When writers appear that do not match it, a second,
//! best-effort reader receives their messages, and no others.

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
    GUID, Topic,
    mio1::{Interest, Registry, Token},
    no_key::SimpleDataReader,
};

use super::{DdsNode, cdr::PassThrough, event_loop::EventLoop, middleware, qos};
use crate::{Link, Payload, Subscriber, TransportError, queue::Queue};
use eddy_messages::TypeSupport;

/// Capacity of the queue (messages).
const DEPTH: usize = 1_024;
/// Capacity of the queue (bytes).
const MAX_BYTES: usize = 64 << 20;
/// Largest number of writers whose gaps are counted.
const MAX_WRITERS: usize = 64;

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
    pub(super) fn open(
        node: &Arc<DdsNode>,
        link: &Link,
        support: &TypeSupport,
    ) -> Result<Self, TransportError> {
        let failed = |error: io::Error| middleware(link, "create the subscriber", &error);
        let ours = Arc::new(Shared::new(link.clone()));
        let wait = EventLoop::poll().map_err(failed)?;
        let topic = node.topic(link, &support.name)?;
        let (shared, node) = (Arc::clone(&ours), Arc::clone(node));
        let reliable = open(&node, link, &topic, RELIABLE, wait.0.registry())?;
        node.graph.watch(reliable.guid(), &wait.1);
        let gaps = Gaps::default();
        let mut receiver = Receiver { topic, reliable, best_effort: None, gaps, shared, node };
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

    fn refused(&self) -> u64 {
        self.shared.lost.load(Ordering::Relaxed) + self.shared.queue.dropped()
    }
}

impl Shared {
    fn new(link: Link) -> Self {
        let queue = Queue::with_cost(DEPTH, MAX_BYTES, Vec::len);
        Self { link, queue, lost: AtomicU64::new(0) }
    }
}

const RELIABLE: Token = Token(1);
const BEST_EFFORT: Token = Token(2);

/// Receives messages from RustDDS on a thread of its own.
struct Receiver {
    topic: Topic,
    reliable: Reader,
    best_effort: Option<Reader>,
    gaps: Gaps,
    shared: Arc<Shared>,
    node: Arc<DdsNode>,
}

fn open(
    node: &DdsNode,
    link: &Link,
    topic: &Topic,
    which: Token,
    registry: &Registry,
) -> Result<Reader, TransportError> {
    let qos = if which == RELIABLE { qos::reliable_reader() } else { qos::best_effort_reader() };
    let mut reader: Reader = node
        .subscriber
        .create_simple_datareader_no_key(topic, Some(qos))
        .map_err(|error| middleware(link, "create the subscriber", &error))?;
    registry
        .register(&mut reader, which, Interest::READABLE)
        .map_err(|error| middleware(link, "create the subscriber", &error))?;
    node.graph.add_reader(reader.guid());
    Ok(reader)
}

impl Receiver {
    /// Opens the second reader if it is needed, and receives all available messages: from each reader those of its
    /// writers, since both readers see the whole topic.
    fn receive(&mut self, registry: &Registry) {
        let unreliable = self.node.graph.mismatched(self.reliable.guid());
        if self.best_effort.is_none() && !unreliable.is_empty() {
            match open(&self.node, &self.shared.link, &self.topic, BEST_EFFORT, registry) {
                Ok(reader) => self.best_effort = Some(reader),
                Err(error) => tracing::warn!("{error}"),
            }
        }
        let Self { reliable, best_effort, gaps, shared, .. } = self;
        for (reader, repairs) in [(Some(&*reliable), true), (best_effort.as_ref(), false)] {
            let Some(reader) = reader else { continue };
            reader.drain_read_notifications();
            loop {
                match reader.try_take_one() {
                    Ok(Some(sample)) if repairs == unreliable.contains(&sample.writer_guid) => {}
                    Ok(Some(sample)) => {
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
}

impl Drop for Receiver {
    fn drop(&mut self) {
        for reader in [Some(&self.reliable), self.best_effort.as_ref()].into_iter().flatten() {
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
    fn gaps_are_counted_for_each_writer_from_its_first_message() {
        let [one, two] = [GUID::new_participant_guid(), GUID::new_participant_guid()];
        let mut gaps = Gaps::default();
        let counts = [(one, 5), (one, 6), (two, 1), (one, 9), (two, 2), (one, 9), (one, 1)]
            .map(|(writer, number)| gaps.count(writer, number));
        assert_eq!(counts, [0, 0, 0, 2, 0, 0, 0]);
    }
}
