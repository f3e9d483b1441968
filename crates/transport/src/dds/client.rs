//! Sends requests to services of other nodes; see [`service`](super::service) for topics and sample identities.

use std::{collections::BTreeSet, thread, time::Duration};

use ros2_client::dds::rustdds::{
    RTPSEntity, Topic, TopicKind, WriteOptionsBuilder,
    no_key::{DataWriter, SimpleDataReader},
};

use super::{
    DdsNode,
    cdr::{Body, PassThrough},
    middleware,
    qos::{self, PublisherQos},
    service_types,
};
use crate::{Link, SeenTopic, TransportError};
use eddy_frames::clock::Clock;
use eddy_messages::type_descriptions::{GET_TYPE_DESCRIPTION, SERVICE_NAME};

/// Interval between looks for matched endpoints and responses.
const INTERVAL: Duration = Duration::from_millis(5);
/// Interval between repetitions of a request.
const RETRY: Duration = Duration::from_millis(300);

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
            let name = reader.subscription_topic_data.topic_name().strip_prefix("rq")?;
            let name = name.strip_suffix("Request")?;
            name.ends_with(&format!("/{SERVICE_NAME}")).then(|| name.to_owned())
        })
        .collect();
    let mut answers = Vec::new();
    for service in services {
        answers.extend(call(node, &topic.link, &service, request, timeout)?);
    }
    Ok(answers)
}

/// One request; `None` if nobody answers within `timeout`.
fn call(
    node: &DdsNode,
    link: &Link,
    service: &str,
    request: &[u8],
    timeout: Duration,
) -> Result<Option<Vec<u8>>, TransportError> {
    let failed = |error: &dyn std::fmt::Display| middleware(link, "call a service", error);
    let [request_type, response_type] = service_types(GET_TYPE_DESCRIPTION);
    let topic = |name: String, kind: String| -> Result<Topic, TransportError> {
        let topic = node.participant.create_topic(name, kind, &qos::topic(), TopicKind::NoKey);
        topic.map_err(|error| failed(&error))
    };
    let responses = topic(format!("rr{service}Reply"), response_type)?;
    let responses: SimpleDataReader<Vec<u8>, PassThrough> = node
        .subscriber
        .create_simple_datareader_no_key(&responses, Some(qos::reliable_reader()))
        .map_err(|error| failed(&error))?;
    let requests = topic(format!("rq{service}Request"), request_type)?;
    let requests: DataWriter<Body, PassThrough> = node
        .publisher
        .create_datawriter_no_key(&requests, Some(PublisherQos::Reliable.policies(None)))
        .map_err(|error| failed(&error))?;
    // A service drops requests of clients that it does not know yet, and responses to these.
    let is_known =
        || node.graph.matched(requests.guid()) > 0 && node.graph.has_writer(responses.guid());
    let (clock, mut sent, mut send_at) = (Clock::start(), Vec::new(), Duration::ZERO);
    let mut response = None;
    while response.is_none() && clock.now() < timeout {
        if clock.now() >= send_at && is_known() {
            let body = Body::of(request.to_vec()).ok_or_else(|| failed(&"expected plain CDR"))?;
            let options = WriteOptionsBuilder::new().build();
            let identity = requests.write_with_options(body, options);
            sent.push(identity.map_err(|error| failed(&error))?);
            send_at = clock.now() + RETRY;
        }
        thread::sleep(INTERVAL);
        responses.drain_read_notifications();
        while let Ok(Some(sample)) = responses.try_take_one() {
            if sample.related_sample_identity().is_some_and(|of| sent.contains(&of)) {
                response = Some(sample.into_value());
            }
        }
    }
    node.graph.remove_writer(requests.guid());
    node.graph.remove_reader(responses.guid());
    Ok(response)
}
