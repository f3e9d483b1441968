//! Writes messages into loaned memory, sends them and wakes the subscribers.

use std::{collections::BTreeSet, fmt::Debug, mem::MaybeUninit, sync::Arc, thread, time::Duration};

use iceoryx2::{
    port::{LoanError, SendError, notifier::Notifier, publisher},
    prelude::*,
    sample_mut::SampleMut,
    sample_mut_uninit::SampleMutUninit,
};

use super::{
    ShmNode,
    backpressure::GivenUp,
    layout::{self, FrameHeader, SharedParticle},
    service::{BORROWED, Cleaner, DEPTH, Events, Ipc, Topic, middleware},
};
use crate::{Link, Publisher, Reliability, TransportError, patience::Patience, transports};
use eddy_frames::{AnyFrame, Frame, clock::Clock};
use eddy_messages::FrameCdr;

/// Initial capacity of a message (elements); grows with longer messages.
const FIRST_LENGTH: usize = 2560;
/// Memory budget of a publisher (bytes). If as many messages as all possible subscribers may hold exceed it, memory for
/// fewer messages is allocated.
const BUDGET: usize = 128 << 20;
/// Smallest number of messages for which memory is allocated: more than one subscriber holds that has stopped
/// receiving.
const MIN_MESSAGES: usize = DEPTH + BORROWED + 8;
/// Interval between attempts to send.
const RETRY_INTERVAL: Duration = Duration::from_millis(1);
/// How long a message is there at the end of a program: longer than subscribers take to poll, also on a busy machine. One that has not
/// polled since a publisher came gets nothing once the publisher is gone.
const LINGER: Duration = Duration::from_millis(250);
/// How long the first frame of three dimensions waits: twice as long as subscribers take to poll.
const CONNECTING: Duration = Duration::from_millis(200);

/// Memory of a message to be written.
pub(super) type Loan<P, H> = SampleMutUninit<Ipc, [MaybeUninit<P>], H>;
/// A message to be sent.
pub(super) type Written<P, H> = SampleMut<Ipc, [P], H>;

/// Sends the messages of a topic.
pub(super) struct Writer<P, H>
where
    P: Debug + ZeroCopySend + 'static,
    H: Debug + ZeroCopySend + 'static,
{
    link: Link,
    topic: Topic<P, H>,
    /// Allocates its memory when it is opened; replaced for larger messages.
    publisher: publisher::Publisher<Ipc, [P], H>,
    notifier: Notifier<Ipc>,
    reliability: Reliability,
    patience: Patience,
    /// Subscribers that are not waited for.
    given_up: GivenUp,
    /// Runs since the last message.
    sent: Option<Clock>,
    /// Whether nobody received the last message although it was waited for.
    is_stalled: bool,
    /// Whether a missed message was logged.
    warned_missed: bool,
    /// Whether a dropped message was logged.
    warned_dropped: bool,
    _cleaner: Cleaner,
}

