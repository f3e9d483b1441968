//! Subscribes to one topic.

use std::{
    collections::HashMap,
    sync::{
        Arc, Mutex, PoisonError,
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
    middleware,
};
use crate::transport::{Payload, Subscriber, TransportError, queue::Queue};

/// Messages that a subscriber may be behind.
pub(super) const DEPTH: usize = 64;
/// Publishers whose gaps are counted at the same time.
const MAX_PUBLISHERS: usize = 64;

pub(in crate::transport) struct ZenohSubscriber {
    intake: Arc<Intake>,
    _graph: Graph,
    _token: LivelinessToken,
    _subscriber: pubsub::Subscriber<()>,
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
            .declare_subscriber(key)
            .callback(move |sample| callback.take(&sample))
            .wait()
            .map_err(|error| middleware(&link, "declare the subscriber", &error))?;
        // After the subscription: whoever sees the token can be sure that messages arrive.
        let token = graph::declare(session, &token)
            .map_err(|error| middleware(&link, "declare the liveliness token", &error))?;
        let _node = Arc::clone(node);
        Ok(Self { intake, _graph: graph, _token: token, _subscriber: subscriber, _node })
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
    /// Puts a message into the queue. Waiting for room blocks zenoh's thread, that stops the reading of
    /// the link, and that holds a blocking publisher back; messages sent to be dropped never wait.
    fn take(&self, sample: &Sample) {
        let attachment = sample.attachment().and_then(|bytes| Attachment::parse(&bytes.to_bytes()));
        if let Some(attachment) = attachment {
            let lost = self.gaps.lock().unwrap_or_else(PoisonError::into_inner).count(&attachment);
            self.lost.fetch_add(lost, Ordering::Relaxed);
        }
        let bytes = sample.payload().to_bytes().into_owned();
        let waited = match sample.congestion_control() {
            CongestionControl::Drop => Err(bytes),
            _ => self.queue.push_or_wait(bytes, self.patience),
        };
        if let Err(bytes) = waited {
            self.queue.push_or_replace(bytes);
        }
    }
}

/// The last message of each publisher.
#[derive(Default)]
struct Gaps(HashMap<[u8; 16], i64>);

impl Gaps {
    /// Messages that were published between the last one and this one, but never came.
    fn count(&mut self, message: &Attachment) -> u64 {
        if self.0.len() >= MAX_PUBLISHERS && !self.0.contains_key(&message.gid) {
            self.0.clear();
        }
        match self.0.insert(message.gid, message.sequence) {
            Some(last) => {
                u64::try_from(message.sequence.saturating_sub(last).saturating_sub(1)).unwrap_or(0)
            }
            None => 0,
        }
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
        assert_eq!(counts, [0, 0, 0, 2, 0, 0, 0, 0]);
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
