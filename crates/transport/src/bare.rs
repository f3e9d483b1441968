//! The middlewares used directly, as a reference for benchmarks of eddy's publishers and subscribers.

use std::time::Duration;

use super::{Link, TransportError, TransportKind, Transports};
use eddy_frames::Frame;

/// Publishes one message repeatedly.
pub trait BarePublisher: Send {
    /// Publishes the message.
    ///
    /// # Errors
    /// [`TransportError`] from the middleware.
    fn publish(&mut self) -> Result<(), TransportError>;
}

/// Receives messages without reading them.
pub trait BareSubscriber: Send {
    /// Whether a message arrived within `timeout`.
    ///
    /// # Errors
    /// [`TransportError`] from the middleware.
    fn receive(&mut self, timeout: Duration) -> Result<bool, TransportError>;
}

/// Publisher and subscriber with a session each, like two processes.
pub type BarePair = (Box<dyn BarePublisher>, Box<dyn BareSubscriber>);

impl Transports {
    /// The middleware of `link` with the bytes that eddy sends for `frame`; `None` without a reference. If not
    /// `touched`, messages in shared memory are sent without being written.
    ///
    /// # Errors
    /// [`TransportError`] when the middleware cannot be opened.
    pub fn bare(
        &self,
        link: &Link,
        frame: &Frame,
        touched: bool,
    ) -> Result<Option<BarePair>, TransportError> {
        match link.transport {
            TransportKind::Shm => super::shm::bare::pair(link, frame, touched).map(Some),
            TransportKind::Zenoh => super::zenoh::bare::pair(link, self.options(), frame).map(Some),
            TransportKind::Memory | TransportKind::Dds => Ok(None),
        }
    }

    /// eddy's publisher of frames of `particles` particles, without writing them; `None` if messages are not written
    /// in place.
    ///
    /// # Errors
    /// As [`Transports::publisher`].
    pub fn untouched(
        &self,
        link: &Link,
        particles: usize,
    ) -> Result<Option<Box<dyn BarePublisher>>, TransportError> {
        self.middleware(link)?.untouched(link, particles)
    }
}
