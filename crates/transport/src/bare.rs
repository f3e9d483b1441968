//! Middlewares alone, used as directly as they can be: what eddy's own publishers and subscribers are
//! measured against.

use std::time::Duration;

use super::{Link, TransportError, TransportKind, Transports};
use eddy_frames::Frame;

/// Publishes one message again and again.
pub trait BarePublisher: Send {
    /// Publishes it once more.
    ///
    /// # Errors
    /// [`TransportError`] when the middleware refuses.
    fn publish(&mut self) -> Result<(), TransportError>;
}

/// Receives such messages, and looks at none.
pub trait BareSubscriber: Send {
    /// Whether a message came within `timeout`.
    ///
    /// # Errors
    /// [`TransportError`] when the middleware failed.
    fn receive(&mut self, timeout: Duration) -> Result<bool, TransportError>;
}

/// Both ends, as two processes would have them.
pub type BarePair = (Box<dyn BarePublisher>, Box<dyn BareSubscriber>);

impl Transports {
    /// The middleware of `link` alone, with the bytes that eddy would send for `frame`; `None` where there is
    /// nothing to compare with. If not `touched`, memory that is written in place is sent as it is.
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

    /// eddy's own publisher of frames of so many particles, which are not written; `None` where messages are
    /// not written in place.
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
