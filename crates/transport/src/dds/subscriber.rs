//! Subscribes to one topic.
//!
//! A reader that asks for repairs does not match writers that do not repair, and one that does not ask
//! gets none: which of them a topic needs is only known when its writers are. The first reader asks. When
//! writers turn up that it does not fit, a second one takes their messages, and no others.

use std::{
    collections::{BTreeMap, BTreeSet},
    io,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

use ros2_client::dds::rustdds::{
    GUID, Topic,
    mio1::{Events, Interest, Poll, Registry, Token, Waker},
    no_key::SimpleDataReader,
};

use super::{DdsNode, cdr::AsItIs, middleware, qos};
use crate::{Link, Payload, Subscriber, TransportError, queue::Queue};
use eddy_messages::TypeSupport;

/// Messages that a subscriber may be behind.
const DEPTH: usize = 1_024;
/// Bytes that a subscriber may be behind.
const MOST_BYTES: usize = 64 << 20;
/// Writers whose gaps are counted at the same time.
const MAX_WRITERS: usize = 64;

type Reader = SimpleDataReader<Vec<u8>, AsItIs>;

pub(crate) struct DdsSubscriber {
    shared: Arc<Shared>,
    waker: Arc<Waker>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    link: Link,
    queue: Queue<Vec<u8>>,
    /// Bytes in the queue.
    waiting: AtomicUsize,
    lost: AtomicU64,
    stop: AtomicBool,
}

impl DdsSubscriber {
    pub(super) fn open(
        node: &Arc<DdsNode>,
        link: &Link,
        support: &TypeSupport,
    ) -> Result<Self, TransportError> {
        let failed = |error: io::Error| middleware(link, "create the subscriber", &error);
        let ours = Arc::new(Shared {
            link: link.clone(),
            queue: Queue::new(DEPTH),
            waiting: AtomicUsize::new(0),
            lost: AtomicU64::new(0),
            stop: AtomicBool::new(false),
        });
        let poll = Poll::new().map_err(failed)?;
        let waker = Arc::new(Waker::new(poll.registry(), WAKE).map_err(failed)?);
        let topic = node.topic(link, &support.name)?;
        let (shared, node) = (Arc::clone(&ours), Arc::clone(node));
        let reliable = open(&node, link, &topic, RELIABLE, poll.registry())?;
        node.graph.watch(reliable.guid(), &waker);
        let gaps = Gaps::default();
        let intake = Intake { topic, reliable, best_effort: None, gaps, shared, node };
        let thread = thread::Builder::new()
            .name("dds subscriber".to_owned())
            .spawn(move || intake.run(poll))
            .map_err(failed)?;
        Ok(Self { shared: ours, waker, thread: Some(thread) })
    }
}

impl Subscriber for DdsSubscriber {
    fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError> {
        let message = self.shared.queue.pop(timeout);
        if let Some(message) = &message {
            self.shared.waiting.fetch_sub(message.len(), Ordering::Relaxed);
        }
        Ok(message.map(Payload::Cdr))
    }

    fn refused(&self) -> u64 {
        self.shared.lost.load(Ordering::Relaxed)
    }
}

impl Drop for DdsSubscriber {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        // A thread that cannot be woken is not waited for.
        if self.waker.wake().is_ok()
            && let Some(thread) = self.thread.take()
        {
            let _ = thread.join();
        }
    }
}

impl Shared {
    /// Puts a message into the queue, and gives up what is too much, oldest first.
    fn put(&self, message: Vec<u8>) {
        let waiting = self.waiting.fetch_add(message.len(), Ordering::Relaxed) + message.len();
        let mut excess = waiting.saturating_sub(MOST_BYTES);
        let mut message = Some(message);
        while let Some(newest) = message.take() {
            let oldest = if excess > 0 { self.queue.pop(Duration::ZERO) } else { None };
            match oldest {
                Some(oldest) => {
                    self.give_up(&oldest);
                    excess = excess.saturating_sub(oldest.len());
                    message = Some(newest);
                }
                None => match self.queue.push_or_wait(newest, Duration::ZERO) {
                    Ok(()) => {}
                    Err(newest) => {
                        excess = 1;
                        message = Some(newest);
                    }
                },
            }
        }
    }

    fn give_up(&self, message: &[u8]) {
        self.waiting.fetch_sub(message.len(), Ordering::Relaxed);
        self.lost.fetch_add(1, Ordering::Relaxed);
    }
}

const WAKE: Token = Token(0);
const RELIABLE: Token = Token(1);
const BEST_EFFORT: Token = Token(2);

/// Takes messages from RustDDS, on a thread of its own.
struct Intake {
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

impl Intake {
    fn run(mut self, mut poll: Poll) {
        let mut events = Events::with_capacity(4);
        while !self.shared.stop.load(Ordering::Relaxed) {
            let unreliable = self.node.graph.mismatched(self.reliable.guid());
            if self.best_effort.is_none() && !unreliable.is_empty() {
                let Self { node, shared, topic, .. } = &self;
                match open(node, &shared.link, topic, BEST_EFFORT, poll.registry()) {
                    Ok(reader) => self.best_effort = Some(reader),
                    Err(error) => tracing::warn!("{error}"),
                }
            }
            self.take(&unreliable);
            match poll.poll(&mut events, None) {
                Err(error) if error.kind() != io::ErrorKind::Interrupted => {
                    tracing::warn!("{}: no longer read: {error}", self.shared.link);
                    return;
                }
                _ => {}
            }
        }
    }

    /// Takes everything there is now, from each reader what is its own: both see the whole topic.
    fn take(&mut self, unreliable: &BTreeSet<GUID>) {
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
                        shared.put(sample.into_value());
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

impl Drop for Intake {
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
    /// Messages that were written between the last one and this one, but never came.
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
        Shared {
            link: "dds:/test".parse().unwrap(),
            queue: Queue::new(DEPTH),
            waiting: AtomicUsize::new(0),
            lost: AtomicU64::new(0),
            stop: AtomicBool::new(false),
        }
    }

    #[test]
    fn the_oldest_of_too_many_messages_is_given_up_and_counted() {
        let shared = shared();
        for number in 0..DEPTH + 3 {
            shared.put(number.to_le_bytes().to_vec());
        }
        assert_eq!(shared.queue.pop(Duration::ZERO), Some(3usize.to_le_bytes().to_vec()));
        assert_eq!(shared.lost.load(Ordering::Relaxed), 3);
        assert_eq!(shared.waiting.load(Ordering::Relaxed), DEPTH * size_of::<usize>());
    }

    #[test]
    fn too_many_bytes_count_as_too_many_messages() {
        let shared = shared();
        for number in 0..6 {
            shared.put(vec![number; MOST_BYTES / 4]);
        }
        assert_eq!(shared.queue.pop(Duration::ZERO).unwrap()[0], 2);
        assert_eq!(shared.lost.load(Ordering::Relaxed), 2);
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
