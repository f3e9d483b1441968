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
    service::{Cleaner, Events, Ipc, Topic, middleware},
    shared_frame::{self, LoanCounter, SharedFrame},
};
use crate::{Link, Payload, Subscriber, TransportError};

/// Polling interval for publishers that do not send wake-ups.
const POLL: Duration = Duration::from_millis(100);
/// Time that a wake-up without a message takes off the timeout, so that a publisher that only sends wake-ups cannot
/// extend it forever.
const EMPTY_WAKE: Duration = Duration::from_millis(1);

/// Receives the messages of a topic.
pub(super) struct Reader<P, H>
where
    P: Debug + ZeroCopySend + 'static,
    H: Debug + ZeroCopySend + 'static,
{
    link: Link,
    subscriber: subscriber::Subscriber<Ipc, [P], H>,
    listener: Listener<Ipc>,
    _cleaner: Cleaner,
}

impl<P, H> Reader<P, H>
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
            // Before polling, so that any later wake-up means a new message.
            self.wait(Duration::ZERO)?;
            match self.subscriber.receive() {
                Ok(Some(sample)) => return Ok(Some(sample)),
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
    reader: Reader<SharedParticle, FrameHeader>,
    loans: LoanCounter,
    /// Samples that may be lent out at the same time; one more is received and returned at once.
    lendable: usize,
}

impl FrameSubscriber {
    pub(super) fn new(reader: Reader<SharedParticle, FrameHeader>, borrowable: usize) -> Self {
        Self { reader, loans: LoanCounter::default(), lendable: borrowable.saturating_sub(1) }
    }
}

impl Subscriber for FrameSubscriber {
    /// Lends the frame in place, or copies it while the largest number of samples is lent out, so that the publisher gets
    /// its memory back.
    fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError> {
        let Some(sample) = self.reader.receive(timeout)? else { return Ok(None) };
        Ok(Some(match self.loans.lend(self.lendable) {
            Some(loan) => Payload::Shared(SharedFrame::new(sample, loan)),
            None => shared_frame::copy(&sample),
        }))
    }

    /// 0: all messages are delivered, also those that are not valid frames.
    fn lost(&self) -> u64 {
        0
    }
}

/// Subscribes to a topic of any other type.
pub(super) struct BytesSubscriber {
    pub(super) reader: Reader<u8, ()>,
}

impl Subscriber for BytesSubscriber {
    fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError> {
        let sample = self.reader.receive(timeout)?;
        Ok(sample.map(|sample| Payload::Cdr(sample.payload().to_vec())))
    }

    fn lost(&self) -> u64 {
        0
    }
}
