//! Messages of one topic into a bounded queue; losses are counted.

use std::{
    iter::Sum,
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use super::OpenTopic;
use eddy_bag::TopicId;
use eddy_frames::{
    Stamp,
    clock::{self, Clock},
};
use eddy_transport::{Link, Payload, Producer, PushError, Subscriber, TransportError};

/// Longest wait before the stop flag is checked.
pub(super) const MAX_WAIT: Duration = Duration::from_millis(100);
/// After the stop flag: how long messages that had already arrived are received.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(1);
/// How long a message waits while the queue is full. A publisher with `--reliability block` waits with it.
pub(super) const FULL_QUEUE_TIMEOUT: Duration = Duration::from_secs(5);

/// An item of the queue between subscribers and the writer.
pub(super) enum Event {
    /// A topic was found and subscribed to.
    Opened(Box<OpenTopic>),
    Message(TopicId, Payload, Stamp),
    /// A subscriber failed; no more messages follow on its topic.
    Failed(Link, TransportError),
}

/// Memory of an event beside the bytes of its message: its slot in the queue and its allocation.
const EVENT_OVERHEAD: usize = 256;

impl Event {
    /// Memory (bytes).
    pub(super) fn cost(&self) -> usize {
        match self {
            Self::Message(_, payload, _) => payload.size() + EVENT_OVERHEAD,
            Self::Opened(..) | Self::Failed(..) => EVENT_OVERHEAD,
        }
    }
}

/// Messages that were received or sent but are not in the bag.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Losses {
    /// Dropped by the transport.
    pub in_transport: u64,
    /// Dropped because the queue was full.
    pub queue_full: u64,
    /// In the queue, or waiting for it, when writing the bag failed.
    pub unwritten: u64,
}

impl Losses {
    /// The sum.
    pub fn total(&self) -> u64 {
        self.in_transport + self.queue_full + self.unwritten
    }
}

impl Sum for Losses {
    fn sum<I: Iterator<Item = Self>>(all: I) -> Self {
        all.fold(Self::default(), |sum, one| Self {
            in_transport: sum.in_transport + one.in_transport,
            queue_full: sum.queue_full + one.queue_full,
            unwritten: sum.unwritten + one.unwritten,
        })
    }
}

/// Moves messages from a subscriber into the queue until `stop` is raised, then those that had already arrived. Each
/// waits up to `timeout` while the queue is full, usually [`FULL_QUEUE_TIMEOUT`].
pub(super) fn receive(
    link: &Link,
    topic: TopicId,
    subscriber: &mut dyn Subscriber,
    producer: &Producer<Event>,
    timeout: Duration,
    stop: &AtomicBool,
) -> Losses {
    let mut stopped: Option<Clock> = None;
    let (mut queue_full, mut unwritten) = (0, 0);
    loop {
        if stopped.is_none() && stop.load(Ordering::Relaxed) {
            stopped = Some(Clock::start());
        }
        if stopped.is_some_and(|clock| clock.now() > DRAIN_TIMEOUT) {
            break;
        }
        match subscriber.receive(stopped.map_or(MAX_WAIT, |_| Duration::ZERO)) {
            Ok(None) if stopped.is_some() => break,
            Ok(None) => {}
            Ok(Some(payload)) => {
                let message = Event::Message(topic, payload, clock::wall());
                match producer.push_or_wait(message, timeout) {
                    Ok(()) => {}
                    Err(PushError::Full(_)) => queue_full += 1,
                    Err(PushError::Closed(_)) => unwritten += 1,
                }
            }
            Err(error) => {
                // Without a time limit: this event must not be lost.
                let _ = producer.push_or_wait(Event::Failed(link.clone(), error), Duration::MAX);
                break;
            }
        }
    }
    Losses { in_transport: subscriber.lost(), queue_full, unwritten }
}

#[cfg(test)]
mod tests {
    use std::{collections::VecDeque, sync::Arc};

    use super::*;
    use eddy_bag::{BagWriter, WriterOptions};
    use eddy_messages::{Message, RosString};
    use eddy_transport::{Queue, TransportKind};

    /// Delivers messages of these sizes (bytes), then raises the stop flag and fails if there is a failure.
    struct Deliveries<'a> {
        sizes: VecDeque<usize>,
        failure: Option<TransportError>,
        stop: &'a AtomicBool,
    }

    impl Subscriber for Deliveries<'_> {
        fn receive(&mut self, _: Duration) -> Result<Option<Payload>, TransportError> {
            if let Some(size) = self.sizes.pop_front() {
                return Ok(Some(Payload::Cdr(vec![0; size])));
            }
            self.stop.store(true, Ordering::Relaxed);
            self.failure.take().map_or(Ok(None), Err)
        }

        fn lost(&self) -> u64 {
            7
        }
    }

    fn queue(capacity: usize) -> Arc<Queue<Event>> {
        Arc::new(Queue::with_cost(usize::MAX, capacity, Event::cost))
    }

    fn link() -> Link {
        Link { transport: TransportKind::Memory, topic: "/words".to_owned() }
    }

    /// A topic id; only a bag creates one.
    fn topic() -> TopicId {
        let folder = tempfile::tempdir().unwrap();
        let mut bag =
            BagWriter::create(&folder.path().join("bag"), WriterOptions::default()).unwrap();
        bag.topic("/words", RosString::TYPE).unwrap()
    }

    /// The contents of a queue of `capacity` bytes that nobody reads, and the losses.
    fn intake(
        capacity: usize,
        sizes: &[usize],
        failure: Option<TransportError>,
    ) -> (Vec<Event>, Losses) {
        let stop = &AtomicBool::new(false);
        let queue = queue(capacity);
        let sizes = sizes.iter().copied().collect();
        let mut subscriber = Deliveries { sizes, failure, stop };
        let losses =
            receive(&link(), topic(), &mut subscriber, &queue.producer(), Duration::ZERO, stop);
        (queue.close(), losses)
    }

    #[test]
    fn messages_are_dropped_and_counted_while_the_queue_is_full() {
        let (queued, losses) = intake(3_000, &[1_000, 1_000, 1_000, 50], None);
        let sizes = queued.iter().map(|item| match item {
            Event::Message(_, payload, _) => payload.size(),
            _ => 0,
        });
        // A smaller one still fits.
        assert_eq!(sizes.collect::<Vec<_>>(), [1_000, 1_000, 50]);
        assert_eq!(losses, Losses { in_transport: 7, queue_full: 1, unwritten: 0 });
        assert_eq!(losses.total(), 8);
    }

    #[test]
    fn messages_for_a_closed_queue_are_counted_as_unwritten() {
        let stop = &AtomicBool::new(false);
        let queue = queue(3_000);
        queue.close();
        let mut subscriber = Deliveries { sizes: [10, 10].into(), failure: None, stop };
        let losses =
            receive(&link(), topic(), &mut subscriber, &queue.producer(), Duration::ZERO, stop);
        assert_eq!(losses, Losses { in_transport: 7, queue_full: 0, unwritten: 2 });
        let sum: Losses = [losses, losses].into_iter().sum();
        assert_eq!(sum, Losses { in_transport: 14, queue_full: 0, unwritten: 4 });
    }

    #[test]
    fn a_failure_ends_the_intake_and_is_passed_on() {
        let failure = TransportError::TopicType {
            link: link(),
            found: "a".to_owned(),
            expected: "b".to_owned(),
        };
        let (queued, losses) = intake(3_000, &[10], Some(failure));
        assert!(
            matches!(&queued[..], [Event::Message(..), Event::Failed(from, _)] if *from == link())
        );
        assert_eq!(losses.queue_full, 0);
    }
}
