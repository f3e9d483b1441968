//! DDS, in the form of ROS 2's DDS middlewares: a plain ROS 2 sees the node, its topics and parameters.
//!
//! 1. [`participant`]: the process on the network; which networks it speaks on.
//! 2. [`graph`]: the node and its endpoints as ROS sees them; who is matched with whom.
//! 3. [`cdr`]: bytes pass as they are, nothing is encoded twice.
//! 4. [`qos`]: what an endpoint promises; what a message may weigh.
//! 5. [`publisher`], [`subscriber`]: messages.
//! 6. [`service`]: requests and responses.
//!
//! Topic `/particles` is `rt/particles` on the wire, its type `eddy_msgs::msg::dds_::ParticleFrame_`
//! (<https://design.ros2.org/articles/topic_and_service_names.html>).
//!
//! Names and graph messages are those of ros2-client, the endpoints those of RustDDS underneath it.
//! ros2-client 0.12.1's own `Node` and `Publisher` do not fit: a publisher cannot be asked whether its
//! messages have arrived (`DataWriter::wait_for_acknowledgments`), so that the last frames of a replay
//! would be lost with the process; it encodes every message itself, where we have the bytes already;
//! endpoints stay in the graph after they are gone; and its spinner subscribes to `/clock` with a type that
//! is not ROS's, beside our own.
//!
//! Loopback: RustDDS 0.15 takes a list of networks that it announces itself on, sends to and joins groups on
//! (`DomainParticipantBuilder::with_only_networks`), which is `127.0.0.1` here unless
//! [`DdsOptions`](super::DdsOptions) say otherwise. Its unicast sockets are bound to all addresses
//! nevertheless, and there is no setting for that: who knows the port can send to it from outside. Where
//! that matters a firewall must close the UDP ports from 7400. Loopback has no multicast: participants
//! announce themselves to the ports of the first twelve of a domain there.
//!
//! What RustDDS cannot do: a reader takes everything it is sent, so that a publisher that blocks waits for
//! the subscriber's process to have a message, not for it to be read. A subscriber keeps 1,024 messages
//! (64 MiB) it has not read, then gives up the oldest and counts it. And a subscriber that is killed is only missed
//! after its lease of 50 s.

mod cdr;
mod graph;
mod participant;
mod publisher;
mod qos;
mod service;
mod subscriber;

use std::{fmt::Display, num::NonZeroUsize, sync::Arc, time::Duration};

use ros2_client::dds::rustdds::{
    self, DomainParticipant, Topic, TopicKind, discovery::DiscoveredTopicData,
};

use super::{
    Handler, Link, Publisher, Reliability, SeenTopic, Served, Subscriber, TransportError,
    TransportKind, TransportOptions, middleware::Middleware,
};
use eddy_messages::{TypeSupport, dds_type, ros_type};
use graph::Graph;
use publisher::DdsPublisher;
use service::DdsService;
use subscriber::DdsSubscriber;

/// This process in the ROS graph.
pub(super) struct DdsNode {
    participant: DomainParticipant,
    publisher: rustdds::Publisher,
    subscriber: rustdds::Subscriber,
    graph: Graph,
    patience: Duration,
    /// Bytes.
    largest_message: usize,
}

impl DdsNode {
    pub(super) fn open(link: &Link, options: &TransportOptions) -> Result<Self, TransportError> {
        let participant = participant::open(link, options)?;
        let failed = |error| middleware(link, "open the DDS participant", &error);
        let none = qos::unsaid();
        let publisher = participant.create_publisher(&none).map_err(failed)?;
        let subscriber = participant.create_subscriber(&none).map_err(failed)?;
        let graph = Graph::open(link, &participant, &publisher, options)?;
        let (patience, largest_message) = (options.patience, qos::largest_message());
        tracing::info!("DDS carries messages of up to {largest_message} bytes here");
        Ok(Self { participant, publisher, subscriber, graph, patience, largest_message })
    }

    /// The DDS topic of a link.
    fn topic(&self, link: &Link, type_name: &str) -> Result<Topic, TransportError> {
        let (name, type_name) = (format!("rt{}", link.topic), dds_type(type_name));
        self.participant
            .create_topic(name, type_name, &qos::cache(), TopicKind::NoKey)
            .map_err(|error| middleware(link, "create the topic", &error))
    }
}

impl Middleware for DdsNode {
    fn publisher(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
        reliability: Reliability,
        _kept: Option<NonZeroUsize>,
    ) -> Result<Box<dyn Publisher>, TransportError> {
        Ok(Box::new(DdsPublisher::open(&self, link, support, reliability)?))
    }

    fn subscriber(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
    ) -> Result<Box<dyn Subscriber>, TransportError> {
        Ok(Box::new(DdsSubscriber::open(&self, link, support)?))
    }

    fn service(
        self: Arc<Self>,
        link: &Link,
        type_name: &str,
        handler: Handler,
    ) -> Result<Option<Box<dyn Served>>, TransportError> {
        Ok(Some(Box::new(DdsService::open(&self, link, type_name, handler)?)))
    }

    /// The topics that have been announced by others, read or written.
    fn topics(&self, _link: &Link) -> Result<Vec<SeenTopic>, TransportError> {
        let topics = self.participant.discovered_topics().into_iter();
        let seen = |name: &str, type_name: &str| {
            let topic = name.strip_prefix("rt")?;
            let link = format!("{}:{topic}", TransportKind::Dds).parse().ok()?;
            Some(SeenTopic { link, type_name: ros_type(type_name)?, hash: None, kept: 0 })
        };
        let named =
            |topic: DiscoveredTopicData| seen(&topic.topic_data.name, &topic.topic_data.type_name);
        Ok(topics.filter_map(named).collect())
    }
}

/// `std_srvs/srv/Trigger` has the types `std_srvs::srv::dds_::Trigger_Request_` and `..._Response_`.
fn service_types(name: &str) -> [String; 2] {
    ["Request", "Response"].map(|part| dds_type(&format!("{name}_{part}")))
}

/// An error of DDS on `link`.
fn middleware(link: &Link, action: &'static str, reason: &dyn Display) -> TransportError {
    TransportError::Middleware { link: link.clone(), action, reason: reason.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn services_have_a_type_for_each_way() {
        let [request, response] = service_types("std_srvs/srv/Trigger");
        assert_eq!(request, "std_srvs::srv::dds_::Trigger_Request_");
        assert_eq!(response, "std_srvs::srv::dds_::Trigger_Response_");
    }
}
