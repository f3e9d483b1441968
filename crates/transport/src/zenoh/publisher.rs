//! Publishes a topic.

use std::{num::NonZeroUsize, sync::Arc, thread::JoinHandle};

use zenoh::{Wait, bytes::ZBytes, liveliness::LivelinessToken, pubsub, qos::CongestionControl};

use super::{
    ZenohNode,
    attachment::{Attachment, LENGTH},
    graph::{self, Graph},
    keys::Endpoint,
    middleware,
    sender::{self, Sender},
    transient_local::Kept,
};
use crate::{Link, Publisher, Reliability, TransportError, transports};
use eddy_frames::{
    Frame,
    clock::{self, Clock},
};
use eddy_messages::FrameCdr;

pub(crate) struct ZenohPublisher {
    link: Link,
    type_name: String,
    gid: [u8; 16],
    /// Sequence number of the last message; the first is 1.
    sequence: i64,
    /// `None` while it is dropped.
    wire: Option<Arc<Wire>>,
    /// Of a blocking publisher.
    sender: Option<Sender<Message>>,
}

/// What is declared in the session.
struct Wire {
    link: Link,
    publisher: pubsub::Publisher<'static>,
    /// For late-joining subscribers.
    kept: Option<Kept>,
    graph: Graph,
    _token: LivelinessToken,
    /// Keeps the session open.
    node: Arc<ZenohNode>,
}

struct Message {
    payload: ZBytes,
    attachment: [u8; LENGTH],
}

impl ZenohPublisher {
    pub(super) fn open(
        node: &Arc<ZenohNode>,
        endpoint: Endpoint,
        reliability: Reliability,
        kept: Option<NonZeroUsize>,
    ) -> Result<Self, TransportError> {
        let session = &node.session;
        let graph = Graph::watch(session, &endpoint)
            .map_err(|error| middleware(&endpoint.link, "watch the subscribers", &error))?;
        let gid = endpoint.gid();
        let Endpoint { link, type_name, key, token, .. } = endpoint;
        let congestion_control = match reliability {
            Reliability::Block => CongestionControl::Block,
            Reliability::Drop => CongestionControl::Drop,
        };
        let kept = kept
            .map(|depth| Kept::open(session, &key, depth))
            .transpose()
            .map_err(|error| middleware(&link, "keep messages", &error))?;
        let publisher = session
            .declare_publisher(key)
            .congestion_control(congestion_control)
            .wait()
            .map_err(|error| middleware(&link, "declare the publisher", &error))?;
        let token = graph::declare(session, &token)
            .map_err(|error| middleware(&link, "declare the liveliness token", &error))?;
        let node = Arc::clone(node);
        let wire = Wire { link: link.clone(), publisher, kept, graph, _token: token, node };
        let wire = Arc::new(wire);
        let sender = (reliability == Reliability::Block).then(|| {
            let wire = Arc::clone(&wire);
            Sender::start(&wire.node.patience.clone(), move |message| {
                if let Err(error) = wire.put(message) {
                    tracing::warn!("{error}");
                }
            })
        });
        let sender = sender.transpose().map_err(|error| middleware(&link, "publish", &error))?;
        Ok(Self { link, type_name, gid, sequence: 0, wire: Some(wire), sender })
    }

    fn publish(&mut self, bytes: Vec<u8>) -> Result<(), TransportError> {
        let Some(wire) = &self.wire else { return Ok(()) };
        self.sequence += 1;
        let attachment =
            Attachment { sequence: self.sequence, source_time: clock::wall().0, gid: self.gid };
        let message = Message { payload: ZBytes::from(bytes), attachment: attachment.to_bytes() };
        let Some(sender) = &self.sender else { return wire.put(message) };
        let is_sent = sender.send(message, &wire.node.patience);
        if is_sent && sender.take_stalled() == 0 {
            return Ok(());
        }
        Err(TransportError::missed(&self.link, subscriber(), &wire.node.patience))
    }
}

/// Zenoh does not say which peer has no room.
fn subscriber() -> String {
    "a subscriber".to_owned()
}

impl Wire {
    fn put(&self, Message { payload, attachment }: Message) -> Result<(), TransportError> {
        let timestamp = self.kept.as_ref().map(|kept| {
            let now = self.node.session.new_timestamp();
            kept.keep(payload.clone(), attachment, now);
            now
        });
        self.publisher
            .put(payload)
            .attachment(attachment)
            .timestamp(timestamp)
            .wait()
            .map_err(|error| middleware(&self.link, "publish", &error))
    }
}

impl Publisher for ZenohPublisher {
    fn publish_frame(&mut self, frame: &Frame) -> Result<(), TransportError> {
        transports::check_frames(&self.link, &self.type_name)?;
        self.publish(frame.to_cdr())
    }

    fn publish_cdr(&mut self, bytes: &[u8]) -> Result<(), TransportError> {
        self.publish(bytes.to_vec())
    }

    fn flush(&mut self) -> Result<(), TransportError> {
        let (Some(wire), Some(sender)) = (&self.wire, &self.sender) else { return Ok(()) };
        let clock = Clock::start();
        match sender.flush(&wire.node.patience) {
            0 => Ok(()),
            messages => Err(TransportError::Undelivered {
                link: self.link.clone(),
                subscriber: subscriber(),
                messages,
                seconds: clock.now().as_secs_f64(),
            }),
        }
    }

    /// The number of tokens of matching ROS subscribers, once messages reach a subscriber. Subscribers without a token,
    /// which are not ROS, count as one.
    fn subscribers(&self) -> usize {
        let Some(wire) = &self.wire else { return 0 };
        let reached = wire.publisher.matching_status().wait();
        if reached.is_ok_and(|status| status.matching()) { wire.graph.matching().max(1) } else { 0 }
    }
}

impl Drop for ZenohPublisher {
    fn drop(&mut self) {
        if let Err(error) = self.flush() {
            tracing::warn!("{error}");
        }
        let thread = self.sender.take().map(Sender::end);
        if let Some(wire) = self.wire.take() {
            let patience = wire.node.patience.clone();
            sender::close(&patience, move || {
                let _ = thread.map(JoinHandle::join); // a panic has been reported
                drop(wire);
            });
        }
    }
}
