//! What [`Transports`](super::Transports) asks of each middleware.

use std::{num::NonZeroUsize, sync::Arc};

use super::{Handler, Link, Publisher, Reliability, SeenTopic, Served, Subscriber, TransportError};
use eddy_messages::TypeSupport;

/// A middleware that is open in this process.
pub(crate) trait Middleware: Send + Sync {
    /// A publisher; `kept` messages are kept for later subscribers where the middleware can.
    fn publisher(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
        reliability: Reliability,
        kept: Option<NonZeroUsize>,
    ) -> Result<Box<dyn Publisher>, TransportError>;

    /// A subscriber.
    fn subscriber(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
    ) -> Result<Box<dyn Subscriber>, TransportError>;

    /// A service; `None` where the middleware has none.
    fn service(
        self: Arc<Self>,
        _link: &Link,
        _type_name: &str,
        _handler: Handler,
    ) -> Result<Option<Box<dyn Served>>, TransportError> {
        Ok(None)
    }

    /// The topics it knows of. Errors name `link`.
    fn topics(&self, _link: &Link) -> Result<Vec<SeenTopic>, TransportError> {
        Ok(Vec::new())
    }

    /// The memory that publishers share on a topic; `None` where nothing is shared.
    #[cfg(feature = "shm")]
    fn shared_memory(
        &self,
        _link: &Link,
        _type_name: &str,
    ) -> Result<Option<super::SharedMemory>, TransportError> {
        Ok(None)
    }

    /// A publisher of frames that are not written; `None` where messages are not written in place.
    #[cfg(feature = "lab")]
    fn untouched(
        &self,
        _link: &Link,
        _particles: usize,
    ) -> Result<Option<Box<dyn super::BarePublisher>>, TransportError> {
        Ok(None)
    }
}