impl<P, H> Writer<P, H>
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
        patience: Patience,
    ) -> Result<Self, TransportError> {
        if reliability == Reliability::Block && topic.static_config().has_safe_overflow() {
            tracing::warn!(
                %link,
                "the service was created by another program with overflow; slow subscribers lose the oldest messages"
            );
        }
        let given_up = GivenUp::default();
        let publisher =
            open_publisher(link, &topic, FIRST_LENGTH, reliability, &patience, &given_up)?;
        let notifier = events
            .notifier_builder()
            .default_event_id(EventId::new(0))
            .create()
            .map_err(|error| middleware(link, "open the notifier", &error))?;
        let writer = Self {
            link: link.clone(),
            topic,
            publisher,
            notifier,
            reliability,
            patience,
            given_up,
            sent: None,
            is_stalled: false,
            warned_missed: false,
            warned_dropped: false,
            _cleaner: cleaner,
        };
        // Waiting subscribers connect now, before the first message.
        writer.wake();
        Ok(writer)
    }

    /// Sends `length` elements with a header; `write` writes them into loaned memory.
    ///
    /// A subscriber connects when it next polls for messages. Until then its full buffer does not block a publisher, so
    /// a blocking publisher repeats a message that no subscriber received. With several subscribers, one that has not
    /// connected yet may miss messages that another one received; this is logged.
    ///
    /// A subscriber that reads nothing for as long as the patience lasts misses the message and the following ones,
    /// without being waited for, until it reads again. The others get them.
    pub(super) fn send(
        &mut self,
        length: usize,
        header: H,
        write: impl Fn(Loan<P, H>) -> Written<P, H>,
    ) -> Result<(), TransportError>
    where
        H: Copy,
    {
        self.reserve(length)?;
        let clock = Clock::start();
        self.sent = Some(clock);
        loop {
            let received = self.send_once(length, header, &write)?;
            let missed = self.given_up.end();
            if received.is_some() || !missed.is_empty() {
                self.wake();
            }
            if self.reliability == Reliability::Drop {
                // Without memory, subscribers hold all messages.
                if received.is_none() && !std::mem::replace(&mut self.warned_dropped, true) {
                    tracing::warn!(link = %self.link, "dropping messages: subscribers that do not receive hold all memory");
                }
                return Ok(());
            }
            if !missed.is_empty() {
                return Err(self.missed(&missed));
            }
            let subscribers = self.subscribers();
            if received.is_some_and(|received| received > 0 || subscribers == 0) {
                self.is_stalled = false;
                self.warn_missed(received.unwrap_or_default(), subscribers);
                return Ok(());
            }
            if self.is_stalled || self.patience.left(clock.now()).is_zero() {
                self.is_stalled = true;
                return Err(self.missed(&BTreeSet::new()));
            }
            thread::sleep(RETRY_INTERVAL);
        }
    }

    /// Waits until the last message was there for [`LINGER`].
    fn flush(&self) {
        let Some(sent) = &self.sent else { return };
        if self.subscribers() > 0 {
            let left = LINGER.saturating_sub(sent.now());
            thread::sleep(self.patience.left(Duration::ZERO).min(left));
        }
    }

    /// Warns once if some subscribers have not connected yet.
    fn warn_missed(&mut self, received: usize, subscribers: usize) {
        if received < subscribers && !std::mem::replace(&mut self.warned_missed, true) {
            tracing::warn!(link = %self.link, received, subscribers, "a subscriber that has not connected yet misses messages");
        }
    }

    /// Ensures a capacity of `length` elements. Messages sent before remain with the connected subscribers; others miss
    /// them.
    fn reserve(&mut self, length: usize) -> Result<(), TransportError> {
        if length <= self.publisher.initial_max_slice_len() {
            return Ok(());
        }
        let Self { link, topic, reliability, patience, given_up, .. } = self;
        // At least doubled, so that a growing frame does not need new memory each time.
        let capacity = length.next_power_of_two();
        self.publisher = open_publisher(link, topic, capacity, *reliability, patience, given_up)?;
        tracing::info!(%link, elements = capacity, "allocated memory for larger messages");
        Ok(())
    }

    /// Writes a message into loaned memory, sends it, and returns the number of subscribers that received it; `None`
    /// without free memory, or if a signal interrupted the only delivery.
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
        match write(loan).send() {
            Ok(received) => Ok(Some(received)),
            // A signal interrupted the wait for a full buffer. If nobody else has the message, it can be sent again.
            Err(SendError::InternalError) if self.reliability == Reliability::Block => {
                if self.subscribers() > 1 {
                    self.given_up.interrupt();
                }
                Ok(None)
            }
            Err(error) => Err(middleware(&self.link, "send", &error)),
        }
    }

    /// Subscribers also poll: a failed wake-up delays messages but does not lose them.
    fn wake(&self) {
        if let Err(error) = self.notifier.notify() {
            tracing::debug!(link = %self.link, ?error, "cannot wake subscribers");
        }
    }

    /// The error for a message that the subscribers with these ports missed; all if none is known.
    fn missed(&self, ports: &BTreeSet<u128>) -> TransportError {
        let mut processes = BTreeSet::new();
        self.topic.dynamic_config().list_subscribers(|subscriber| {
            if ports.is_empty() || ports.contains(&subscriber.subscriber_id.value()) {
                processes.extend(subscriber.node_id.pid::<Ipc>().map(|process| process.value()));
            }
            CallbackProgression::Continue
        });
        let processes: Vec<_> = processes.iter().map(ToString::to_string).collect();
        let subscriber = match &processes[..] {
            [] => "a subscriber".to_owned(),
            [one] => format!("the subscriber in process {one}"),
            several => format!("subscribers in processes {}", several.join(", ")),
        };
        TransportError::missed(&self.link, subscriber, &self.patience)
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
    patience: &Patience,
    given_up: &GivenUp,
) -> Result<publisher::Publisher<Ipc, [P], H>, TransportError>
where
    P: Debug + ZeroCopySend,
    H: Debug + ZeroCopySend,
{
    let builder = topic
        .publisher_builder()
        .initial_max_slice_len(length)
        // iceoryx2 can grow memory itself, but for the full number of messages: 6 GB for a million particles.
        .allocation_strategy(AllocationStrategy::Static)
        .override_sample_preallocation(move |all| {
            all.min((BUDGET / (length * size_of::<P>())).max(MIN_MESSAGES))
        });
    let builder = match reliability {
        Reliability::Drop => builder.backpressure_strategy(BackpressureStrategy::DiscardData),
        Reliability::Block => {
            let (patience, given_up) = (patience.clone(), given_up.clone());
            builder
                .backpressure_strategy(BackpressureStrategy::RetryUntilDelivered)
                .set_backpressure_handler(move |full| given_up.on_full(full, &patience))
        }
    };
    builder.create().map_err(|error| middleware(link, "open the publisher", &error))
}

