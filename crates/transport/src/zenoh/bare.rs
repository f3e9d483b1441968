//! Zenoh used directly: sessions with eddy's settings, bytes without attachment.

use std::time::Duration;

use zenoh::{
    Session, Wait, handlers::FifoChannelHandler, pubsub, qos::CongestionControl, sample::Sample,
};

use super::{config, middleware};
use crate::{
    Link, TransportError, TransportOptions,
    bare::{BarePair, BarePublisher, BareSubscriber},
};
use eddy_frames::Frame;
use eddy_messages::FrameCdr;

struct Publisher {
    link: Link,
    bytes: Vec<u8>,
    publisher: pubsub::Publisher<'static>,
    _session: Session,
}

struct Subscriber {
    link: Link,
    subscriber: pubsub::Subscriber<FifoChannelHandler<Sample>>,
    _session: Session,
}

/// Publisher and subscriber with a session each.
pub(crate) fn pair(
    link: &Link,
    options: &TransportOptions,
    frame: &Frame,
) -> Result<BarePair, TransportError> {
    let key = format!("bare{}", link.topic);
    let [(there, _), (here, _)] = [config::open(link, options)?, config::open(link, options)?];
    let subscriber = there
        .declare_subscriber(key.clone())
        .wait()
        .map_err(|error| middleware(link, "declare the subscriber", &error))?;
    let publisher = here
        .declare_publisher(key)
        .congestion_control(CongestionControl::Block)
        .wait()
        .map_err(|error| middleware(link, "declare the publisher", &error))?;
    let (link, bytes) = (link.clone(), frame.to_cdr());
    let publisher = Publisher { link: link.clone(), bytes, publisher, _session: here };
    Ok((Box::new(publisher), Box::new(Subscriber { link, subscriber, _session: there })))
}

impl BarePublisher for Publisher {
    fn publish(&mut self) -> Result<(), TransportError> {
        self.publisher
            .put(self.bytes.clone())
            .wait()
            .map_err(|error| middleware(&self.link, "publish", &error))
    }
}

impl BareSubscriber for Subscriber {
    fn receive(&mut self, timeout: Duration) -> Result<bool, TransportError> {
        let sample = self.subscriber.recv_timeout(timeout);
        let sample = sample.map_err(|error| middleware(&self.link, "receive", &error))?;
        Ok(sample.is_some())
    }
}
