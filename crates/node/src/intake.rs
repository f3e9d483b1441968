//! What arrives on one topic, into a queue of bounded size; what has to be given up is counted.

use std::{
    iter::Sum,
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use super::{
    cache::{Brought, Producer},
    recording::PATIENCE,
};
use eddy_bag::TopicId;
use eddy_frames::{
    Stamp,
    clock::{self, Clock},
};
use eddy_transport::{Link, Payload, SeenTopic, Subscriber, TransportError};

/// How long messages that had arrived at the end are still taken, from a publisher that goes on.
const LAST_ARRIVALS: Duration = Duration::from_secs(1);
/// How long a message waits for room in the queue. Meanwhile a blocking publisher waits too, and a
/// dropping one goes on.
pub(super) const ROOM_PATIENCE: Duration = Duration::from_secs(5);

/// An item of the queue between subscribers and the writer.
pub(super) enum Received {
    /// A topic to record from now on.
    Opened(SeenTopic, Box<dyn Subscriber>),
    Message(TopicId, Payload, Stamp),
    /// Nothing more comes from a topic.
    Failed(Link, TransportError),
}

/// Messages that are not in the bag.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Losses {
    /// The transport gave them up.
    pub refused: u64,
    /// They found no room in the queue.
    pub no_room: u64,
    /// They were in the queue, or on their way to it, when the bag could not be written on.
    pub unwritten: u64,
}

impl Losses {
    /// All of them.
    pub fn total(&self) -> u64 {
        self.refused + self.no_room + self.unwritten
    }
}

impl Sum for Losses {
    fn sum<I: Iterator<Item = Self>>(all: I) -> Self {
        all.fold(Self::default(), |sum, one| Self {
            refused: sum.refused + one.refused,
            no_room: sum.no_room + one.no_room,
            unwritten: sum.unwritten + one.unwritten,
        })
    }
}

/// Hands over what a subscriber receives, at the end also what had arrived by then. Each message waits `patience`
/// at most for room in the queue, usually [`ROOM_PATIENCE`].
pub(super) fn receive(
    link: &Link,
    topic: TopicId,
    subscriber: &mut dyn Subscriber,
    producer: &Producer<Received>,
    patience: Duration,
    stop: &AtomicBool,
) -> Losses {
    let mut stopped: Option<Clock> = None;
    let (mut no_room, mut unwritten) = (0, 0);
    loop {
        if stopped.is_none() && stop.load(Ordering::Relaxed) {
            stopped = Some(Clock::start());
        }
        if stopped.is_some_and(|clock| clock.now() > LAST_ARRIVALS) {
            break;
        }
        match subscriber.receive(stopped.map_or(PATIENCE, |_| Duration::ZERO)) {
            Ok(None) if stopped.is_some() => break,
            Ok(None) => {}
            Ok(Some(payload)) => {
                let size = payload.size();
                let message = Received::Message(topic, payload, clock::wall());
                match producer.bring(message, size, patience) {
                    Brought::Queued => {}
                    Brought::NoRoom => no_room += 1,
                    Brought::Unwanted => unwritten += 1,
                }
            }
            Err(error) => {
                // It must not get lost: room comes, or the end.
                producer.bring(Received::Failed(link.clone(), error), 0, Duration::MAX);
                break;
            }
        }
    }
    Losses { refused: subscriber.refused(), no_room, unwritten }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;

    use super::*;
    use crate::Cache;
    use eddy_bag::{BagWriter, WriterOptions};
    use eddy_messages::{Message, RosString};
    use eddy_transport::TransportKind;

    /// Delivers messages of so many bytes, then an error where there is one; raises the flag with the last.
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

        fn refused(&self) -> u64 {
            7
        }
    }

    fn link() -> Link {
        Link { transport: TransportKind::Memory, topic: "/words".to_owned() }
    }

    /// The id of a topic; only a bag gives one.
    fn topic() -> TopicId {
        let folder = tempfile::tempdir().unwrap();
        let mut bag =
            BagWriter::create(&folder.path().join("bag"), WriterOptions::default()).unwrap();
        bag.topic("/words", RosString::TYPE).unwrap()
    }

    /// What arrives in a queue of so many bytes that nobody empties, and what does not.
    fn intake(
        capacity: usize,
        sizes: &[usize],
        failure: Option<TransportError>,
    ) -> (Vec<Received>, Losses) {
        let stop = &AtomicBool::new(false);
        let cache = Cache::new(capacity);
        let sizes = sizes.iter().copied().collect();
        let mut subscriber = Deliveries { sizes, failure, stop };
        let losses =
            receive(&link(), topic(), &mut subscriber, &cache.producer(), Duration::ZERO, stop);
        (cache.close(), losses)
    }

    #[test]
    fn messages_that_find_no_room_are_dropped_and_counted() {
        let (queued, losses) = intake(3_000, &[1_000, 1_000, 1_000, 50], None);
        let sizes = queued.iter().map(|item| match item {
            Received::Message(_, payload, _) => payload.size(),
            _ => 0,
        });
        // A smaller one still fits.
        assert_eq!(sizes.collect::<Vec<_>>(), [1_000, 1_000, 50]);
        assert_eq!(losses, Losses { refused: 7, no_room: 1, unwritten: 0 });
        assert_eq!(losses.total(), 8);
    }

    #[test]
    fn messages_for_a_queue_that_is_closed_are_counted_as_unwritten() {
        let stop = &AtomicBool::new(false);
        let cache = Cache::new(3_000);
        cache.close();
        let mut subscriber = Deliveries { sizes: [10, 10].into(), failure: None, stop };
        let losses =
            receive(&link(), topic(), &mut subscriber, &cache.producer(), Duration::ZERO, stop);
        assert_eq!(losses, Losses { refused: 7, no_room: 0, unwritten: 2 });
        let sum: Losses = [losses, losses].into_iter().sum();
        assert_eq!(sum, Losses { refused: 14, no_room: 0, unwritten: 4 });
    }

    #[test]
    fn a_failure_ends_the_intake_and_is_handed_over() {
        let failure = TransportError::TopicType {
            link: link(),
            found: "a".to_owned(),
            expected: "b".to_owned(),
        };
        let (queued, losses) = intake(3_000, &[10], Some(failure));
        assert!(
            matches!(&queued[..], [Received::Message(..), Received::Failed(from, _)] if *from == link())
        );
        assert_eq!(losses.no_room, 0);
    }
}
