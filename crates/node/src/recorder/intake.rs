//! Messages of one topic into a bounded queue; losses are counted.

use std::{
    collections::VecDeque,
    iter::Sum,
    sync::atomic::{AtomicBool, AtomicUsize, Ordering},
    thread::{self, ScopedJoinHandle},
    time::Duration,
};

use super::OpenTopic;
use eddy_frames::{
    Stamp,
    clock::{self, Clock},
};
use eddy_messages::TypeSupport;
use eddy_transport::{Link, Payload, Producer, PushError, Subscriber, TransportError};

/// Longest wait before the stop flag is checked.
pub(super) const MAX_WAIT: Duration = Duration::from_millis(100);
/// The same while the definition of the type is looked for.
const LOOKUP_WAIT: Duration = Duration::from_millis(10);
/// After the stop flag: how long messages that had already arrived are received.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(1);
/// How long a message waits while the queue is full. A publisher with `--reliability block` waits with it.
pub(super) const FULL_QUEUE_TIMEOUT: Duration = Duration::from_secs(5);

/// An item of the queue between subscribers and the writer. Topics are numbered as they are opened.
pub(super) enum Event {
    /// A topic was found and subscribed to.
    Opened(Box<OpenTopic>),
    /// The type of a topic; before its messages.
    Typed(usize, Box<TypeSupport>),
    Message(usize, Payload, Stamp),
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
            Self::Opened(..) | Self::Typed(..) | Self::Failed(..) => EVENT_OVERHEAD,
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

/// What the intakes of a recording share.
pub(super) struct Shared<'a> {
    /// How long a message waits while the queue is full, usually [`FULL_QUEUE_TIMEOUT`].
    pub(super) timeout: Duration,
    /// Capacity of the queue, and of messages that wait for a definition (bytes).
    pub(super) cache_bytes: usize,
    /// Messages that wait for the definition of their type (bytes).
    pub(super) held: AtomicUsize,
    /// Ends all intakes.
    pub(super) stop: &'a AtomicBool,
}

/// Moves the messages of topic `number` from a subscriber into the queue until the stop flag is raised, then those that had
/// already arrived. They are received from the start, and wait here for as long as `type_of` looks for the definition of
/// their type, which comes first in the queue.
pub(super) fn receive(
    number: usize,
    link: &Link,
    subscriber: &mut dyn Subscriber,
    type_of: impl FnOnce() -> TypeSupport + Send,
    producer: &Producer<Event>,
    shared: &Shared<'_>,
) -> Losses {
    thread::scope(|scope| {
        let lookup = Some(scope.spawn(type_of));
        let (waiting, losses) = (VecDeque::new(), Losses::default());
        let mut intake = Intake { number, lookup, waiting, producer, shared, losses };
        intake.run(link, subscriber);
        Losses { in_transport: subscriber.lost(), ..intake.losses }
    })
}

/// The intake of one topic.
struct Intake<'a, 'scope> {
    number: usize,
    /// Looks for the definition; `None` when it is in the queue.
    lookup: Option<ScopedJoinHandle<'scope, TypeSupport>>,
    /// Messages until then.
    waiting: VecDeque<(Payload, Stamp)>,
    producer: &'a Producer<Event>,
    shared: &'a Shared<'a>,
    losses: Losses,
}

impl Intake<'_, '_> {
    fn run(&mut self, link: &Link, subscriber: &mut dyn Subscriber) {
        let mut stopped: Option<Clock> = None;
        loop {
            if self.lookup.as_ref().is_some_and(ScopedJoinHandle::is_finished) {
                self.end_lookup();
            }
            if stopped.is_none() && self.shared.stop.load(Ordering::Relaxed) {
                stopped = Some(Clock::start());
            }
            if stopped.is_some_and(|clock| clock.now() > DRAIN_TIMEOUT) {
                break;
            }
            if self.is_full() {
                // The transport holds the publisher back, or drops and counts messages.
                thread::sleep(LOOKUP_WAIT);
                continue;
            }
            let wait = if self.lookup.is_some() { LOOKUP_WAIT } else { MAX_WAIT };
            match subscriber.receive(stopped.map_or(wait, |_| Duration::ZERO)) {
                Ok(None) if stopped.is_some() => break,
                Ok(None) => {}
                Ok(Some(payload)) if self.lookup.is_some() => {
                    self.shared.held.fetch_add(payload.size(), Ordering::Relaxed);
                    self.waiting.push_back((payload, clock::wall()));
                }
                Ok(Some(payload)) => self.push(payload, clock::wall()),
                Err(error) => {
                    self.end_lookup();
                    // Without a time limit: this event must not be lost.
                    let failed = Event::Failed(link.clone(), error);
                    let _ = self.producer.push_or_wait(failed, Duration::MAX);
                    return;
                }
            }
        }
        self.end_lookup();
    }

    /// Whether no more messages can wait for the definition.
    fn is_full(&self) -> bool {
        let used = self.shared.held.load(Ordering::Relaxed) + self.producer.cost();
        self.lookup.is_some() && !self.waiting.is_empty() && used >= self.shared.cache_bytes
    }

    /// Waits for the definition and passes it and the messages that waited for it on.
    fn end_lookup(&mut self) {
        let Some(lookup) = self.lookup.take() else { return };
        let support = match lookup.join() {
            Ok(support) => support,
            Err(panic) => std::panic::resume_unwind(panic),
        };
        // Without a time limit: nothing can be written without.
        let typed = Event::Typed(self.number, Box::new(support));
        let _ = self.producer.push_or_wait(typed, Duration::MAX);
        while let Some((payload, arrived)) = self.waiting.pop_front() {
            self.shared.held.fetch_sub(payload.size(), Ordering::Relaxed);
            self.push(payload, arrived);
        }
    }

