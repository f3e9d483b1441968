//! DDS as in ROS 2's DDS middlewares: an unmodified ROS 2 sees the node, its topics and parameters.
//!
//! 1. [`participant`]: the DDS participant and its networks; [`farewell`]: its end.
//! 2. [`graph`]: the node and its endpoints in the ROS graph; matched endpoints.
//! 3. [`event_loop`]: a thread that handles events of RustDDS.
//! 4. [`cdr`]: passes CDR bytes through RustDDS without encoding them again.
//! 5. [`qos`]: QoS of the endpoints; largest message size.
//! 6. [`publisher`], [`subscriber`]: messages; [`writers`]: publishers of others.
//! 7. [`service`]: requests and responses; [`large_response`]: those that RustDDS cannot send; [`client`]: the other side;
//!    [`request_header`]: their form on rmw_cyclonedds.
//! 8. [`rtps`]: messages that eddy sends itself.
//!
//! Topic `/particles` is `rt/particles` on the wire, its type `eddy_msgs::msg::dds_::ParticleFrame_`
//! (<https://design.ros2.org/articles/topic_and_service_names.html>).
//!
//! Names and graph messages come from ros2-client, endpoints from RustDDS. `Node` and `Publisher` of ros2-client 0.12.1
//! are not used: a publisher cannot wait for acknowledgments (`DataWriter::wait_for_acknowledgments`), so the last frames
//! of a replay would be lost with the process; it encodes every message, although the bytes exist; endpoints stay in the
//! graph after they are dropped; and its spinner subscribes to `/clock` with a type other than that of ROS.
//!
//! Loopback: RustDDS 0.15 restricts announcements, destinations and multicast groups to a list of networks
//! (`DomainParticipantBuilder::with_only_networks`), here `127.0.0.1` unless [`DdsOptions`](super::DdsOptions) say
//! otherwise. Its unicast sockets are always bound to all addresses, so other machines can send to these ports unless a
//! firewall closes the UDP ports from 7400. Loopback has no multicast: participants announce themselves to the ports of
//! the first twelve participants of a domain.
//!
//! Limitations of RustDDS: readers accept everything they are sent, so a blocking publisher waits until the subscriber's
//! process has received a message, not until it is read. RustDDS keeps 256 messages of a topic until the subscriber's thread
//! takes them; older ones are lost if that thread gets no time for as long. A subscriber queues 1,024 messages (64 MiB),
//! then drops and counts the oldest. The user data of local endpoints, where ROS 2 has their type hashes, cannot be set. A killed subscriber is detected after its lease of 50 s. A publisher cannot leave out a single
//! subscriber: one that acknowledges nothing holds the others back once 256 messages are unacknowledged, until its lease
//! has ended.

mod cdr;
mod client;
mod event_loop;
mod farewell;
mod graph;
mod large_response;
mod participant;
mod publisher;
mod qos;
mod request_header;
mod rtps;
mod service;
mod subscriber;
mod writers;

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use ros2_client::dds::rustdds::{self, DomainParticipant, Topic, TopicKind};

use super::{
    DiscoveryRange, Handler, Link, Publisher, Reliability, SeenService, SeenTopic, Served,
    Subscriber, TransportError, TransportKind, TransportOptions,
    descriptors::Cost,
    middleware::{Middleware, error as middleware},
    patience::Patience,
};
use eddy_messages::{QosProfile, TypeSupport, dds_type};
use farewell::Farewell;
use graph::Graph;
use publisher::DdsPublisher;
use service::DdsService;
use subscriber::DdsSubscriber;
use writers::RemoteWriter;

/// Measured.
pub(super) const COST: Cost = Cost { middleware: 46, publisher: 2, subscriber: 6, of_frames: 0 };

/// This process in the ROS graph.
pub(super) struct DdsNode {
    participant: DomainParticipant,
    publisher: rustdds::Publisher,
    subscriber: rustdds::Subscriber,
    graph: Graph,
    patience: Patience,
    range: DiscoveryRange,
    /// Bytes.
    largest_message: usize,
    /// The last field: sent after the participant is closed, which `graph` also keeps open.
    _farewell: Farewell,
}

