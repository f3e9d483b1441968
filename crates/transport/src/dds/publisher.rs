//! Publishes one topic.

use std::{sync::Arc, thread, time::Duration};

use ros2_client::dds::rustdds::{RTPSEntity, Timestamp, dds::WriteError, no_key::DataWriter};

use super::{
    DdsNode,
    cdr::{AsItIs, Body},
    middleware,
    qos::{self, Promise},
};
use crate::{Link, Publisher, Reliability, TransportError, opener};
use eddy_frames::Frame;
use eddy_messages::{FrameCdr, TypeSupport};

/// How long the last messages are waited for when a publisher goes: a subscriber that was killed never has them.
const LAST_PATIENCE: Duration = Duration::from_secs(3);
/// How long a publisher stays when its last message has arrived: readers of RustDDS (0.15) forget what nobody has taken
/// from them yet when the writer goes, which a busy machine takes a while to do.
const FAREWELL: Duration = Duration::from_millis(250);

pub(crate) struct DdsPublisher {
    link: Link,
    type_name: String,
    promise: Promise,
    writer: DataWriter<Body, AsItIs>,
    /// Bytes written since everything had arrived.
    on_their_way: usize,
    node: Arc<DdsNode>,
}

impl DdsPublisher {
    pub(super) fn open(
        node: &Arc<DdsNode>,
        link: &Link,
        support: &TypeSupport,
        reliability: Reliability,
    ) -> Result<Self, TransportError> {
        let topic = node.topic(link, &support.name)?;
        let promise = Promise::of(reliability, &support.name);
        let writer = node
            .publisher
            .create_datawriter_no_key(&topic, Some(promise.qos(node.patience)))
            .map_err(|error| middleware(link, "create the publisher", &error))?;
        node.graph.add_writer(writer.guid());
        let (link, type_name) = (link.clone(), support.name.clone());
        Ok(Self { link, type_name, promise, writer, on_their_way: 0, node: Arc::clone(node) })
    }

    fn publish(&mut self, message: Vec<u8>) -> Result<(), TransportError> {
        let size = message.len();
        let (link, limit) = (&self.link, self.node.largest_message);
        if size > limit {
            return Err(TransportError::TooLarge { link: link.clone(), found: size, limit });
        }
        let body = Body::of(message).ok_or_else(|| {
            middleware(&self.link, "publish", &"expected plain little-endian CDR (00 01 00 00)")
        })?;
        if self.promise == Promise::Waits && self.on_their_way + size > qos::MAX_ON_THEIR_WAY {
            self.wait_until_arrived(self.node.patience)?;
        }
        match self.writer.write(body, Some(Timestamp::now())) {
            Ok(()) => self.on_their_way += size,
            Err(WriteError::WouldBlock { .. }) if self.promise == Promise::Waits => {
                return Err(self.stalled());
            }
            // Dropped, as promised.
            Err(WriteError::WouldBlock { .. }) => {}
            Err(error) => return Err(middleware(&self.link, "publish", &error)),
        }
        Ok(())
    }

    fn wait_until_arrived(&mut self, patience: Duration) -> Result<(), TransportError> {
        match self.writer.wait_for_acknowledgments(patience) {
            Ok(true) => {
                self.on_their_way = 0;
                Ok(())
            }
            Ok(false) => Err(self.stalled()),
            Err(error) => Err(middleware(&self.link, "publish", &error)),
        }
    }

    fn stalled(&self) -> TransportError {
        let seconds = self.node.patience.as_secs_f64();
        TransportError::Stalled { link: self.link.clone(), seconds }
    }
}

impl Publisher for DdsPublisher {
    fn publish_frame(&mut self, frame: &Frame) -> Result<(), TransportError> {
        opener::check_frames(&self.link, &self.type_name)?;
        self.publish(frame.to_cdr())
    }

    fn publish_cdr(&mut self, bytes: &[u8]) -> Result<(), TransportError> {
        self.publish(bytes.to_vec())
    }

    fn subscribers(&self) -> usize {
        self.node.graph.matched(self.writer.guid())
    }
}

impl Drop for DdsPublisher {
    /// What was sent must have arrived before it can no longer be repaired.
    fn drop(&mut self) {
        if self.promise == Promise::Waits && self.on_their_way > 0 {
            match self.wait_until_arrived(self.node.patience.min(LAST_PATIENCE)) {
                Ok(()) => thread::sleep(FAREWELL),
                Err(error) => tracing::warn!("{error}"),
            }
        }
        self.node.graph.remove_writer(self.writer.guid());
    }
}
