//! Writes messages into loaned memory, sends them, wakes the readers.

use std::{fmt::Debug, mem::MaybeUninit, thread, time::Duration};

use iceoryx2::{
    port::{BackpressureAction, LoanError, SendError, notifier::Notifier, publisher},
    prelude::*,
    sample_mut::SampleMut,
    sample_mut_uninit::SampleMutUninit,
};

use super::{
    layout::{self, FrameHeader, SharedParticle},
    service::{BORROWED, Cleaner, DEPTH, Events, Ipc, Topic, middleware},
};
use crate::{Link, Publisher, Reliability, TransportError, opener};
use eddy_frames::Frame;
use eddy_messages::FrameCdr;

/// Elements of a message there is room for at first; more room is made when a longer one comes.
const FIRST_LENGTH: usize = 2560;
/// Memory of a writer (bytes) that gives room for as many messages as all possible readers may hold. What
/// takes more has room for fewer of them.
const BUDGET: usize = 128 << 20;
/// Messages that there is room for, however large they are: more than one reader can hold that has stopped
/// reading.
const FEWEST: usize = DEPTH + BORROWED + 8;
/// Between two tries to send to a reader that is not there yet.
const PAUSE: Duration = Duration::from_millis(1);

/// Memory of a message that is to be written.
pub(super) type Loan<P, H> = SampleMutUninit<Ipc, [MaybeUninit<P>], H>;
/// A message that can be sent.
pub(super) type Written<P, H> = SampleMut<Ipc, [P], H>;

/// The writing side of one topic.
pub(super) struct Outlet<P, H>
where
    P: Debug + ZeroCopySend + 'static,
    H: Debug + ZeroCopySend + 'static,
{
    link: Link,
    topic: Topic<P, H>,
    /// Its memory is made when it is opened: messages that need more get another one.
    publisher: publisher::Publisher<Ipc, [P], H>,
    notifier: Notifier<Ipc>,
    reliability: Reliability,
    patience: Duration,
    /// Whether a reader that came late was told of.
    warned: bool,
    /// Whether it was said that there was no room.
    full: bool,
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
        let publisher = open_publisher(link, &topic, FIRST_LENGTH, reliability, patience)?;
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
            full: false,
            _cleaner: cleaner,
        };
        // Readers that wait connect now, before the first message.
        outlet.wake();
        Ok(outlet)
    }

    /// Sends `length` elements with a header, which `write` puts into loaned memory.
    ///
    /// A reader connects when it next looks for messages; until then it has a buffer, but is not
    /// waited for when that is full. A blocking publisher therefore sends again what nobody took. With
    /// several readers, one that is so late may miss messages that another one took; this is a warning.
    pub(super) fn send(
        &mut self,
        length: usize,
        header: H,
        write: impl Fn(Loan<P, H>) -> Written<P, H>,
    ) -> Result<(), TransportError>
    where
        H: Copy,
    {
        self.make_room(length)?;
        let tries = self.patience.div_duration_f64(PAUSE) as u64;
        for _ in 0..=tries {
            let Some(taken) = self.send_once(length, header, &write)? else {
                // Every message there is room for is with some reader.
                if self.reliability == Reliability::Drop {
                    if !std::mem::replace(&mut self.full, true) {
                        tracing::warn!(link = %self.link, "messages are given up: readers that do not read hold all there is room for");
                    }
                    return Ok(());
                }
                thread::sleep(PAUSE);
                continue;
            };
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

    /// Makes sure that there is room for messages of so many elements. What was sent before stays with
    /// readers that have looked for messages since this topic was opened; others miss it.
    fn make_room(&mut self, length: usize) -> Result<(), TransportError> {
        if length <= self.publisher.initial_max_slice_len() {
            return Ok(());
        }
        let Self { link, topic, reliability, patience, .. } = self;
        // Twice as much at least: a frame that grows by a particle now and then needs no new room each time.
        let room = length.next_power_of_two();
        self.publisher = open_publisher(link, topic, room, *reliability, *patience)?;
        tracing::info!(%link, elements = room, "made room for larger messages");
        Ok(())
    }

    /// Writes a message into loaned memory and sends it; how many readers took it. `None` when there is no
    /// memory to loan.
    fn send_once(
        &self,
        length: usize,
        header: H,
        write: impl Fn(Loan<P, H>) -> Written<P, H>,
    ) -> Result<Option<usize>, TransportError> {
        let mut loan = match self.publisher.loan_slice_uninit(length) {
            Ok(loan) => loan,
            Err(LoanError::OutOfMemory) => return Ok(None),
            Err(error) => return Err(middleware(&self.link, "loan memory", &error)),
        };
        *loan.user_header_mut() = header;
        write(loan).send().map(Some).map_err(|error| match error {
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
    length: usize,
    reliability: Reliability,
    patience: Duration,
) -> Result<publisher::Publisher<Ipc, [P], H>, TransportError>
where
    P: Debug + ZeroCopySend,
    H: Debug + ZeroCopySend,
{
    let builder = topic
        .publisher_builder()
        .initial_max_slice_len(length)
        // iceoryx2 grows by itself, too, but then for as many messages as ever: 6 GB for a million particles.
        .allocation_strategy(AllocationStrategy::Static)
        .override_sample_preallocation(move |all| {
            all.min((BUDGET / (length * size_of::<P>())).max(FEWEST))
        });
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
    pub(super) outlet: Outlet<SharedParticle, FrameHeader>,
}

impl Publisher for FramePublisher {
    fn publish_frame(&mut self, frame: &Frame) -> Result<(), TransportError> {
        self.outlet.send(frame.len(), frame.into(), |loan| {
            loan.write_from_fn(|index| layout::particle(frame, index))
        })
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
        self.outlet.send(bytes.len(), (), |loan| loan.write_from_slice(bytes))
    }

    fn subscribers(&self) -> usize {
        self.outlet.subscribers()
    }
}