impl DdsNode {
    pub(super) fn open(
        link: &Link,
        options: &TransportOptions,
        patience: Patience,
    ) -> Result<Self, TransportError> {
        let participant = participant::open(link, options)?;
        let _farewell = Farewell::of(&participant, options);
        let failed = |error| middleware(link, "open the DDS participant", &error);
        let none = qos::default();
        let publisher = participant.create_publisher(&none).map_err(failed)?;
        let subscriber = participant.create_subscriber(&none).map_err(failed)?;
        let graph = Graph::open(link, &participant, &publisher, options)?;
        let largest_message = qos::largest_message();
        tracing::info!("DDS: largest message is {largest_message} bytes");
        let range = options.dds.range;
        Ok(Self {
            participant,
            publisher,
            subscriber,
            graph,
            patience,
            range,
            largest_message,
            _farewell,
        })
    }

    /// The writers of ROS topics of other participants.
    fn writers(&self) -> impl Iterator<Item = RemoteWriter> + use<> {
        writers::discovered(&self.participant).into_iter()
    }

    /// The DDS topic of a link.
    fn topic(&self, link: &Link, type_name: &str) -> Result<Topic, TransportError> {
        let (name, type_name) = (format!("rt{}", link.topic), dds_type(type_name));
        self.participant
            .create_topic(name, type_name, &qos::topic(), TopicKind::NoKey)
            .map_err(|error| middleware(link, "create the topic", &error))
    }
}

impl Drop for DdsNode {
    fn drop(&mut self) {
        self.graph.leave();
    }
}

impl Middleware for DdsNode {
    fn publisher(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
        reliability: Reliability,
        offered: Option<QosProfile>,
    ) -> Result<Box<dyn Publisher>, TransportError> {
        Ok(Box::new(DdsPublisher::open(&self, link, support, reliability, offered)?))
    }

    fn subscriber(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
        requested: Option<QosProfile>,
    ) -> Result<Box<dyn Subscriber>, TransportError> {
        Ok(Box::new(DdsSubscriber::open(&self, link, support, requested)?))
    }

    fn service(
        self: Arc<Self>,
        link: &Link,
        type_name: &str,
        handler: Handler,
    ) -> Result<Option<Box<dyn Served>>, TransportError> {
        Ok(Some(Box::new(DdsService::open(&self, link, type_name, handler)?)))
    }

    /// The topics that others publish.
    fn topics(&self, _link: &Link) -> Result<Vec<SeenTopic>, TransportError> {
        let mut topics: BTreeMap<_, Vec<QosProfile>> = BTreeMap::new();
        for RemoteWriter { topic, type_name, hash, offered, .. } in self.writers() {
            topics.entry((topic, type_name, hash)).or_default().push(offered);
        }
        let seen = |((topic, type_name, hash), mut offered): (_, Vec<_>)| {
            offered.sort();
            let topic: String = topic;
            let link = format!("{}:{topic}", TransportKind::Dds).parse().ok()?;
            Some(SeenTopic { link, type_name, hash, offered })
        };
        Ok(topics.into_iter().filter_map(seen).collect())
    }

    fn call(
        &self,
        service: &SeenService,
        request: &[u8],
        timeout: Duration,
    ) -> Result<Option<Vec<u8>>, TransportError> {
        let SeenService { link, type_name, .. } = service;
        let asked = (link.topic.as_str(), type_name.as_str());
        client::call(self, link, asked, request, client::Repeat::No, timeout)
    }

    fn services(&self, _link: &Link) -> Result<Vec<SeenService>, TransportError> {
        Ok(client::services(self))
    }

    fn describe(
        &self,
        topic: &SeenTopic,
        request: &[u8],
        timeout: Duration,
    ) -> Result<Vec<Vec<u8>>, TransportError> {
        client::describe(self, topic, request, timeout)
    }
}

/// `std_srvs/srv/Trigger` has the types `std_srvs::srv::dds_::Trigger_Request_` and `..._Response_`.
fn service_types(name: &str) -> [String; 2] {
    ["Request", "Response"].map(|part| dds_type(&format!("{name}_{part}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn services_have_a_request_and_a_response_type() {
        let [request, response] = service_types("std_srvs/srv/Trigger");
        assert_eq!(request, "std_srvs::srv::dds_::Trigger_Request_");
        assert_eq!(response, "std_srvs::srv::dds_::Trigger_Response_");
    }
}
