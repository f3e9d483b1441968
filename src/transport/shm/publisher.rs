//! Writes messages into loaned memory, sends them, wakes the readers.

use std::{fmt::Debug, thread, time::Duration};

use iceoryx2::{
    port::{BackpressureAction, SendError, notifier::Notifier, publisher},
    prelude::*,
};

use super::{
    layout::{self, FrameHeader, Particle},
    service::{Cleaner, Events, Ipc, Topic, middleware},
};
use crate::{
    frame::Frame,
    transport::{Link, Publisher, Reliability, TransportError, opener},
};

/// Elements of a message there is room for at first; more room is made when a longer one comes.
const FIRST_LENGTH: usize = 2560;
/// Between two tries to send to a reader that is not there yet.
const PAUSE: Duration = Duration::from_millis(1);

/// The writing side of one topic.
pub(super) struct Outlet<P, H>
where
    P: Debug + ZeroCopySend + 'static,
    H: Debug + ZeroCopySend + 'static,
{
    link: Link,
    topic: Topic<P, H>,
    publisher: publisher::Publisher<Ipc, [P], H>,
    notifier: Notifier<Ipc>,
    reliability: Reliability,
    patience: Duration,
    /// Whether a reader that came late was told of.
    warned: bool,
    _cleaner: Cleaner,
}

impl<P, H> Outlet<P, H>
where
    P: Debug + ZeroCopySend,
    H: Debug + Default + ZeroCopySend,
{
    pub(super) fn open(
        link: &Link,
        topic: Topic<P, H>,
        events: &Events,
        cleaner: Cleaner,
        reliability: Reliability,
        patience: Duration,
    ) -> Result<Self, TransportError> {
        if reliability == Reliability::Block && topic.static_config().has_safe_overflow() {
            tracing::warn!(
                %link,
                "found a service made by another program with overflow: slow readers lose the oldest messages"
            );
        }
        let publisher = open_publisher(link, &topic, reliability, patience)?;
        let notifier = events
            .notifier_builder()
            .default_event_id(EventId::new(0))
            .create()
            .map_err(|error| middleware(link, "open the notifier", &error))?;
        let outlet = Self {
            link: link.clone(),
            topic,
            publisher,
            notifier,
            reliability,
            patience,
            warned: false,
            _cleaner: cleaner,
        };
        // Readers that wait connect now, before the first message.
        outlet.wake();
        Ok(outlet)
    }

    /// Sends `length` elements with a header.
    ///
    /// A reader connects when it next looks for messages; until then it has a buffer, but is not
    /// waited for when that is full. A blocking publisher therefore sends again what nobody took. With
    /// several readers, one that is so late may miss messages that another one took; this is a warning.
    fn send(
        &mut self,
        length: usize,
        header: H,
        element: impl Fn(usize) -> P,
    ) -> Result<(), TransportError>
    where
        H: Copy,
    {
        let tries = self.patience.div_duration_f64(PAUSE) as u64;
        for _ in 0..=tries {
            let taken = self.send_once(length, header, &element)?;
            self.wake();
            let readers = self.subscribers();
            if self.reliability == Reliability::Drop || taken >= readers {
                return Ok(());
            }
            if taken > 0 {
                if !std::mem::replace(&mut self.warned, true) {
                    tracing::warn!(link = %self.link, taken, readers, "a reader that does not read yet misses messages");
                }
                return Ok(());
            }
            thread::sleep(PAUSE);
        }
        Err(self.stalled())
    }

    /// Sends a message; how many readers took it.
    fn send_once(
        &self,
        length: usize,
        header: H,
        element: impl Fn(usize) -> P,
    ) -> Result<usize, TransportError> {
        let mut loan = self
            .publisher
            .loan_slice_uninit(length)
            .map_err(|error| middleware(&self.link, "loan memory", &error))?;
        *loan.user_header_mut() = header;
        loan.write_from_fn(element).send().map_err(|error| match error {
            SendError::UnableToDeliver => self.stalled(),
            error => middleware(&self.link, "send", &error),
        })
    }

    /// Readers also poll: a wake-up that fails costs them time, not messages.
    fn wake(&self) {
        if let Err(error) = self.notifier.notify() {
            tracing::debug!(link = %self.link, ?error, "readers were not woken");
        }
    }

    fn stalled(&self) -> TransportError {
        TransportError::Stalled { link: self.link.clone(), seconds: self.patience.as_secs_f64() }
    }

    fn subscribers(&self) -> usize {
        self.topic.dynamic_config().number_of_subscribers()
    }
}

fn open_publisher<P, H>(
    link: &Link,
    topic: &Topic<P, H>,
    reliability: Reliability,
    patience: Duration,
) -> Result<publisher::Publisher<Ipc, [P], H>, TransportError>
where
    P: Debug + ZeroCopySend,
    H: Debug + ZeroCopySend,
{
    let builder = topic
        .publisher_builder()
        .initial_max_slice_len(FIRST_LENGTH)
        .allocation_strategy(AllocationStrategy::PowerOfTwo);
    let builder = match reliability {
        Reliability::Drop => builder.backpressure_strategy(BackpressureStrategy::DiscardData),
        Reliability::Block => builder
            .backpressure_strategy(BackpressureStrategy::RetryUntilDelivered)
            .set_backpressure_handler(move |full| {
                if full.elapsed_time < patience {
                    BackpressureAction::Retry
                } else {
                    BackpressureAction::DiscardDataAndFail
                }
            }),
    };
    builder.create().map_err(|error| middleware(link, "open the publisher", &error))
}

/// Publishes a topic of frames.
pub(super) struct FramePublisher {
    pub(super) outlet: Outlet<Particle, FrameHeader>,
}

impl Publisher for FramePublisher {
    fn publish_frame(&mut self, frame: &Frame) -> Result<(), TransportError> {
        self.outlet.send(frame.len(), frame.into(), |index| layout::particle(frame, index))
    }

    fn publish_cdr(&mut self, bytes: &[u8]) -> Result<(), TransportError> {
        let frame = Frame::from_cdr(bytes)
            .map_err(|reason| TransportError::Frame { link: self.outlet.link.clone(), reason })?;
        self.publish_frame(&frame)
    }

    fn subscribers(&self) -> usize {
        self.outlet.subscribers()
    }
}

/// Publishes a topic of any other type.
pub(super) struct BytesPublisher {
    pub(super) outlet: Outlet<u8, ()>,
    pub(super) type_name: String,
}

impl Publisher for BytesPublisher {
    fn publish_frame(&mut self, _: &Frame) -> Result<(), TransportError> {
        opener::check_frames(&self.outlet.link, &self.type_name)
    }

    fn publish_cdr(&mut self, bytes: &[u8]) -> Result<(), TransportError> {
        self.outlet.send(bytes.len(), (), |index| bytes[index])
    }

    fn subscribers(&self) -> usize {
        self.outlet.subscribers()
    }
}