    fn push(&mut self, payload: Payload, arrived: Stamp) {
        let message = Event::Message(self.number, payload, arrived);
        match self.producer.push_or_wait(message, self.shared.timeout) {
            Ok(()) => {}
            Err(PushError::Full(_)) => self.losses.queue_full += 1,
            Err(PushError::Closed(_)) => self.losses.unwritten += 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        collections::VecDeque,
        sync::{Arc, mpsc},
    };

    use super::*;
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

    fn shared(stop: &AtomicBool, cache_bytes: usize) -> Shared<'_> {
        Shared { timeout: Duration::ZERO, cache_bytes, held: AtomicUsize::new(0), stop }
    }

    fn known() -> TypeSupport {
        TypeSupport::foreign("acme_msgs/msg/Probe", "")
    }

    /// Waits until the type is in the queue, then ends.
    struct AfterType<'a, S> {
        queue: &'a Queue<Event>,
        inner: S,
    }

    impl<S: Subscriber> Subscriber for AfterType<'_, S> {
        fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError> {
            if self.queue.cost() == 0 {
                return Ok(None);
            }
            self.inner.receive(timeout)
        }

        fn lost(&self) -> u64 {
            self.inner.lost()
        }
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
        let inner = Deliveries { sizes, failure, stop };
        let mut subscriber = AfterType { queue: &queue, inner };
        let shared = shared(stop, capacity);
        let losses = receive(0, &link(), &mut subscriber, known, &queue.producer(), &shared);
        (queue.close(), losses)
    }

    fn sizes(queued: &[Event]) -> Vec<usize> {
        let messages = queued.iter().filter_map(|item| match item {
            Event::Message(_, payload, _) => Some(payload.size()),
            _ => None,
        });
        messages.collect()
    }

    #[test]
    fn messages_are_dropped_and_counted_while_the_queue_is_full() {
        let (queued, losses) = intake(3_200, &[1_000, 1_000, 1_000, 50], None);
        assert!(matches!(queued[0], Event::Typed(0, _)));
        // A smaller one still fits.
        assert_eq!(sizes(&queued), [1_000, 1_000, 50]);
        assert_eq!(losses, Losses { in_transport: 7, queue_full: 1, unwritten: 0 });
        assert_eq!(losses.total(), 8);
    }

    #[test]
    fn messages_for_a_closed_queue_are_counted_as_unwritten() {
        let stop = &AtomicBool::new(false);
        let queue = queue(3_000);
        queue.close();
        let mut subscriber = Deliveries { sizes: [10, 10].into(), failure: None, stop };
        let shared = shared(stop, 3_000);
        let losses = receive(0, &link(), &mut subscriber, known, &queue.producer(), &shared);
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
        assert!(matches!(
            &queued[..],
            [Event::Typed(..), Event::Message(..), Event::Failed(from, _)] if *from == link()
        ));
        assert_eq!(losses.queue_full, 0);
    }

    #[test]
    fn messages_are_received_while_the_definition_is_looked_for_and_come_after_it_with_their_times()
    {
        let stop = &AtomicBool::new(false);
        let queue = queue(1 << 20);
        let (found, lookup) = mpsc::channel();
        let type_of = move || {
            lookup.recv().unwrap();
            known()
        };
        let all = 1_000;
        let inner = Deliveries { sizes: vec![10; all].into(), failure: None, stop };
        /// Lets the definition be found when everything was received.
        struct Finding<'a>(Deliveries<'a>, mpsc::Sender<Stamp>);
        impl Subscriber for Finding<'_> {
            fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError> {
                if self.0.sizes.is_empty() {
                    // The second time, the thread that waits for it may have ended.
                    let _ = self.1.send(clock::wall());
                }
                self.0.receive(timeout)
            }

            fn lost(&self) -> u64 {
                0
            }
        }
        let mut subscriber = Finding(inner, found);
        let shared = shared(stop, 1 << 20);
        let losses = receive(3, &link(), &mut subscriber, type_of, &queue.producer(), &shared);
        assert_eq!(losses, Losses::default());
        let queued = queue.close();
        assert!(matches!(queued[0], Event::Typed(3, _)));
        assert_eq!(sizes(&queued), vec![10; all]);
        let arrived = queued.iter().filter_map(|event| match event {
            Event::Message(3, _, arrived) => Some(*arrived),
            _ => None,
        });
        assert!(arrived.is_sorted());
        assert_eq!(shared.held.into_inner(), 0);
    }

    #[test]
    fn messages_that_wait_for_a_definition_take_no_more_memory_than_the_queue() {
        let stop = &AtomicBool::new(false);
        let queue = queue(1 << 20);
        let (done, lookup) = mpsc::channel();
        let type_of = move || {
            lookup.recv().unwrap();
            known()
        };
        let mut subscriber = Deliveries { sizes: vec![1_000; 10].into(), failure: None, stop };
        let shared = shared(stop, 3_000);
        let losses = thread::scope(|scope| {
            let held = &shared.held;
            scope.spawn(move || {
                let clock = Clock::start();
                while held.load(Ordering::Relaxed) < 3_000 {
                    assert!(clock.now() < Duration::from_secs(60), "nothing waits");
                    thread::yield_now();
                }
                // Long enough for another message, if one were received.
                thread::sleep(5 * LOOKUP_WAIT);
                assert_eq!(held.load(Ordering::Relaxed), 3_000);
                done.send(()).unwrap();
            });
            receive(0, &link(), &mut subscriber, type_of, &queue.producer(), &shared)
        });
        assert_eq!(sizes(&queue.close()), vec![1_000; 10]);
        assert_eq!(losses.queue_full, 0);
    }
}
