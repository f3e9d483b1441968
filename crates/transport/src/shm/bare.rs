//! iceoryx2 used directly, with wake-ups by events, and eddy's publisher without writing.

use std::time::Duration;

use iceoryx2::{
    node::Node,
    port::{listener::Listener, notifier::Notifier, publisher, subscriber},
    prelude::*,
};

use super::{
    layout::{self, FrameHeader, SharedParticle},
    publisher::Writer,
    service::{Ipc, middleware},
};
use crate::{
    Link, TransportError,
    bare::{BarePair, BarePublisher, BareSubscriber},
};
use eddy_frames::Frame;

struct Publisher {
    link: Link,
    header: FrameHeader,
    particles: Vec<SharedParticle>,
    touched: bool,
    publisher: publisher::Publisher<Ipc, [SharedParticle], FrameHeader>,
    notifier: Notifier<Ipc>,
    _node: Node<Ipc>,
}

struct Subscriber {
    link: Link,
    subscriber: subscriber::Subscriber<Ipc, [SharedParticle], FrameHeader>,
    listener: Listener<Ipc>,
    _node: Node<Ipc>,
}

/// Publisher and subscriber of a service with iceoryx2's defaults.
pub(crate) fn pair(link: &Link, frame: &Frame, touched: bool) -> Result<BarePair, TransportError> {
    let failed = |action| move |error: &dyn std::fmt::Display| middleware(link, action, error);
    let name: ServiceName = format!("bare{}", link.topic)
        .as_str()
        .try_into()
        .map_err(|_| failed("name the service")(&"the topic has too long a name"))?;
    let node = || NodeBuilder::new().create::<Ipc>().map_err(|e| failed("open shared memory")(&e));
    let (here, there) = (node()?, node()?);
    let samples = |node: &Node<Ipc>| {
        node.service_builder(&name)
            .publish_subscribe::<[SharedParticle]>()
            .user_header::<FrameHeader>()
            .open_or_create()
            .map_err(|error| failed("open the service")(&error))
    };
    let events = |node: &Node<Ipc>| {
        let builder = node.service_builder(&name).event();
        builder.open_or_create().map_err(|error| failed("open the event service")(&error))
    };
    let listener = events(&there)?.listener_builder().create();
    let subscriber = samples(&there)?.subscriber_builder().create();
    let notifier = events(&here)?.notifier_builder().create();
    let publisher = samples(&here)?.publisher_builder().initial_max_slice_len(frame.len()).create();
    let publisher = Publisher {
        link: link.clone(),
        header: frame.into(),
        particles: (0..frame.len()).map(|index| layout::particle(frame, index)).collect(),
        touched,
        publisher: publisher.map_err(|error| failed("open the publisher")(&error))?,
        notifier: notifier.map_err(|error| failed("open the notifier")(&error))?,
        _node: here,
    };
    let subscriber = Subscriber {
        link: link.clone(),
        subscriber: subscriber.map_err(|error| failed("open the subscriber")(&error))?,
        listener: listener.map_err(|error| failed("open the listener")(&error))?,
        _node: there,
    };
    Ok((Box::new(publisher), Box::new(subscriber)))
}

impl BarePublisher for Publisher {
    fn publish(&mut self) -> Result<(), TransportError> {
        let mut loan = self
            .publisher
            .loan_slice_uninit(self.particles.len())
            .map_err(|error| middleware(&self.link, "loan memory", &error))?;
        *loan.user_header_mut() = self.header;
        let written = if self.touched {
            loan.write_from_slice(&self.particles)
        } else {
            // SAFETY: shared memory is zeroed when it is allocated, and any bits are a valid particle.
            unsafe { loan.assume_init() }
        };
        written.send().map_err(|error| middleware(&self.link, "send", &error))?;
        let woken = self.notifier.notify();
        woken.map(|_| ()).map_err(|error| middleware(&self.link, "wake", &error))
    }
}

impl BareSubscriber for Subscriber {
    fn receive(&mut self, timeout: Duration) -> Result<bool, TransportError> {
        self.listener
            .timed_wait(|_| {}, timeout)
            .map_err(|error| middleware(&self.link, "wait for messages", &error))?;
        let sample = self.subscriber.receive();
        let sample = sample.map_err(|error| middleware(&self.link, "receive", &error))?;
        Ok(sample.is_some())
    }
}

/// eddy's publisher, which does not write the particles.
pub(super) struct Untouched {
    pub(super) writer: Writer<SharedParticle, FrameHeader>,
    pub(super) particles: usize,
}

impl BarePublisher for Untouched {
    fn publish(&mut self) -> Result<(), TransportError> {
        // SAFETY: as above.
        self.writer
            .send(self.particles, FrameHeader::default(), |loan| unsafe { loan.assume_init() })
    }
}
