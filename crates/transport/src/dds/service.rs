//! Answers the requests of a service.
//!
//! Requests arrive on the topic `rq<service>Request`; responses are published on `rr<service>Reply` with the sample
//! identity of the request (OMG DDS-RPC 1.0, 7.8.2, "enhanced" mapping, which rmw_fastrtps uses). Requests and responses of
//! rmw_cyclonedds have their identity in the body: [`request_header`](super::request_header).

use std::{io, sync::Arc, thread, time::Duration};

use ros2_client::dds::rustdds::{
    RTPSEntity, SampleIdentity, SequenceNumber, Timestamp, TopicKind, WriteOptionsBuilder,
    mio1::{Interest, Token},
    no_key::{DataWriter, DeserializedCacheChange, SimpleDataReader},
};

use super::{
    DdsNode,
    cdr::{Body, PassThrough},
    event_loop::EventLoop,
    large_response::Response,
    middleware,
    qos::{self, PublisherQos},
    request_header::{self, RequestHeader},
    service_types,
};
use crate::{Handler, Link, Served, TransportError};
use eddy_frames::clock::Clock;

/// Longest time for the discovery of a client that has sent a request.
const DISCOVERY: Duration = Duration::from_secs(1);
/// Interval between looks for it.
const INTERVAL: Duration = Duration::from_millis(5);
/// Last bytes of the GUIDs of readers, with and without key (RTPS 2.5, 9.3.1.2).
const READER_KINDS: [u8; 2] = [0x04, 0x07];

/// A service; requests are answered until it is dropped.
pub(crate) struct DdsService {
    _events: EventLoop,
}

impl DdsService {
    pub(super) fn open(
        node: &Arc<DdsNode>,
        link: &Link,
        type_name: &str,
        handler: Handler,
    ) -> Result<Self, TransportError> {
        let failed = |error: io::Error| middleware(link, "offer the service", &error);
        let wait = EventLoop::poll().map_err(failed)?;
        let mut worker = Worker::open(node, link, type_name, handler)?;
        wait.0
            .registry()
            .register(&mut worker.requests, Token(1), Interest::READABLE)
            .map_err(failed)?;
        let events = EventLoop::start("dds service", link.clone(), wait, move |_| worker.respond());
        Ok(Self { _events: events.map_err(failed)? })
    }
}

impl Served for DdsService {}

/// Receives requests and publishes responses.
struct Worker {
    link: Link,
    requests: SimpleDataReader<Vec<u8>, PassThrough>,
    responses: DataWriter<Body, PassThrough>,
    handler: Handler,
    /// DDS topic of the responses.
    topic: String,
    node: Arc<DdsNode>,
}

impl Worker {
    fn open(
        node: &Arc<DdsNode>,
        link: &Link,
        type_name: &str,
        handler: Handler,
    ) -> Result<Self, TransportError> {
        let failed = |error| middleware(link, "offer the service", &error);
        let [request_type, response_type] = service_types(type_name);
        let topic = |name, kind| {
            let topic = node.participant.create_topic(name, kind, &qos::topic(), TopicKind::NoKey);
            topic.map_err(failed)
        };
        let name = format!("rr{}Reply", link.topic);
        let responses = topic(name.clone(), response_type)?;
        let policies = Some(PublisherQos::Reliable.policies(None));
        let responses = node
            .graph
            .add_writer(link, || node.publisher.create_datawriter_no_key(&responses, policies))
            .map_err(failed)?;
        let requests = topic(format!("rq{}Request", link.topic), request_type)?;
        let policies = Some(qos::reliable_reader());
        let requests = node
            .graph
            .add_reader(None, || {
                node.subscriber.create_simple_datareader_no_key(&requests, policies)
            })
            .map_err(failed)?;
        let (link, node) = (link.clone(), Arc::clone(node));
        Ok(Self { link, requests, responses, handler, topic: name, node })
    }

    /// Answers all requests that have arrived.
    fn respond(&mut self) {
        self.requests.drain_read_notifications();
        loop {
            match self.requests.try_take_one() {
                Ok(Some(request)) => self.respond_to(request),
                Ok(None) => break,
                Err(error) => tracing::warn!("{}: {error}", self.link),
            }
        }
    }

    fn respond_to(&mut self, request: DeserializedCacheChange<Vec<u8>>) {
        let identity = identity(&request);
        let is_cyclone = request_header::is_cyclone(request.writer_guid);
        let response = match is_cyclone {
            true => RequestHeader::split(&request.into_value()).and_then(|(header, request)| {
                (self.handler)(&request).map(|response| header.before(&response))
            }),
            false => (self.handler)(&request.into_value()),
        };
        let Some(message) = response else { return };
        if let Err(error) = self.publish(message, (!is_cyclone).then_some(identity)) {
            tracing::warn!("{}: {error}", self.link);
        }
    }

    /// Publishes a response, with the sample identity of the request unless its body has one.
    fn publish(&self, message: Vec<u8>, request: Option<SampleIdentity>) -> Result<(), String> {
        let Some(body) = Body::of(message.clone()) else { return Ok(()) };
        let options = WriteOptionsBuilder::new().source_timestamp(Timestamp::now());
        let Some(request) = request else {
            self.responses
                .write_with_options(body, options.build())
                .map_err(|error| error.to_string())?;
            return Ok(());
        };
        self.wait_for_reader(request);
        let options = options.related_sample_identity(request).build();
        let written =
            self.responses.write_with_options(body, options).map_err(|error| error.to_string())?;
        if !Response::is_large(&message) {
            return Ok(());
        }
        let response = Response { message: &message, request, written };
        response.send(&self.node, &self.topic, &self.responses).map_err(|error| error.to_string())
    }

    /// Waits until the reader of a response is matched, since RustDDS sends a volatile message to matched readers only, and
    /// a request may arrive before discovery has found the client. rmw_fastrtps does the same
    /// (`rmw_fastrtps_shared_cpp/src/rmw_response.cpp`).
    fn wait_for_reader(&self, request: SampleIdentity) {
        let client = request.writer_guid.to_bytes();
        // Fast DDS identifies a request by the reader of the response, others by the writer of the request.
        let identity = if READER_KINDS.contains(&client[15]) { &client[..] } else { &client[..12] };
        let is_matched = || {
            let writer = self.responses.guid();
            self.node.graph.has_reader(writer, |reader| reader.to_bytes().starts_with(identity))
        };
        let clock = Clock::start();
        while !is_matched() && clock.now() < DISCOVERY {
            thread::sleep(INTERVAL);
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.node.graph.remove_writer(self.responses.guid());
        self.node.graph.remove_reader(self.requests.guid());
    }
}

/// The sample identity of the response. Fast DDS leaves the sequence number of the request's identity unknown; that of the
/// message is used then.
fn identity(request: &DeserializedCacheChange<Vec<u8>>) -> SampleIdentity {
    let number = request.sequence_number;
    match request.related_sample_identity() {
        Some(identity) if identity.sequence_number == SequenceNumber::UNKNOWN => {
            SampleIdentity { sequence_number: number, ..identity }
        }
        Some(identity) => identity,
        None => SampleIdentity { writer_guid: request.writer_guid, sequence_number: number },
    }
}
