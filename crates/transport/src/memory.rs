//! The transport within a process: publishers fill the queues of the subscribers.

use std::{
    collections::{BTreeSet, HashMap},
    sync::{
        Arc, Mutex, Weak,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use super::{
    Link, Payload, Publisher, Reliability, SeenTopic, Subscriber, TransportError, lock,
    middleware::Middleware,
    patience::Patience,
    queue::{PushError, Queue},
    transports,
};
use eddy_frames::Frame;
use eddy_messages::{QosProfile, TypeSupport};

/// Capacity of a subscriber's queue (messages).
const DEPTH: usize = 64;

/// The topics of one process.
pub(super) struct Broker {
    topics: Mutex<HashMap<String, Arc<Topic>>>,
    patience: Patience,
}

struct Topic {
    type_name: String,
    queues: Mutex<Vec<Weak<Queue<Payload>>>>,
    /// Number of publishers.
    publishers: AtomicUsize,
}

impl Broker {
    /// No topics; blocking publishers wait for a subscriber with `patience`.
    pub(super) fn new(patience: Patience) -> Self {
        Self { topics: Mutex::default(), patience }
    }

    /// The topic of `link`. The first publisher or subscriber determines its type.
    fn topic(&self, link: &Link, type_name: &str) -> Result<Arc<Topic>, TransportError> {
        let mut topics = lock(&self.topics);
        let topic = topics.entry(link.topic.clone()).or_insert_with(|| {
            let (queues, publishers) = (Mutex::default(), AtomicUsize::new(0));
            Arc::new(Topic { type_name: type_name.to_owned(), queues, publishers })
        });
        if topic.type_name != type_name {
            return Err(TransportError::TopicType {
                link: link.clone(),
                found: topic.type_name.clone(),
                expected: type_name.to_owned(),
            });
        }
        Ok(Arc::clone(topic))
    }
}

impl Middleware for Broker {
    fn topics(&self, link: &Link) -> Result<Vec<SeenTopic>, TransportError> {
        let topics = lock(&self.topics);
        let published =
            topics.iter().filter(|(_, topic)| topic.publishers.load(Ordering::Relaxed) > 0);
        let seen = |(name, topic): (&String, &Arc<Topic>)| {
            SeenTopic::new(link.with_topic(name), topic.type_name.clone())
        };
        Ok(published.map(seen).collect())
    }

    fn publisher(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
        reliability: Reliability,
        _offered: Option<QosProfile>,
    ) -> Result<Box<dyn Publisher>, TransportError> {
        let topic = self.topic(link, &support.name)?;
        let (link, patience) = (link.clone(), self.patience.clone());
        let given_up = BTreeSet::new();
        topic.publishers.fetch_add(1, Ordering::Relaxed);
        Ok(Box::new(MemoryPublisher { link, topic, reliability, patience, given_up }))
    }

    fn subscriber(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
        _requested: Option<QosProfile>,
    ) -> Result<Box<dyn Subscriber>, TransportError> {
        let queue = Arc::new(Queue::new(DEPTH));
        lock(&self.topic(link, &support.name)?.queues).push(Arc::downgrade(&queue));
        Ok(Box::new(MemorySubscriber { queue }))
    }
}

pub(super) struct MemoryPublisher {
    link: Link,
    topic: Arc<Topic>,
    reliability: Reliability,
    patience: Patience,
    /// Addresses of the queues that missed the last message: they are not waited for.
    given_up: BTreeSet<usize>,
}

impl MemoryPublisher {
    /// The queues of the current subscribers.
    fn queues(&self) -> Vec<Arc<Queue<Payload>>> {
        let mut queues = lock(&self.topic.queues);
        queues.retain(|queue| queue.strong_count() > 0);
        queues.iter().filter_map(Weak::upgrade).collect()
    }

    /// Sends the message to every subscriber, also after one that stalls.
    fn publish(&mut self, payload: &Payload) -> Result<(), TransportError> {
        let mut missed = BTreeSet::new();
        for queue in self.queues() {
            if self.reliability == Reliability::Drop {
                queue.push_or_drop_oldest(payload.clone());
                continue;
            }
            let address = Arc::as_ptr(&queue).addr();
            let mut waiting = Some(payload.clone());
            let mut push = |slice| match queue.push_or_wait(waiting.take()?, slice) {
                Err(PushError::Full(back)) => {
                    waiting = Some(back);
                    None
                }
                Ok(()) | Err(PushError::Closed(_)) => Some(()),
            };
            let pushed = match self.given_up.contains(&address) {
                true => push(Duration::ZERO),
                false => self.patience.wait(push),
            };
            if pushed.is_none() {
                missed.insert(address);
            }
        }
        self.given_up = missed;
        if self.given_up.is_empty() {
            return Ok(());
        }
        Err(TransportError::missed(&self.link, "a subscriber".to_owned(), &self.patience))
    }
}

impl Publisher for MemoryPublisher {
    fn publish_frame(&mut self, frame: &Frame) -> Result<(), TransportError> {
        transports::check_frames(&self.link, &self.topic.type_name)?;
        self.publish(&Payload::Frame(frame.clone()))
    }

    fn publish_cdr(&mut self, bytes: &[u8]) -> Result<(), TransportError> {
        self.publish(&Payload::Cdr(bytes.to_vec()))
    }

    fn subscribers(&self) -> usize {
        self.queues().len()
    }
}

impl Drop for MemoryPublisher {
    fn drop(&mut self) {
        self.topic.publishers.fetch_sub(1, Ordering::Relaxed);
    }
}

pub(super) struct MemorySubscriber {
    queue: Arc<Queue<Payload>>,
}

impl Subscriber for MemorySubscriber {
    fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError> {
        Ok(self.queue.pop(timeout))
    }

    fn lost(&self) -> u64 {
        self.queue.dropped()
    }
}

impl Drop for MemorySubscriber {
    fn drop(&mut self) {
        self.queue.close();
    }
}
