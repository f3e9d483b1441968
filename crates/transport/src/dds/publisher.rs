//! Publishes a topic.

use std::{num::NonZeroUsize, sync::Arc, thread, time::Duration};

use ros2_client::dds::rustdds::{RTPSEntity, Timestamp, dds::WriteError, no_key::DataWriter};

use super::{
    DdsNode,
    cdr::{Body, PassThrough},
    middleware,
    qos::{self, PublisherQos},
};
use crate::{Link, Publisher, Reliability, TransportError, transports};
use eddy_frames::Frame;
use eddy_messages::{FrameCdr, QosProfile, TypeSupport};

/// How long a dropped publisher waits for acknowledgments, which a killed subscriber never sends.
const DROP_TIMEOUT: Duration = Duration::from_secs(3);
/// How long a dropped publisher waits after the last acknowledgment: readers of RustDDS (0.15) discard messages that were
/// not taken yet when their writer disappears, and a busy machine may take a while to take them.
const LINGER: Duration = Duration::from_millis(250);

pub(crate) struct DdsPublisher {
    link: Link,
    type_name: String,
    qos: PublisherQos,
    writer: DataWriter<Body, PassThrough>,
    /// Bytes written since the last acknowledgment.
    unacknowledged: usize,
    node: Arc<DdsNode>,
}

impl DdsPublisher {
    pub(super) fn open(
        node: &Arc<DdsNode>,
        link: &Link,
        support: &TypeSupport,
        reliability: Reliability,
        offered: Option<QosProfile>,
    ) -> Result<Self, TransportError> {
        let topic = node.topic(link, &support.name)?;
        let qos = PublisherQos::of(reliability, &support.name, offered.as_ref());
        let kept = offered.and_then(|offered| NonZeroUsize::new(offered.kept()));
        let writer = node
            .publisher
            .create_datawriter_no_key(&topic, Some(qos.policies(node.patience, kept)))
            .map_err(|error| middleware(link, "create the publisher", &error))?;
        node.graph.add_writer(writer.guid());
        let (link, type_name) = (link.clone(), support.name.clone());
        Ok(Self { link, type_name, qos, writer, unacknowledged: 0, node: Arc::clone(node) })
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
        if self.qos == PublisherQos::Blocking
            && self.unacknowledged + size > qos::MAX_UNACKNOWLEDGED
        {
            self.wait_for_acknowledgments(self.node.patience)?;
        }
        match self.writer.write(body, Some(Timestamp::now())) {
            Ok(()) => self.unacknowledged += size,
            Err(WriteError::WouldBlock { .. }) if self.qos == PublisherQos::Blocking => {
                return Err(self.stalled());
            }
            // Dropped.
            Err(WriteError::WouldBlock { .. }) => {}
            Err(error) => return Err(middleware(&self.link, "publish", &error)),
        }
        Ok(())
    }

    fn wait_for_acknowledgments(&mut self, patience: Duration) -> Result<(), TransportError> {
        match self.writer.wait_for_acknowledgments(patience) {
            Ok(true) => {
                self.unacknowledged = 0;
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
        transports::check_frames(&self.link, &self.type_name)?;
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
    /// Waits for acknowledgments, since lost messages cannot be repaired afterwards.
    fn drop(&mut self) {
        if self.qos == PublisherQos::Blocking && self.unacknowledged > 0 {
            match self.wait_for_acknowledgments(self.node.patience.min(DROP_TIMEOUT)) {
                Ok(()) => thread::sleep(LINGER),
                Err(error) => tracing::warn!("{error}"),
            }
        }
        self.node.graph.remove_writer(self.writer.guid());
    }
}
