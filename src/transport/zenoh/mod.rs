//! Zenoh, in the form of ROS 2's rmw_zenoh: an unmodified ROS 2 sees and echoes our topics.
//!
//! 1. [`config`]: the session; how processes find each other.
//! 2. [`keys`]: key expressions, liveliness tokens, quality of service, GIDs.
//! 3. [`attachment`]: the 33 bytes beside every message.
//! 4. [`graph`]: who else is on a topic, by liveliness tokens.
//! 5. [`publisher`], [`subscriber`]: messages.
//!
//! Why the `zenoh` crate with `hiroz-protocol`, and not all of `hiroz` 0.2.1: hiroz makes an endpoint's
//! GID from a truncated SHA-256 of session and entity numbers (`hiroz/src/entity.rs`, `endpoint_gid`), where rmw_zenoh takes
//! XXH3-128 of the liveliness token (`rmw_zenoh_cpp/src/detail/liveliness_utils.cpp`, `Entity::Entity`),
//! so ROS tools could not tie a message to its publisher; it turns on all of zenoh's default features
//! (TLS, QUIC, serial lines, shared memory); and it builds zenoh a second time as a build dependency. What remains of it, names and
//! tokens, is `hiroz-protocol`, which is used here. `zenoh-ext` is not needed: no topic of eddy's is transient local.

mod attachment;
mod config;
mod graph;
mod keys;
mod publisher;
mod subscriber;

use std::{
    fmt::Display,
    sync::atomic::{AtomicUsize, Ordering},
    time::Duration,
};

use hiroz_protocol::entity::EndpointKind;
use zenoh::{Session, Wait, liveliness::LivelinessToken};

use super::{Link, Reliability, TransportError, TransportOptions};
use crate::msg::TypeSupport;
use graph::Graph;
use keys::{Endpoint, Node};
use publisher::ZenohPublisher;
use subscriber::ZenohSubscriber;

/// This process in the ROS graph.
pub(super) struct ZenohNode {
    session: Session,
    node: Node,
    patience: Duration,
    /// Number of the next endpoint; the node itself is 0.
    next_id: AtomicUsize,
    _token: LivelinessToken,
}

impl ZenohNode {
    pub(super) fn open(link: &Link, options: &TransportOptions) -> Result<Self, TransportError> {
        let session = config::open(link, options)?;
        let node = Node::new(options.domain_id, session.zid(), &options.node_name);
        let token = node.token().map_err(|error| middleware(link, "name the node", &error))?;
        let token = session
            .liveliness()
            .declare_token(token)
            .wait()
            .map_err(|error| middleware(link, "declare the node", &error))?;
        let next_id = AtomicUsize::new(1);
        Ok(Self { session, node, patience: options.patience, next_id, _token: token })
    }

    pub(super) fn publisher(
        &self,
        link: &Link,
        support: &TypeSupport,
        reliability: Reliability,
    ) -> Result<ZenohPublisher, TransportError> {
        let qos = keys::publisher_qos(reliability);
        let endpoint = self.endpoint(link, support, EndpointKind::Publisher, qos)?;
        let graph = Graph::watch(&self.session, &endpoint, EndpointKind::Subscription)
            .map_err(|error| middleware(link, "watch subscribers", &error))?;
        ZenohPublisher::open(&self.session, endpoint, graph, reliability)
    }

    pub(super) fn subscriber(
        &self,
        link: &Link,
        support: &TypeSupport,
    ) -> Result<ZenohSubscriber, TransportError> {
        let qos = keys::subscriber_qos(subscriber::DEPTH);
        let endpoint = self.endpoint(link, support, EndpointKind::Subscription, qos)?;
        let graph = Graph::watch(&self.session, &endpoint, EndpointKind::Publisher)
            .map_err(|error| middleware(link, "watch publishers", &error))?;
        ZenohSubscriber::open(&self.session, endpoint, graph, self.patience)
    }

    fn endpoint(
        &self,
        link: &Link,
        support: &TypeSupport,
        kind: EndpointKind,
        qos: hiroz_protocol::qos::QosProfile,
    ) -> Result<Endpoint, TransportError> {
        let id = self.next_id.fetch_add(1, Ordering::Relaxed);
        Endpoint::new(&self.node, id, kind, link, support, qos)
            .map_err(|error| middleware(link, "name the topic", &error))
    }
}

/// An error of zenoh on `link`.
fn middleware(link: &Link, action: &'static str, reason: &dyn Display) -> TransportError {
    TransportError::Middleware { link: link.clone(), action, reason: reason.to_string() }
}
