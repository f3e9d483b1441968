//! Waits for messages and lends them.

use std::{fmt::Debug, time::Duration};

use iceoryx2::{
    port::{
        listener::{Listener, ListenerWaitError},
        subscriber,
    },
    prelude::*,
    sample::Sample,
};

use super::{
    layout::{FrameHeader, SharedParticle},
    lent::{self, Ledger, SharedFrame},
    service::{Cleaner, Events, Ipc, Topic, middleware},
};
use crate::{Link, Payload, Subscriber, TransportError};

/// How often a reader looks for messages whose publisher does not wake it.
const POLL: Duration = Duration::from_millis(100);
/// What a wake-up without a message counts of the time to wait, so that a publisher that only
/// wakes cannot hold a reader for good.
const EMPTY_WAKE: Duration = Duration::from_millis(1);

/// The reading side of one topic.
pub(super) struct Inlet<P, H>
where
    P: Debug + ZeroCopySend + 'static,
    H: Debug + ZeroCopySend + 'static,
{
    link: Link,
    subscriber: subscriber::Subscriber<Ipc, [P], H>,
    listener: Listener<Ipc>,
    _cleaner: Cleaner,
}

impl<P, H> Inlet<P, H>
where
    P: Debug + ZeroCopySend,
    H: Debug + ZeroCopySend,
{
    pub(super) fn open(
        link: &Link,
        topic: &Topic<P, H>,
        events: &Events,
        cleaner: Cleaner,
    ) -> Result<Self, TransportError> {
        let listener = events
            .listener_builder()
            .create()
            .map_err(|error| middleware(link, "open the listener", &error))?;
        let subscriber = topic
            .subscriber_builder()
            .create()
            .map_err(|error| middleware(link, "open the subscriber", &error))?;
        Ok(Self { link: link.clone(), subscriber, listener, _cleaner: cleaner })
    }

    fn receive(&self, timeout: Duration) -> Result<Option<Sample<Ipc, [P], H>>, TransportError> {
        let mut left = timeout;
        loop {
            // Before the look at the buffer: a wake-up from now on means a message not yet seen.
            self.wait(Duration::ZERO)?;
            match self.subscriber.receive() {
                Ok(Some(sample)) => return Ok(Some(sample)),
                Ok(None) => {}
                // A publisher was killed while it connected; the others go on.
                Err(error) => {
                    tracing::warn!(link = %self.link, %error, "a publisher cannot be read")
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

    /// Waits for a wake-up and takes all there are; whether there was one.
    fn wait(&self, timeout: Duration) -> Result<bool, TransportError> {
        let waited = if timeout.is_zero() {
            self.listener.try_wait(|_| {})
        } else {
            self.listener.timed_wait(|_| {}, timeout)
        };
        match waited {
            Ok(wakes) => Ok(wakes > 0),
            // The program wants to look at the signal, not to wait on.
            Err(ListenerWaitError::InterruptSignal) => Ok(false),
            Err(error) => Err(middleware(&self.link, "wait for messages", &error)),
        }
    }
}

/// Reads a topic of frames.
pub(super) struct FrameSubscriber {
    inlet: Inlet<SharedParticle, FrameHeader>,
    ledger: Ledger,
    /// Samples that may be out at the same time; one more is read and given back at once.
    lendable: usize,
}

impl FrameSubscriber {
    pub(super) fn new(inlet: Inlet<SharedParticle, FrameHeader>, borrowable: usize) -> Self {
        Self { inlet, ledger: Ledger::default(), lendable: borrowable.saturating_sub(1) }
    }
}

impl Subscriber for FrameSubscriber {
    /// Lends the frame where it lies. While as many are out as the service allows, whoever keeps them is
    /// behind: then it is a copy, so that the publisher's memory comes back.
    fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError> {
        let Some(sample) = self.inlet.receive(timeout)? else { return Ok(None) };
        Ok(Some(match self.ledger.lend(self.lendable) {
            Some(loan) => Payload::Shared(SharedFrame::new(sample, loan)),
            None => lent::copy(&sample),
        }))
    }

    /// None: what other programs write is delivered, frame or not.
    fn refused(&self) -> u64 {
        0
    }
}

/// Reads a topic of any other type.
pub(super) struct BytesSubscriber {
    pub(super) inlet: Inlet<u8, ()>,
}

impl Subscriber for BytesSubscriber {
    fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError> {
        let sample = self.inlet.receive(timeout)?;
        Ok(sample.map(|sample| Payload::Cdr(sample.payload().to_vec())))
    }

    fn refused(&self) -> u64 {
        0
    }
}
