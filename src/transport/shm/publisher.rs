//! Writes messages into loaned memory, sends them, wakes the readers.

use std::{
    fmt::Debug,
    mem::MaybeUninit,
    thread,
    time::Duration,
};

use iceoryx2::{
    port::{BackpressureAction, LoanError, SendError, notifier::Notifier, publisher},
    prelude::*,
    sample_mut_uninit::SampleMutUninit,
};

use super::{
    layout::{self, FrameHeader, Particle},
    service::{DEPTH, Events, Ipc, Topic, middleware},
};
use crate::{
    frame::Frame,
    transport::{Link, Publisher, Reliability, TransportError, opener},
};

/// Messages in memory at once: a full reader's, and as many again by half for the others. Readers
/// share messages, so this does not grow with their number. Memory is taken (and zeroed) for
/// all of them when the publisher opens: 4.9 MB for 2,500 particles.
const SLOTS: usize = DEPTH + DEPTH / 2;
/// Elements of a message there is room for at first.
const FIRST_LENGTH: usize = 2560;
/// Between two looks at whether a slot came free.
const PAUSE: Duration = Duration::from_millis(1);

type Loan<P, H> = SampleMutUninit<Ipc, [MaybeUninit<P>], H>;

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
        reliability: Reliability,
        patience: Duration,
    ) -> Result<Self, TransportError> {
        if reliability == Reliability::Block && topic.static_config().has_safe_overflow() {
            tracing::warn!(
                %link,
                "found a service made by another program with overflow: slow readers lose the oldest messages"
            );
        }
        let publisher = open_publisher(link, &topic, reliability, patience, FIRST_LENGTH)?;
        let notifier = events
            .notifier_builder()
            .default_event_id(EventId::new(0))
            .create()
            .map_err(|error| middleware(link, "open the notifier", &error))?;
        Ok(Self { link: link.clone(), topic, publisher, notifier, reliability, patience })
    }

    /// Sends `length` elements with a header.
    fn send(
        &mut self,
        length: usize,
        header: H,
        element: impl FnMut(usize) -> P,
    ) -> Result<(), TransportError> {
        let Some(mut loan) = self.loan(length)? else {
            return match self.reliability {
                Reliability::Drop => Ok(()),
                Reliability::Block => Err(self.stalled()),
            };
        };
        *loan.user_header_mut() = header;
        match loan.write_from_fn(element).send() {
            Ok(_) => {}
            Err(SendError::UnableToDeliver) => return Err(self.stalled()),
            Err(error) => return Err(middleware(&self.link, "send", &error)),
        }
        // Readers also poll: a wake-up that fails costs them time, not messages.
        if let Err(error) = self.notifier.notify() {
            tracing::debug!(link = %self.link, ?error, "readers were not woken");
        }
        Ok(())
    }

    /// Room for a message, or `None` when readers hold all there is.
    fn loan(&mut self, length: usize) -> Result<Option<Loan<P, H>>, TransportError> {
        if length > self.publisher.initial_max_slice_len() {
            // What was sent stays readable after its publisher is gone.
            let room = length.next_power_of_two();
            self.publisher =
                open_publisher(&self.link, &self.topic, self.reliability, self.patience, room)?;
        }
        let pauses = match self.reliability {
            Reliability::Drop => 0,
            Reliability::Block => self.patience.div_duration_f64(PAUSE) as u64,
        };
        for pause in 0..=pauses {
            match self.publisher.loan_slice_uninit(length) {
                Ok(loan) => return Ok(Some(loan)),
                Err(LoanError::OutOfMemory) if pause < pauses => thread::sleep(PAUSE),
                Err(LoanError::OutOfMemory) => {}
                Err(error) => return Err(middleware(&self.link, "loan memory", &error)),
            }
        }
        Ok(None)
    }

    fn stalled(&self) -> TransportError {
        TransportError::Stalled { link: self.link.clone(), seconds: self.patience.as_secs_f64() }
    }

    fn subscribers(&self) -> usize {
        self.topic.dynamic_config().number_of_subscribers()
    }
}

/// A static pool of [`SLOTS`]: iceoryx2 would by itself reserve the worst case, one buffer a reader.
/// (Its growing pools need that worst case: they count messages in tables of the first size.)
fn open_publisher<P, H>(
    link: &Link,
    topic: &Topic<P, H>,
    reliability: Reliability,
    patience: Duration,
    length: usize,
) -> Result<publisher::Publisher<Ipc, [P], H>, TransportError>
where
    P: Debug + ZeroCopySend,
    H: Debug + ZeroCopySend,
{
    let builder = topic
        .publisher_builder()
        .initial_max_slice_len(length)
        .allocation_strategy(AllocationStrategy::Static)
        .override_sample_preallocation(|worst| worst.min(SLOTS));
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
        let frame = Frame::from_cdr(bytes).map_err(|reason| TransportError::Frame {
            link: self.outlet.link.clone(),
            reason,
        })?;
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
