//! The trait that [`Transports`](super::Transports) uses for each middleware.

use std::{sync::Arc, time::Duration};

use super::{
    Handler, Link, Membership, Publisher, Reliability, SeenService, SeenTopic, Served, Subscriber,
    TransportError,
};
use eddy_messages::{QosProfile, TypeSupport};

/// An open middleware.
pub(crate) trait Middleware: Send + Sync {
    /// A publisher that announces `offered`, if the middleware has QoS; what follows from `reliability` if `None`.
    fn publisher(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
        reliability: Reliability,
        offered: Option<QosProfile>,
    ) -> Result<Box<dyn Publisher>, TransportError>;

    /// A subscriber that requests `requested`, if the middleware has QoS; what suits the publishers if `None`.
    fn subscriber(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
        requested: Option<QosProfile>,
    ) -> Result<Box<dyn Subscriber>, TransportError>;

    /// A service; `None` if the middleware has no services.
    fn service(
        self: Arc<Self>,
        _link: &Link,
        _type_name: &str,
        _handler: Handler,
    ) -> Result<Option<Box<dyn Served>>, TransportError> {
        Ok(None)
    }

    /// Asks the publishers of a topic for the definition of its type; the answers are CDR bytes of
    /// `type_description_interfaces/srv/GetTypeDescription_Response`. Empty if the middleware has no services.
    fn describe(
        &self,
        _topic: &SeenTopic,
        _request: &[u8],
        _timeout: Duration,
    ) -> Result<Vec<Vec<u8>>, TransportError> {
        Ok(Vec::new())
    }

    /// Sends a request to a service. `None` if nobody answers within `timeout`, or the middleware has no services.
    fn call(
        &self,
        _service: &SeenService,
        _request: &[u8],
        _timeout: Duration,
    ) -> Result<Option<Vec<u8>>, TransportError> {
        Ok(None)
    }

    /// The known services. `link` is for error messages.
    fn services(&self, _link: &Link) -> Result<Vec<SeenService>, TransportError> {
        Ok(Vec::new())
    }

    /// The known topics. `link` is for error messages.
    fn topics(&self, _link: &Link) -> Result<Vec<SeenTopic>, TransportError> {
        Ok(Vec::new())
    }

    /// Watches the members of a group among the processes that read the topic of `link`.
    fn membership(
        self: Arc<Self>,
        link: &Link,
        _group: &str,
        _label: &str,
    ) -> Result<Box<dyn Membership>, TransportError> {
        Err(TransportError::NoGroups { link: link.clone() })
    }

    /// The shared memory of a topic; `None` if the middleware has none.
    #[cfg(feature = "shm")]
    fn shared_memory(
        &self,
        _link: &Link,
        _type_name: &str,
    ) -> Result<Option<super::SharedMemory>, TransportError> {
        Ok(None)
    }

    /// A publisher that does not write its frames; `None` if messages are not written in place.
    #[cfg(feature = "lab")]
    fn untouched(
        &self,
        _link: &Link,
        _particles: usize,
    ) -> Result<Option<Box<dyn super::BarePublisher>>, TransportError> {
        Ok(None)
    }
}

/// An error of a middleware on `link`.
#[cfg(any(feature = "shm", feature = "zenoh", feature = "dds"))]
pub(crate) fn error(
    link: &Link,
    action: &'static str,
    reason: &dyn std::fmt::Display,
) -> TransportError {
    TransportError::Middleware { link: link.clone(), action, reason: reason.to_string() }
}
