//! Zenoh with the wire format of ROS 2's rmw_zenoh: an unmodified ROS 2 lists and echoes eddy's topics.
//!
//! 1. [`config`]: the session; how processes find each other; [`failure`]: why zenoh fails.
//! 2. [`keys`]: key expressions, liveliness tokens, QoS, GIDs.
//! 3. [`attachment`]: the 33 bytes attached to every message.
//! 4. [`graph`]: other endpoints of a topic, by liveliness tokens.
//! 5. [`publisher`], [`subscriber`]: messages; [`sender`]: how a publisher is never stuck in Zenoh.
//! 6. [`transient_local`]: messages kept for late-joining subscribers.
//! 7. [`service`]: requests and responses; [`client`]: the other side.
//! 8. [`membership`]: groups of processes that share work.
//! 9. [`bare`]: Zenoh used directly, for benchmarks.
//!
//! Why the `zenoh` crate and not `hiroz` 0.2.1, which has the same wire format: hiroz derives the GID of an endpoint from
//! a truncated SHA-256 of session and entity numbers (`src/entity.rs`, `endpoint_gid`), rmw_zenoh from XXH3-128 of the
//! liveliness token (`liveliness_utils.cpp`, `Entity::Entity`), so ROS tools could not match messages with publishers.
//! hiroz also enables all default features of zenoh (TLS, QUIC, serial, shared memory) and builds zenoh a second time as
//! a build dependency. `hiroz-protocol` 0.2.1, its crate for names and tokens, compiles only with its feature `std`,
//! which enables the same features.

pub(super) mod attachment;
#[cfg(feature = "lab")]
pub(super) mod bare;
mod client;
mod config;
mod failure;
mod graph;
pub(super) mod keys;
mod membership;
mod publisher;
mod sender;
mod service;
mod subscriber;
mod transient_local;

use std::{
    num::NonZeroUsize,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use zenoh::{Session, Wait as _, liveliness::LivelinessToken};

use super::{
    Handler, Lease, Link, Membership, Publisher, Reliability, SeenService, SeenTopic, Served,
    Subscriber, TransportError, TransportOptions, default_qos, descriptors::Cost,
    middleware::Middleware, patience::Patience,
};
use eddy_messages::{QosProfile, TypeSupport, qos::DurabilityPolicy, service_hash};
use failure::error as middleware;
use keys::{Endpoint, Node, Side};
use membership::ZenohMembership;
use publisher::ZenohPublisher;
use service::ZenohService;
use subscriber::ZenohSubscriber;

/// Measured, without connections to others.
pub(super) const COST: Cost = Cost { middleware: 16, publisher: 0, subscriber: 0, of_frames: 0 };

/// This process in the ROS graph.
pub(super) struct ZenohNode {
    session: Session,
    node: Node,
    lease: Lease,
    patience: Patience,
    /// Id of the next endpoint; the node has id 0.
    next_id: AtomicUsize,
    _token: LivelinessToken,
}

impl ZenohNode {
    pub(super) fn open(
        link: &Link,
        options: &TransportOptions,
        patience: Patience,
    ) -> Result<Self, TransportError> {
        let (session, lease) = config::open(link, options)?;
        let TransportOptions { domain_id, enclave, namespace, node_name, .. } = options.clone();
        let node = Node { domain_id, zid: session.zid(), enclave, namespace, name: node_name };
        let token = graph::declare(&session, &node.token())
            .map_err(|error| middleware(link, "declare the node", &error))?;
        let next_id = AtomicUsize::new(1);
        Ok(Self { session, node, lease, patience, next_id, _token: token })
    }

    fn id(&self) -> usize {
        self.next_id.fetch_add(1, Ordering::Relaxed)
    }
}

impl Drop for ZenohNode {
    fn drop(&mut self) {
        let session = self.session.clone();
        sender::close(&self.patience, move || {
            if let Err(error) = session.close().wait() {
                tracing::debug!("zenoh: {}", failure::words(&error));
            }
        });
    }
}

impl Middleware for ZenohNode {
    fn topics(&self, link: &Link) -> Result<Vec<SeenTopic>, TransportError> {
        graph::topics(&self.session, self.node.domain_id)
            .map_err(|error| middleware(link, "list the topics", &error))
    }

    fn publisher(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
        reliability: Reliability,
        offered: Option<QosProfile>,
    ) -> Result<Box<dyn Publisher>, TransportError> {
        let offered = offered.unwrap_or_else(|| default_qos(reliability, &support.name));
        let (qos, kept) = (keys::qos(&offered), NonZeroUsize::new(offered.kept()));
        let endpoint = Endpoint::new(&self.node, self.id(), Side::Publisher, link, support, &qos);
        Ok(Box::new(ZenohPublisher::open(&self, endpoint, reliability, kept)?))
    }

    fn subscriber(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
        requested: Option<QosProfile>,
    ) -> Result<Box<dyn Subscriber>, TransportError> {
        let with_kept =
            requested.is_none_or(|qos| qos.durability == DurabilityPolicy::TransientLocal);
        let qos = keys::qos(&requested.unwrap_or_else(|| keys::subscriber_qos(subscriber::DEPTH)));
        let endpoint =
            Endpoint::new(&self.node, self.id(), Side::Subscription, link, support, &qos);
        Ok(Box::new(ZenohSubscriber::open(&self, endpoint, with_kept)?))
    }

    fn describe(
        &self,
        topic: &SeenTopic,
        request: &[u8],
        timeout: Duration,
    ) -> Result<Vec<Vec<u8>>, TransportError> {
        client::describe(&self.session, self.node.domain_id, topic, request, timeout)
            .map_err(|error| middleware(&topic.link, "ask for the definition of the type", &error))
    }

    fn call(
        &self,
        service: &SeenService,
        request: &[u8],
        timeout: Duration,
    ) -> Result<Option<Vec<u8>>, TransportError> {
        let SeenService { link, type_name, hash } = service;
        let hash = match hash {
            Some(hash) => hash,
            None => service_hash(type_name)?,
        };
        let key = keys::service(self.node.domain_id, &link.topic, type_name, hash);
        let responses = client::call(&self.session, &key, request, timeout);
        let responses = responses.map_err(|error| middleware(link, "call the service", &error))?;
        Ok(responses.into_iter().next())
    }

    fn services(&self, link: &Link) -> Result<Vec<SeenService>, TransportError> {
        graph::services(&self.session, self.node.domain_id)
            .map_err(|error| middleware(link, "list the services", &error))
    }

    fn membership(
        self: Arc<Self>,
        link: &Link,
        group: &str,
        label: &str,
    ) -> Result<Box<dyn Membership>, TransportError> {
        Ok(Box::new(ZenohMembership::open(&self, link, group, label)?))
    }

    fn service(
        self: Arc<Self>,
        link: &Link,
        type_name: &str,
        handler: Handler,
    ) -> Result<Option<Box<dyn Served>>, TransportError> {
        let support = TypeSupport::foreign(type_name, service_hash(type_name)?);
        let qos = keys::service_qos(service::DEPTH);
        let endpoint = Endpoint::new(&self.node, self.id(), Side::Service, link, &support, &qos);
        Ok(Some(Box::new(ZenohService::open(&self, endpoint, handler)?)))
    }
}
