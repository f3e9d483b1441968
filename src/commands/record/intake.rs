//! What arrives, into a queue of bounded size.

use std::{
    iter::Sum,
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use super::PATIENCE;
use eddy::{
    bag::TopicId,
    clock::{self, Clock},
    frame::Stamp,
    node::{Brought, Producer},
    transport::{Link, Payload, SeenTopic, Subscriber, TransportError},
};

/// How long messages that had arrived at the end are still taken, from a publisher that goes on.
const LAST_ARRIVALS: Duration = Duration::from_secs(1);
/// How long a message waits for room in the queue. Meanwhile a blocking publisher waits too, and a
/// dropping one goes on.
const ROOM_PATIENCE: Duration = Duration::from_secs(5);

/// What is handed over to the one who writes.
pub(super) enum Received {
    /// A topic to record from now on.
    Opened(SeenTopic, Box<dyn Subscriber>),
    Message(TopicId, Payload, Stamp),
    /// Nothing more comes from a topic.
    Failed(Link, TransportError),
}

/// Messages that are not in the bag.
#[derive(Default)]
pub(super) struct Losses {
    /// The transport gave them up.
    pub(super) refused: u64,
    /// They found no room in the queue.
    pub(super) no_room: u64,
    /// They were in the queue, or on their way to it, when the bag could not be written on.
    pub(super) unwritten: u64,
}

impl Losses {
    pub(super) fn total(&self) -> u64 {
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

/// Hands over what a subscriber receives, at the end also what had arrived by then.
pub(super) fn receive(
    link: &Link,
    topic: TopicId,
    mut subscriber: Box<dyn Subscriber>,
    producer: &Producer<Received>,
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
                match producer.bring(message, size, ROOM_PATIENCE) {
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