/// Publishes a topic of frames: those of two dimensions from the start, those of three once there is one.
pub(super) struct FramePublisher {
    pub(super) node: Arc<ShmNode>,
    pub(super) reliability: Reliability,
    pub(super) plane: Writer<SharedParticle, FrameHeader>,
    pub(super) space: Option<Writer<SharedParticle<3>, FrameHeader<3>>>,
}

impl FramePublisher {
    fn publish_in_space(&mut self, frame: &Frame<3>) -> Result<(), TransportError> {
        if self.space.is_none() {
            let (link, services) = (&self.plane.link, &self.node.services);
            let (topic, events) = (services.space(link)?, services.events(link)?);
            let (cleaner, patience) = (services.cleaner(), self.plane.patience.clone());
            let mut writer =
                Writer::open(link, topic, &events, cleaner, self.reliability, patience)?;
            writer.reserve(frame.len())?;
            if self.reliability == Reliability::Block && writer.subscribers() > 0 {
                // Until they have polled, and are connected: the first frame is sent at once.
                writer.wake();
                thread::sleep(writer.patience.left(Duration::ZERO).min(CONNECTING));
            }
            let (readers, all) = (writer.subscribers(), self.plane.subscribers());
            if readers < all {
                tracing::warn!(
                    %link, readers, subscribers = all,
                    "a subscriber reads frames of two dimensions only, and misses these of three"
                );
            }
            self.space = Some(writer);
        }
        match &mut self.space {
            Some(writer) => send(writer, frame),
            None => Ok(()),
        }
    }
}

/// Sends a frame.
fn send<const D: usize>(
    writer: &mut Writer<SharedParticle<D>, FrameHeader<D>>,
    frame: &Frame<D>,
) -> Result<(), TransportError>
where
    SharedParticle<D>: ZeroCopySend,
    FrameHeader<D>: ZeroCopySend,
{
    writer.send(frame.len(), frame.into(), |loan| {
        loan.write_from_fn(|index| layout::particle(frame, index))
    })
}

impl Publisher for FramePublisher {
    fn publish_frame(&mut self, frame: &Frame) -> Result<(), TransportError> {
        send(&mut self.plane, frame)
    }

    fn publish_cdr(&mut self, bytes: &[u8]) -> Result<(), TransportError> {
        let link = || self.plane.link.clone();
        let frame = AnyFrame::from_cdr(bytes);
        match frame.map_err(|reason| TransportError::Frame { link: link(), reason })? {
            AnyFrame::Two(frame) => self.publish_frame(&frame),
            AnyFrame::Three(frame) => self.publish_in_space(&frame),
        }
    }

    fn flush(&mut self) -> Result<(), TransportError> {
        self.plane.flush();
        self.space.iter().for_each(Writer::flush);
        Ok(())
    }

    /// A subscriber of eddy reads both.
    fn subscribers(&self) -> usize {
        self.plane.subscribers()
    }
}

/// Publishes a topic of any other type.
pub(super) struct BytesPublisher {
    pub(super) writer: Writer<u8, ()>,
    pub(super) type_name: String,
}

impl Publisher for BytesPublisher {
    fn publish_frame(&mut self, _: &Frame) -> Result<(), TransportError> {
        transports::check_frames(&self.writer.link, &self.type_name)
    }

    fn publish_cdr(&mut self, bytes: &[u8]) -> Result<(), TransportError> {
        self.writer.send(bytes.len(), (), |loan| loan.write_from_slice(bytes))
    }

    fn flush(&mut self) -> Result<(), TransportError> {
        self.writer.flush();
        Ok(())
    }

    fn subscribers(&self) -> usize {
        self.writer.subscribers()
    }
}
