//! Subscribes to one topic.

use std::{
    collections::HashMap,
    ops::RangeInclusive,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use zenoh::{Wait, liveliness::LivelinessToken, pubsub, qos::CongestionControl, sample::Sample};

use super::{
    ZenohNode,
    attachment::Attachment,
    graph::{self, Graph},
    keys::Endpoint,
    middleware, transient_local,
};
use crate::{
    Payload, Subscriber, TransportError, lock,
    queue::{PushError, Queue},
};

/// Capacity of the queue (messages).
pub(super) const DEPTH: usize = 64;
/// Largest number of publishers whose gaps are counted.
const MAX_PUBLISHERS: usize = 64;

pub(crate) struct ZenohSubscriber {
    receiver: Arc<Receiver>,
    _graph: Graph,
    _token: LivelinessToken,
    _subscriber: pubsub::Subscriber<()>,
    _kept: Option<pubsub::Subscriber<()>>,
    /// Keeps the session open.
    _node: Arc<ZenohNode>,
}

impl ZenohSubscriber {
    /// `with_kept`: whether to receive the messages that publishers have kept.
    pub(super) fn open(
        node: &Arc<ZenohNode>,
        endpoint: Endpoint,
        with_kept: bool,
    ) -> Result<Self, TransportError> {
        let (session, patience) = (&node.session, node.patience.limit());
        let graph = Graph::watch(session, &endpoint)
            .map_err(|error| middleware(&endpoint.link, "watch the publishers", &error))?;
        let Endpoint { link, key, token, .. } = endpoint;
        let receiver = Arc::new(Receiver {
            queue: Queue::new(DEPTH),
            gaps: Mutex::default(),
            lost: AtomicU64::new(0),
            patience,
        });
        let callback = Arc::clone(&receiver);
        let subscriber = session
            .declare_subscriber(&key)
            .callback(move |sample| callback.take(&sample))
            .wait()
            .map_err(|error| middleware(&link, "declare the subscriber", &error))?;
        let callback = Arc::clone(&receiver);
        let take = move |sample: &Sample| callback.take_kept(sample);
        let kept = with_kept
            .then(|| transient_local::collect(node, &key, DEPTH, take))
            .transpose()
            .map_err(|error| middleware(&link, "request the kept messages", &error))?;
        // After the subscription, so that messages sent after the token is seen arrive.
        let token = graph::declare(session, &token)
            .map_err(|error| middleware(&link, "declare the liveliness token", &error))?;
        let _node = Arc::clone(node);
        Ok(Self {
            receiver,
            _graph: graph,
            _token: token,
            _subscriber: subscriber,
            _kept: kept,
            _node,
        })
    }
}

impl Subscriber for ZenohSubscriber {
    fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError> {
        Ok(self.receiver.queue.pop(timeout).map(Payload::Cdr))
    }

    fn lost(&self) -> u64 {
        self.receiver.queue.dropped() + self.receiver.lost.load(Ordering::Relaxed)
    }
}

impl Drop for ZenohSubscriber {
    fn drop(&mut self) {
        // Zenoh's thread may be waiting for space in the queue.
        self.receiver.queue.close();
    }
}

/// Receives messages on zenoh's thread.
struct Receiver {
    queue: Queue<Vec<u8>>,
    gaps: Mutex<Gaps>,
    lost: AtomicU64,
    patience: Duration,
}

impl Receiver {
    /// Receives a message that its publisher kept, unless it was received before.
    fn take_kept(&self, sample: &Sample) {
        // Publishers without sequence numbers are not ROS: duplicates cannot be detected.
        if attachment(sample).is_none_or(|attachment| lock(&self.gaps).is_new(&attachment)) {
            self.enqueue(sample);
        }
    }

    /// Receives a newly published message, unless it was received as a kept one before.
    fn take(&self, sample: &Sample) {
        if let Some(attachment) = attachment(sample) {
            let Some(lost) = lock(&self.gaps).count(&attachment) else { return };
            self.lost.fetch_add(lost, Ordering::Relaxed);
        }
        self.enqueue(sample);
    }

    /// Puts a message into the queue. Waiting for space blocks zenoh's thread and thereby the link, which holds a
    /// blocking publisher back. Messages with congestion control `Drop` never wait.
    fn enqueue(&self, sample: &Sample) {
        let bytes = sample.payload().to_bytes().into_owned();
        let bytes = match sample.congestion_control() {
            CongestionControl::Drop => bytes,
            _ => match self.queue.push_or_wait(bytes, self.patience) {
                Err(PushError::Full(bytes)) => bytes,
                Ok(()) | Err(PushError::Closed(_)) => return,
            },
        };
        self.queue.push_or_drop_oldest(bytes);
    }
}

fn attachment(sample: &Sample) -> Option<Attachment> {
    Attachment::parse(&sample.attachment()?.to_bytes())
}

/// The messages received from each publisher.
#[derive(Default)]
struct Gaps(HashMap<[u8; 16], Seen>);

/// The messages received from a publisher: those from `first` to `last`, and of the kept ones before them those up to
/// `kept`. Those in `ahead` were received as kept messages before they arrive as published ones, if at all.
#[derive(Clone)]
struct Seen {
    first: i64,
    last: i64,
    kept: i64,
    ahead: RangeInclusive<i64>,
}

/// An empty range of sequence numbers.
const NOTHING: RangeInclusive<i64> = RangeInclusive::new(1, 0);

impl Gaps {
    /// Number of messages between the last one and this one that did not arrive; `None` when this one was received
    /// before.
    fn count(&mut self, message: &Attachment) -> Option<u64> {
        let (seen, is_first) = self.seen(message);
        if seen.ahead.contains(&message.sequence) {
            seen.last = seen.last.max(message.sequence);
            return None;
        }
        let last = std::mem::replace(&mut seen.last, message.sequence);
        if is_first {
            return Some(0);
        }
        Some(u64::try_from(message.sequence.saturating_sub(last).saturating_sub(1)).unwrap_or(0))
    }

    /// Whether a kept message was not received before; marks it as received.
    fn is_new(&mut self, message: &Attachment) -> bool {
        let sequence = message.sequence;
        let (seen, is_first) = self.seen(message);
        if is_first || sequence > seen.last {
            let continues = seen.ahead.end().checked_add(1) == Some(sequence);
            let first = if continues { *seen.ahead.start() } else { sequence };
            (seen.last, seen.ahead) = (sequence, first..=sequence);
            return true;
        }
        let is_new = seen.kept < sequence && sequence < seen.first;
        if is_new {
            seen.kept = sequence;
        }
        is_new
    }

    /// The state of a message's publisher, and whether this is its first message.
    fn seen(&mut self, message: &Attachment) -> (&mut Seen, bool) {
        let is_first = !self.0.contains_key(&message.gid);
        if is_first && self.0.len() >= MAX_PUBLISHERS {
            self.0.clear();
        }
        let (first, last) = (message.sequence, message.sequence);
        (
            self.0.entry(message.gid).or_insert(Seen {
                first,
                last,
                kept: i64::MIN,
                ahead: NOTHING,
            }),
            is_first,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(publisher: u8, sequence: i64) -> Attachment {
        Attachment { sequence, source_time: 0, gid: [publisher; 16] }
    }

    #[test]
    fn gaps_are_counted_for_each_publisher_from_its_first_message() {
        let mut gaps = Gaps::default();
        let counts = [(1, 5), (1, 6), (2, 1), (1, 9), (2, 2), (1, 9), (1, 1), (1, 2)]
            .map(|(publisher, sequence)| gaps.count(&message(publisher, sequence)));
        assert_eq!(counts, [0, 0, 0, 2, 0, 0, 0, 0].map(Some));
    }

    #[test]
    fn kept_messages_are_received_once_and_leave_no_gap() {
        let mut gaps = Gaps::default();
        let kept = |gaps: &mut Gaps, sequence| gaps.is_new(&message(1, sequence));
        assert_eq!([3, 4, 4, 3].map(|n| kept(&mut gaps, n)), [true, true, false, false]);
        assert_eq!(gaps.count(&message(1, 5)), Some(0));
        assert_eq!([4, 5, 6, 5].map(|n| kept(&mut gaps, n)), [false, false, true, false]);
        // A published message came first: those before it are still new.
        assert_eq!(gaps.count(&message(2, 8)), Some(0));
        let kept = |gaps: &mut Gaps, sequence| gaps.is_new(&message(2, sequence));
        assert_eq!([6, 7, 8, 6].map(|n| kept(&mut gaps, n)), [true, true, false, false]);
        assert_eq!(gaps.count(&message(2, 9)), Some(0));
    }

    #[test]
    fn a_message_received_as_a_kept_one_is_not_received_again_as_a_published_one() {
        let mut gaps = Gaps::default();
        assert!(gaps.is_new(&message(1, 3)) && gaps.is_new(&message(1, 4)));
        let counts = [3, 4, 5, 7].map(|sequence| gaps.count(&message(1, sequence)));
        assert_eq!(counts, [None, None, Some(0), Some(1)]);
        assert!(gaps.is_new(&message(1, 8)));
        assert_eq!([8, 9].map(|sequence| gaps.count(&message(1, sequence))), [None, Some(0)]);
        // Messages overtaken by a kept one have not arrived yet.
        assert_eq!(gaps.count(&message(2, 5)), Some(0));
        assert!(gaps.is_new(&message(2, 8)));
        let counts = [6, 7, 8, 9].map(|sequence| gaps.count(&message(2, sequence)));
        assert_eq!(counts, [Some(0), Some(0), None, Some(0)]);
    }

    #[test]
    fn the_number_of_remembered_publishers_is_bounded() {
        let mut gaps = Gaps::default();
        for publisher in 0..=255 {
            gaps.count(&message(publisher, 1));
            assert!(gaps.0.len() <= MAX_PUBLISHERS);
        }
    }
}
