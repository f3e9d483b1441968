//! Sends requests to services of other nodes; see [`service`](super::service) for topics and sample identities, and
//! [`request_header`](super::request_header) for services on rmw_cyclonedds.

use std::{collections::BTreeSet, thread, time::Duration};

use ros2_client::dds::rustdds::{
    RTPSEntity, Timestamp, Topic, TopicKind, WriteOptionsBuilder,
    no_key::{DataWriter, SimpleDataReader},
};

use super::{
    DdsNode,
    cdr::{Body, PassThrough},
    middleware,
    qos::{self, PublisherQos},
    request_header::{self, RequestHeader},
    service_types,
};
use crate::{Link, SeenService, SeenTopic, TransportError, TransportKind};
use eddy_frames::clock::Clock;
use eddy_messages::{
    ros_type,
    type_descriptions::{GET_TYPE_DESCRIPTION, SERVICE_NAME},
};

/// Interval between looks for matched endpoints and responses.
const INTERVAL: Duration = Duration::from_millis(5);
/// Interval between repetitions of a request that may be repeated.
const RETRY: Duration = Duration::from_millis(300);
/// Time for a service to discover the endpoints of a client, after the client has discovered those of the service.
const SETTLING: Duration = Duration::from_millis(200);

/// Whether a request may be sent again while no response comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Repeat {
    /// It changes nothing.
    Yes,
    /// It may be carried out twice.
    No,
}

/// Asks the nodes of the publishers of a topic for the definition of its type. The answers are CDR bytes.
///
/// A participant may have several nodes, each with a service of its own; all of them are asked.
pub(super) fn describe(
    node: &DdsNode,
    topic: &SeenTopic,
    request: &[u8],
    timeout: Duration,
) -> Result<Vec<Vec<u8>>, TransportError> {
    let publishes = |writer: &super::RemoteWriter| {
        writer.topic == topic.link.topic && writer.type_name == topic.type_name
    };
    let publishers: Vec<_> =
        node.writers().filter(publishes).map(|writer| writer.guid.prefix).collect();
    let readers = node.participant.discovered_readers();
    let services: BTreeSet<String> = readers
        .iter()
        .filter(|reader| publishers.contains(&reader.reader_proxy.remote_reader_guid.prefix))
        .filter_map(|reader| {
            let name = service_name(reader.subscription_topic_data.topic_name())?;
            name.ends_with(&format!("/{SERVICE_NAME}")).then(|| name.to_owned())
        })
        .collect();
    let mut answers = Vec::new();
    for service in services {
        let asked = (service.as_str(), GET_TYPE_DESCRIPTION);
        answers.extend(call(node, &topic.link, asked, request, Repeat::Yes, timeout)?);
    }
    Ok(answers)
}

/// The services of other participants.
pub(super) fn services(node: &DdsNode) -> Vec<SeenService> {
    let seen = |topic: &str, kind: &str| {
        let name = service_name(topic)?;
        let type_name = ros_type(kind)?.strip_suffix("_Request")?.to_owned();
        let link = format!("{}:{name}", TransportKind::Dds).parse().ok()?;
        Some(SeenService { link, type_name, hash: None })
    };
    let readers = node.participant.discovered_readers();
    let topics = readers.iter().map(|reader| &reader.subscription_topic_data);
    topics.filter_map(|data| seen(data.topic_name(), data.type_name())).collect()
}

/// The service whose requests have this topic.
fn service_name(topic: &str) -> Option<&str> {
    topic.strip_prefix("rq")?.strip_suffix("Request")
}

/// Where requests to a service go, and where its responses come from.
type Endpoints = (DataWriter<Body, PassThrough>, SimpleDataReader<Vec<u8>, PassThrough>);

/// Opens the endpoints of a client of a service.
fn endpoints(
    node: &DdsNode,
    link: &Link,
    service: &str,
    type_name: &str,
) -> Result<Endpoints, TransportError> {
    let failed = |error: &dyn std::fmt::Display| middleware(link, "call a service", error);
    let [request_type, response_type] = service_types(type_name);
    let topic = |name: String, kind: String| -> Result<Topic, TransportError> {
        let topic = node.participant.create_topic(name, kind, &qos::topic(), TopicKind::NoKey);
        topic.map_err(|error| failed(&error))
    };
    let responses = topic(format!("rr{service}Reply"), response_type)?;
    let responses = node
        .subscriber
        .create_simple_datareader_no_key(&responses, Some(qos::reliable_reader()))
        .map_err(|error| failed(&error))?;
    let requests = topic(format!("rq{service}Request"), request_type)?;
    let requests = node
        .publisher
        .create_datawriter_no_key(&requests, Some(PublisherQos::Reliable.policies(None)))
        .map_err(|error| failed(&error))?;
    Ok((requests, responses))
}

/// One request to a service with this name and type; `None` if nobody answers within `timeout`. `link` is for error
/// messages.
pub(super) fn call(
    node: &DdsNode,
    link: &Link,
    (service, type_name): (&str, &str),
    request: &[u8],
    repeat: Repeat,
    timeout: Duration,
) -> Result<Option<Vec<u8>>, TransportError> {
    let failed = |error: &dyn std::fmt::Display| middleware(link, "call a service", error);
    let (requests, responses) = endpoints(node, link, service, type_name)?;
    // A service drops requests of clients that it does not know yet, and responses to these.
    let is_known =
        || node.graph.matched(requests.guid()) > 0 && node.graph.has_writer(responses.guid());
    // Services on rmw_cyclonedds take the identity of a request from its body.
    let has_header = || {
        let readers = node.participant.discovered_readers();
        let topic = format!("rq{service}Request");
        readers.iter().any(|reader| {
            *reader.subscription_topic_data.topic_name() == topic
                && request_header::is_cyclone(reader.reader_proxy.remote_reader_guid)
        })
    };
    let header = RequestHeader::of(requests.guid());
    let (clock, mut sent, mut send_at) = (Clock::start(), Vec::new(), Duration::ZERO);
    let (mut response, mut known_since) = (None, None);
    while response.is_none() && clock.now() < timeout {
        let now = clock.now();
        if known_since.is_none() && is_known() {
            known_since = Some(now);
        }
        let is_due = known_since.is_some_and(|since| match repeat {
            Repeat::Yes => now >= send_at,
            Repeat::No => sent.is_empty() && now >= since + SETTLING,
        });
        if is_due {
            let message = match has_header() {
                true => header.before(request),
                false => request.to_vec(),
            };
            let body = Body::of(message).ok_or_else(|| failed(&"expected plain CDR"))?;
            let options = WriteOptionsBuilder::new().source_timestamp(Timestamp::now()).build();
            let identity = requests.write_with_options(body, options);
            sent.push(identity.map_err(|error| failed(&error))?);
            send_at = now + RETRY;
        }
        thread::sleep(INTERVAL);
        responses.drain_read_notifications();
        while let Ok(Some(sample)) = responses.try_take_one() {
            let identity = sample.related_sample_identity();
            if request_header::is_cyclone(sample.writer_guid) {
                let split = RequestHeader::split(&sample.into_value());
                response = split.filter(|(of, _)| *of == header).map(|(_, rest)| rest);
            } else if identity.is_some_and(|of| sent.contains(&of)) {
                response = Some(sample.into_value());
            }
        }
    }
    node.graph.remove_writer(requests.guid());
    node.graph.remove_reader(responses.guid());
    Ok(response)
}
