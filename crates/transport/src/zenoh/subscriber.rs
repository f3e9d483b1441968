//! Subscribes to one topic.

use std::{
    collections::HashMap,
    ops::RangeInclusive,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
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
    latched, middleware,
};
use crate::{Payload, Subscriber, TransportError, queue::Queue};

/// Messages that a subscriber may be behind.
pub(super) const DEPTH: usize = 64;
/// Publishers whose gaps are counted at the same time.
const MAX_PUBLISHERS: usize = 64;

pub(crate) struct ZenohSubscriber {
    intake: Arc<Intake>,
    _graph: Graph,
    _token: LivelinessToken,
    _subscriber: pubsub::Subscriber<()>,
    _kept: pubsub::Subscriber<()>,
    /// The session ends with its last user.
    _node: Arc<ZenohNode>,
}

impl ZenohSubscriber {
    pub(super) fn open(node: &Arc<ZenohNode>, endpoint: Endpoint) -> Result<Self, TransportError> {
        let (session, patience) = (&node.session, node.patience);
        let graph = Graph::watch(session, &endpoint)
            .map_err(|error| middleware(&endpoint.link, "watch the publishers", &error))?;
        let Endpoint { link, key, token, .. } = endpoint;
        let intake = Arc::new(Intake {
            queue: Queue::new(DEPTH),
            gaps: Mutex::default(),
            lost: AtomicU64::new(0),
            patience,
        });
        let callback = Arc::clone(&intake);
        let subscriber = session
            .declare_subscriber(&key)
            .callback(move |sample| callback.take(&sample))
            .wait()
            .map_err(|error| middleware(&link, "declare the subscriber", &error))?;
        let callback = Arc::clone(&intake);
        let kept = latched::collect(node, &key, DEPTH, move |sample| callback.take_kept(sample))
            .map_err(|error| middleware(&link, "ask for what was kept", &error))?;
        // After the subscription: whoever sees the token can be sure that messages arrive.
        let token = graph::declare(session, &token)
            .map_err(|error| middleware(&link, "declare the liveliness token", &error))?;
        let _node = Arc::clone(node);
        Ok(Self {
            intake,
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
        Ok(self.intake.queue.pop(timeout).map(Payload::Cdr))
    }

    fn refused(&self) -> u64 {
        self.intake.queue.dropped() + self.intake.lost.load(Ordering::Relaxed)
    }
}

impl Drop for ZenohSubscriber {
    fn drop(&mut self) {
        // Zenoh's thread may be waiting for room.
        self.intake.queue.close();
    }
}

/// Where zenoh's thread leaves messages.
struct Intake {
    queue: Queue<Vec<u8>>,
    gaps: Mutex<Gaps>,
    lost: AtomicU64,
    patience: Duration,
}

impl Intake {
    /// Takes a message that its publisher kept, unless it came before.
    fn take_kept(&self, sample: &Sample) {
        // Who does not number its messages is not ROS: they cannot be told apart.
        if attachment(sample).is_none_or(|attachment| self.lock().is_new(&attachment)) {
            self.queue_up(sample);
        }
    }

    /// Takes a message that was just published, unless its publisher gave it as a kept one before.
    fn take(&self, sample: &Sample) {
        if let Some(attachment) = attachment(sample) {
            let Some(lost) = self.lock().count(&attachment) else { return };
            self.lost.fetch_add(lost, Ordering::Relaxed);
        }
        self.queue_up(sample);
    }

    /// Puts a message into the queue. Waiting for room blocks zenoh's thread, that stops the reading of
    /// the link, and that holds a blocking publisher back; messages sent to be dropped never wait.
    fn queue_up(&self, sample: &Sample) {
        let bytes = sample.payload().to_bytes().into_owned();
        let waited = match sample.congestion_control() {
            CongestionControl::Drop => Err(bytes),
            _ => self.queue.push_or_wait(bytes, self.patience),
        };
        if let Err(bytes) = waited {
            self.queue.push_or_replace(bytes);
        }
    }

    /// Numbers are never left half changed.
    fn lock(&self) -> MutexGuard<'_, Gaps> {
        self.gaps.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn attachment(sample: &Sample) -> Option<Attachment> {
    Attachment::parse(&sample.attachment()?.to_bytes())
}

/// Which messages of each publisher have come.
#[derive(Default)]
struct Gaps(HashMap<[u8; 16], Seen>);

/// The messages of one publisher that have come: those from `first` to `last`, and of the ones before, which it had
/// kept, those up to `kept`. Those in `ahead` came as kept ones before they came as published ones, if ever.
#[derive(Clone)]
struct Seen {
    first: i64,
    last: i64,
    kept: i64,
    ahead: RangeInclusive<i64>,
}

/// No sequence.
const NOTHING: RangeInclusive<i64> = RangeInclusive::new(1, 0);

impl Gaps {
    /// Messages that were published between the last one and this one, but never came. `None` when this one came
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

    /// Whether a message that its publisher kept has not come before. Notes it.
    fn is_new(&mut self, message: &Attachment) -> bool {
        let sequence = message.sequence;
        let (seen, is_first) = self.seen(message);
        if is_first || sequence > seen.last {
            let goes_on = seen.ahead.end().checked_add(1) == Some(sequence);
            let first = if goes_on { *seen.ahead.start() } else { sequence };
            (seen.last, seen.ahead) = (sequence, first..=sequence);
            return true;
        }
        let is_new = seen.kept < sequence && sequence < seen.first;
        if is_new {
            seen.kept = sequence;
        }
        is_new
    }

    /// What is known of a message's publisher, and whether this is the first of its messages.
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
    fn kept_messages_come_once_and_leave_no_gap() {
        let mut gaps = Gaps::default();
        let kept = |gaps: &mut Gaps, sequence| gaps.is_new(&message(1, sequence));
        assert_eq!([3, 4, 4, 3].map(|n| kept(&mut gaps, n)), [true, true, false, false]);
        assert_eq!(gaps.count(&message(1, 5)), Some(0));
        assert_eq!([4, 5, 6, 5].map(|n| kept(&mut gaps, n)), [false, false, true, false]);
        // A message that was just published came first: those before it are still new.
        assert_eq!(gaps.count(&message(2, 8)), Some(0));
        let kept = |gaps: &mut Gaps, sequence| gaps.is_new(&message(2, sequence));
        assert_eq!([6, 7, 8, 6].map(|n| kept(&mut gaps, n)), [true, true, false, false]);
        assert_eq!(gaps.count(&message(2, 9)), Some(0));
    }

    #[test]
    fn what_came_as_a_kept_message_does_not_come_again_as_a_published_one() {
        let mut gaps = Gaps::default();
        assert!(gaps.is_new(&message(1, 3)) && gaps.is_new(&message(1, 4)));
        let counts = [3, 4, 5, 7].map(|sequence| gaps.count(&message(1, sequence)));
        assert_eq!(counts, [None, None, Some(0), Some(1)]);
        assert!(gaps.is_new(&message(1, 8)));
        assert_eq!([8, 9].map(|sequence| gaps.count(&message(1, sequence))), [None, Some(0)]);
        // Those that a kept one has overtaken have not come yet.
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
