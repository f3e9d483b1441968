//! Publishes a topic.

use std::{num::NonZeroUsize, sync::Arc};

use zenoh::{Wait, bytes::ZBytes, liveliness::LivelinessToken, pubsub, qos::CongestionControl};

use super::{
    ZenohNode,
    attachment::Attachment,
    graph::{self, Graph},
    keys::Endpoint,
    middleware,
    transient_local::Kept,
};
use crate::{Link, Publisher, Reliability, TransportError, transports};
use eddy_frames::{Frame, clock};
use eddy_messages::FrameCdr;

pub(crate) struct ZenohPublisher {
    link: Link,
    type_name: String,
    publisher: pubsub::Publisher<'static>,
    /// For late-joining subscribers.
    kept: Option<Kept>,
    gid: [u8; 16],
    /// Sequence number of the last message; the first is 1.
    sequence: i64,
    graph: Graph,
    _token: LivelinessToken,
    /// Keeps the session open.
    node: Arc<ZenohNode>,
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
        Ok(Self { link, type_name, publisher, kept, gid, sequence: 0, graph, _token: token, node })
    }

    fn publish(&mut self, bytes: Vec<u8>) -> Result<(), TransportError> {
        self.sequence += 1;
        let attachment =
            Attachment { sequence: self.sequence, source_time: clock::wall().0, gid: self.gid };
        let attachment = attachment.to_bytes();
        let payload = ZBytes::from(bytes);
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

    /// The number of tokens of matching ROS subscribers, once messages reach a subscriber. Subscribers without a token,
    /// which are not ROS, count as one.
    fn subscribers(&self) -> usize {
        let reached = self.publisher.matching_status().wait();
        if reached.is_ok_and(|status| status.matching()) { self.graph.matching().max(1) } else { 0 }
    }
}
