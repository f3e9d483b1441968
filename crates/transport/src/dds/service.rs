//! Answers the requests of a service.
//!
//! Requests arrive on the topic `rq<service>Request`; responses are published on `rr<service>Reply` with the sample
//! identity of the request (OMG DDS-RPC 1.0, 7.8.2, "enhanced" mapping, which rmw_fastrtps uses). Requests and responses of
//! rmw_cyclonedds have their identity in the body: [`request_header`](super::request_header).

use std::{io, sync::Arc};

use ros2_client::dds::rustdds::{
    RTPSEntity, SampleIdentity, SequenceNumber, TopicKind, WriteOptionsBuilder,
    mio1::{Interest, Token},
    no_key::{DataWriter, DeserializedCacheChange, SimpleDataReader},
};

use super::{
    DdsNode,
    cdr::{Body, PassThrough},
    event_loop::EventLoop,
    middleware,
    qos::{self, PublisherQos},
    request_header::{self, RequestHeader},
    service_types,
};
use crate::{Handler, Link, Served, TransportError};

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
        let responses = topic(format!("rr{}Reply", link.topic), response_type)?;
        let responses = node
            .publisher
            .create_datawriter_no_key(&responses, Some(PublisherQos::Reliable.policies(None)))
            .map_err(failed)?;
        let requests = topic(format!("rq{}Request", link.topic), request_type)?;
        let requests: SimpleDataReader<Vec<u8>, PassThrough> = node
            .subscriber
            .create_simple_datareader_no_key(&requests, Some(qos::reliable_reader()))
            .map_err(failed)?;
        node.graph.add_writer(responses.guid(), link);
        node.graph.add_reader(requests.guid(), None);
        Ok(Self { link: link.clone(), requests, responses, handler, node: Arc::clone(node) })
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
        let response = match request_header::is_cyclone(request.writer_guid) {
            true => RequestHeader::split(&request.into_value()).and_then(|(header, request)| {
                (self.handler)(&request).map(|response| header.before(&response))
            }),
            false => (self.handler)(&request.into_value()),
        };
        let Some(response) = response.and_then(Body::of) else { return };
        let options = WriteOptionsBuilder::new().related_sample_identity(identity).build();
        if let Err(error) = self.responses.write_with_options(response, options) {
            tracing::warn!("{}: {error}", self.link);
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
