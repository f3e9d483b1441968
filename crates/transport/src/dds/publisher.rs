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
use eddy_frames::{Frame, clock::Clock};
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
    unacknowledged: Unacknowledged,
    /// Whether subscribers acknowledged nothing for as long as the patience lasts; they are not waited for then.
    is_stalled: bool,
    /// Subscribers that vanished before this was last checked.
    vanished: u64,
    /// Messages that a vanished subscriber may not have.
    abandoned: u64,
    /// Whether a message may not have been taken by its readers yet.
    lingers: bool,
    node: Arc<DdsNode>,
}

/// What was written since everything was acknowledged.
#[derive(Clone, Copy, Default)]
struct Unacknowledged {
    messages: u64,
    bytes: usize,
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
        let policies = Some(qos.policies(kept));
        let writer = node
            .graph
            .add_writer(link, || node.publisher.create_datawriter_no_key(&topic, policies))
            .map_err(|error| middleware(link, "create the publisher", &error))?;
        Ok(Self {
            link: link.clone(),
            type_name: support.name.clone(),
            qos,
            writer,
            unacknowledged: Unacknowledged::default(),
            is_stalled: false,
            vanished: 0,
            abandoned: 0,
            lingers: false,
            node: Arc::clone(node),
        })
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
        if self.qos != PublisherQos::Blocking {
            return match self.writer.write(body, Some(Timestamp::now())) {
                // A message that would have to wait is dropped.
                Ok(()) | Err(WriteError::WouldBlock { .. }) => Ok(()),
                Err(error) => Err(middleware(&self.link, "publish", &error)),
            };
        }
        let clock = Clock::start();
        let is_acknowledged = self.unacknowledged.bytes + size <= qos::MAX_UNACKNOWLEDGED
            || self.wait_for_acknowledgments(Duration::MAX)?;
        let is_written = self.write(body, clock)?;
        if is_written {
            self.unacknowledged.bytes += size;
            self.unacknowledged.messages += 1;
            self.lingers = true;
        }
        self.is_stalled = !(is_acknowledged && is_written);
        if self.is_stalled { Err(self.stalled()) } else { Ok(()) }
    }

    /// Writes a message; waits for room in the history as long as the patience of this message lasts. Returns whether it
    /// is written.
    fn write(&self, body: Body, clock: Clock) -> Result<bool, TransportError> {
        let patience = &self.node.patience;
        let mut waiting = body;
        loop {
            let is_over = self.is_stalled || patience.left(clock.now()).is_zero();
            match self.writer.write(waiting, Some(Timestamp::now())) {
                Ok(()) => return Ok(true),
                Err(WriteError::WouldBlock { .. }) if is_over => return Ok(false),
                Err(WriteError::WouldBlock { data }) => waiting = data,
                Err(error) => return Err(middleware(&self.link, "publish", &error)),
            }
        }
    }

    /// Waits until everything is acknowledged, at most for `limit` and as long as the patience lasts. Returns whether it
    /// is.
    fn wait_for_acknowledgments(&mut self, limit: Duration) -> Result<bool, TransportError> {
        let (writer, patience, clock) = (&self.writer, &self.node.patience, Clock::start());
        let acknowledged = |slice| match writer.wait_for_acknowledgments(slice) {
            Ok(false) if clock.now() >= limit => Some(Ok(false)),
            Ok(false) => None,
            outcome => Some(outcome),
        };
        let outcome = match self.is_stalled {
            true => writer.wait_for_acknowledgments(Duration::ZERO),
            false => patience.wait(acknowledged).unwrap_or(Ok(false)),
        };
        match outcome {
            Ok(true) => {
                let acknowledged = std::mem::take(&mut self.unacknowledged);
                // RustDDS does not wait for subscribers that have vanished, whatever they have received.
                // After a wait, its event may still be on the way.
                if clock.now() > DROP_TIMEOUT {
                    thread::sleep(LINGER);
                }
                let vanished = self.node.graph.vanished(self.writer.guid());
                if std::mem::replace(&mut self.vanished, vanished) < vanished {
                    self.abandoned += acknowledged.messages;
                }
                Ok(true)
            }
            Ok(false) => Ok(false),
            Err(error) => Err(middleware(&self.link, "publish", &error)),
        }
    }

    /// RustDDS does not say which subscriber it is.
    fn subscriber(&self) -> String {
        match self.subscribers() {
            1 => "the subscriber".to_owned(),
            several => format!("at least one of {several} subscribers"),
        }
    }

    fn stalled(&self) -> TransportError {
        TransportError::missed(&self.link, self.subscriber(), &self.node.patience)
    }

    fn flush_within(&mut self, limit: Duration) -> Result<(), TransportError> {
        let pending = self.unacknowledged.messages + self.abandoned;
        if self.qos != PublisherQos::Blocking || pending == 0 {
            return Ok(());
        }
        let clock = Clock::start();
        let is_acknowledged = self.wait_for_acknowledgments(limit)?;
        let abandoned = std::mem::take(&mut self.abandoned);
        if is_acknowledged && abandoned == 0 {
            return Ok(());
        }
        let missing = std::mem::take(&mut self.unacknowledged);
        let subscriber = match is_acknowledged {
            true => "a subscriber that has vanished".to_owned(),
            false => self.subscriber(),
        };
        Err(TransportError::Undelivered {
            link: self.link.clone(),
            subscriber,
            messages: missing.messages + abandoned,
            seconds: clock.now().as_secs_f64(),
        })
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

    fn flush(&mut self) -> Result<(), TransportError> {
        self.flush_within(Duration::MAX)
    }

    fn subscribers(&self) -> usize {
        self.node.graph.matched(self.writer.guid())
    }
}

impl Drop for DdsPublisher {
    /// Waits for acknowledgments, since lost messages cannot be repaired afterwards.
    fn drop(&mut self) {
        match self.flush_within(DROP_TIMEOUT) {
            // Nobody waits for a reader that was given up.
            Ok(()) if self.lingers => {
                thread::sleep(self.node.patience.left(Duration::ZERO).min(LINGER))
            }
            Ok(()) => {}
            Err(error) => tracing::warn!("{error}"),
        }
        self.node.graph.remove_writer(self.writer.guid());
    }
}
