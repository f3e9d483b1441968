//! Shared memory of this machine, by iceoryx2: frames are written where their readers read them.
//!
//! 1. [`layout`]: how a frame lies in memory.
//! 2. [`service`]: opens the services of a topic, whoever made them, and clears away what killed
//!    processes left.
//! 3. [`publisher`]: writes messages into loaned memory, sends them, wakes the readers.
//! 4. [`subscriber`]: waits, and lends what came; [`lent`]: a frame that is read where it lies.
//! 5. [`bare`]: iceoryx2 alone, to measure against.
//!
//! The service of a topic is called `eddy<topic>`, such as `eddy/particles`. Frames travel as a slice
//! of [`Particle`] with a [`FrameHeader`](layout::FrameHeader); every other message as
//! CDR bytes. An event service of the same name wakes readers: event 0 is a new sample.
//!
//! Overflow and buffer length belong to the service and are fixed by whoever creates it. eddy
//! creates services without overflow and with room for 32 messages a reader, so that one service serves
//! blocking and dropping publishers alike: it is the publisher that waits for a full reader or passes
//! it over. A service made by another program is taken as it is.
//!
//! A frame's `frame_id` does not travel: readers see `world`, whatever the bytes given to
//! [`publish_cdr`](super::Publisher::publish_cdr) said.

pub(super) mod bare;
pub(super) mod layout;
mod lent;
mod publisher;
mod service;
mod subscriber;

use std::time::Duration;

use iceoryx2::service::port_factory::PortFactory as _;

use super::{
    BarePublisher, Link, Publisher, Reliability, SeenTopic, Subscriber, TransportError,
    TransportOptions, opener::is_frames,
};
pub use lent::SharedFrame;
pub use service::SharedMemory;

use crate::{
    frame::Particle,
    msg::{Message, ParticleFrame},
};
use layout::FrameHeader;
use publisher::{BytesPublisher, FramePublisher, Outlet};
use service::Services;
use subscriber::{BytesSubscriber, FrameSubscriber, Inlet};

/// This process among the users of shared memory.
pub(super) struct ShmNode {
    services: Services,
}

impl ShmNode {
    pub(super) fn open(link: &Link, options: &TransportOptions) -> Result<Self, TransportError> {
        Ok(Self { services: Services::open(link, &options.node_name)? })
    }

    /// The memory that the publishers of a topic have made for it.
    pub(super) fn memory(
        &self,
        link: &Link,
        type_name: &str,
    ) -> Result<SharedMemory, TransportError> {
        Ok(if is_frames(type_name) {
            SharedMemory::of(&self.services.topic::<Particle, FrameHeader>(link, type_name)?)
        } else {
            SharedMemory::of(&self.services.topic::<u8, ()>(link, type_name)?)
        })
    }

    /// See [`Transports::untouched`](super::Transports::untouched).
    pub(super) fn untouched(
        &self,
        link: &Link,
        particles: usize,
        patience: Duration,
    ) -> Result<Box<dyn BarePublisher>, TransportError> {
        let (events, cleaner) = (self.services.events(link)?, self.services.cleaner());
        let topic = self.services.topic::<Particle, FrameHeader>(link, ParticleFrame::TYPE)?;
        let outlet = Outlet::open(link, topic, &events, cleaner, Reliability::Block, patience)?;
        Ok(Box::new(bare::Untouched { outlet, particles }))
    }

    pub(super) fn topics(&self, link: &Link) -> Result<Vec<SeenTopic>, TransportError> {
        self.services.topics(link)
    }

    pub(super) fn publisher(
        &self,
        link: &Link,
        type_name: &str,
        reliability: Reliability,
        patience: Duration,
    ) -> Result<Box<dyn Publisher>, TransportError> {
        let (events, cleaner) = (self.services.events(link)?, self.services.cleaner());
        Ok(if is_frames(type_name) {
            let topic = self.services.topic::<Particle, FrameHeader>(link, type_name)?;
            let outlet = Outlet::open(link, topic, &events, cleaner, reliability, patience)?;
            Box::new(FramePublisher { outlet })
        } else {
            let topic = self.services.topic::<u8, ()>(link, type_name)?;
            let outlet = Outlet::open(link, topic, &events, cleaner, reliability, patience)?;
            Box::new(BytesPublisher { outlet, type_name: type_name.to_owned() })
        })
    }

    pub(super) fn subscriber(
        &self,
        link: &Link,
        type_name: &str,
    ) -> Result<Box<dyn Subscriber>, TransportError> {
        let (events, cleaner) = (self.services.events(link)?, self.services.cleaner());
        Ok(if is_frames(type_name) {
            let topic = self.services.topic::<Particle, FrameHeader>(link, type_name)?;
            let borrowable = topic.static_config().subscriber_max_borrowed_samples();
            let inlet = Inlet::open(link, &topic, &events, cleaner)?;
            Box::new(FrameSubscriber::new(inlet, borrowable))
        } else {
            let topic = self.services.topic::<u8, ()>(link, type_name)?;
            Box::new(BytesSubscriber { inlet: Inlet::open(link, &topic, &events, cleaner)? })
        })
    }
}
