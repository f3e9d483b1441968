//! Waits for messages and lends them.

use std::{fmt::Debug, time::Duration};

use iceoryx2::{
    port::{
        ReceiveError,
        listener::{Listener, ListenerWaitError},
        subscriber,
    },
    prelude::*,
};

use super::{
    layout::{FrameHeader, SharedParticle},
    service::{Cleaner, Events, Ipc, Topic, middleware},
    shared_frame::{self, LoanCounter, SharedFrame},
};
use crate::{Link, Payload, Subscriber, TransportError};

/// Polling interval for publishers that do not send wake-ups.
const POLL: Duration = Duration::from_millis(100);
/// Time that a wake-up without a message takes off the timeout, so that a publisher that only sends wake-ups cannot
/// extend it forever.
const EMPTY_WAKE: Duration = Duration::from_millis(1);

/// The port that receives the messages of a service.
pub(super) type Port<P, H> = subscriber::Subscriber<Ipc, [P], H>;

/// Opens it.
pub(super) fn port<P, H>(link: &Link, topic: &Topic<P, H>) -> Result<Port<P, H>, TransportError>
where
    P: Debug + ZeroCopySend,
    H: Debug + ZeroCopySend,
{
    let port = topic.subscriber_builder().create();
    port.map_err(|error| middleware(link, "open the subscriber", &error))
}

/// Waits until a topic has a message.
pub(super) struct Wakes {
    link: Link,
    listener: Listener<Ipc>,
    _cleaner: Cleaner,
}

impl Wakes {
    pub(super) fn open(
        link: &Link,
        events: &Events,
        cleaner: Cleaner,
    ) -> Result<Self, TransportError> {
        let listener = events
            .listener_builder()
            .create()
            .map_err(|error| middleware(link, "open the listener", &error))?;
        Ok(Self { link: link.clone(), listener, _cleaner: cleaner })
    }

    /// The first message that `poll` finds.
    fn receive<T>(
        &self,
        timeout: Duration,
        mut poll: impl FnMut() -> Result<Option<T>, ReceiveError>,
    ) -> Result<Option<T>, TransportError> {
        let mut left = timeout;
        loop {
            // Before polling, so that any later wake-up means a new message.
            self.wait(Duration::ZERO)?;
            match poll() {
                Ok(Some(message)) => return Ok(Some(message)),
                Ok(None) => {}
                // A publisher was killed while it connected; the others are not affected.
                Err(error) => {
                    tracing::warn!(link = %self.link, %error, "cannot receive from a publisher")
                }
            }
            if left.is_zero() {
                return Ok(None);
            }
            let pause = left.min(POLL);
            let woken = self.wait(pause)?;
            left = left.saturating_sub(if woken { EMPTY_WAKE } else { pause });
        }
    }

    /// Waits for wake-ups, consumes all of them, and returns whether there was one.
    fn wait(&self, timeout: Duration) -> Result<bool, TransportError> {
        let waited = if timeout.is_zero() {
            self.listener.try_wait(|_| {})
        } else {
            self.listener.timed_wait(|_| {}, timeout)
        };
        match waited {
            Ok(wakes) => Ok(wakes > 0),
            // Return, so that the program can handle the signal.
            Err(ListenerWaitError::InterruptSignal) => Ok(false),
            Err(error) => Err(middleware(&self.link, "wait for messages", &error)),
        }
    }
}

/// Subscribes to a topic of frames.
pub(super) struct FrameSubscriber {
    wakes: Wakes,
    plane: Port<SharedParticle, FrameHeader>,
    space: Port<SharedParticle<3>, FrameHeader<3>>,
    /// Whether the next message is first looked for among frames of three dimensions: neither kind waits for the other.
    space_first: bool,
    loans: LoanCounter,
    /// Samples that may be lent out at the same time; one more is received and returned at once.
    lendable: usize,
}

impl FrameSubscriber {
    pub(super) fn new(
        wakes: Wakes,
        plane: Port<SharedParticle, FrameHeader>,
        space: Port<SharedParticle<3>, FrameHeader<3>>,
        borrowable: usize,
    ) -> Self {
        let lendable = borrowable.saturating_sub(1);
        let loans = LoanCounter::default();
        Self { wakes, plane, space, space_first: false, loans, lendable }
    }

    /// Lends the frame in place, or copies it while the largest number of samples is lent out, so that the publisher gets
    /// its memory back.
    fn in_plane(&self) -> Result<Option<Payload>, ReceiveError> {
        let sample = self.plane.receive()?;
        Ok(sample.map(|sample| match self.loans.lend(self.lendable) {
            Some(loan) => Payload::Shared(SharedFrame::new(sample, loan)),
            None => shared_frame::copy(&sample),
        }))
    }

    /// Nothing computes with frames of three dimensions yet: they are delivered as bytes.
    fn in_space(&self) -> Result<Option<Payload>, ReceiveError> {
        let sample = self.space.receive()?;
        Ok(sample.map(|sample| Payload::Cdr(shared_frame::to_cdr(&sample))))
    }
}

impl Subscriber for FrameSubscriber {
    /// Frames of one dimension are in the order in which they were sent.
    fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError> {
        let space_first = self.space_first;
        let received = self.wakes.receive(timeout, || {
            let first = if space_first { self.in_space() } else { self.in_plane() };
            match first? {
                None if space_first => self.in_plane(),
                None => self.in_space(),
                received => Ok(received),
            }
        });
        self.space_first = !space_first;
        received
    }

    /// 0: all messages are delivered, also those that are not valid frames.
    fn lost(&self) -> u64 {
        0
    }
}

/// Subscribes to a topic of any other type.
pub(super) struct BytesSubscriber {
    pub(super) wakes: Wakes,
    pub(super) subscriber: Port<u8, ()>,
}

impl Subscriber for BytesSubscriber {
    fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError> {
        let sample = self.wakes.receive(timeout, || self.subscriber.receive())?;
        Ok(sample.map(|sample| Payload::Cdr(sample.payload().to_vec())))
    }

    fn lost(&self) -> u64 {
        0
    }
}
