//! Shared memory (iceoryx2): subscribers read frames where the publisher wrote them.
//!
//! 1. [`layout`]: memory layout of a frame.
//! 2. [`service`]: opens the services of a topic and removes the resources of killed processes; [`names`]: what they are called;
//!    [`failure`]: why iceoryx2 fails.
//! 3. [`publisher`]: writes messages into loaned memory, sends them and wakes the subscribers; [`backpressure`]: which of
//!    them it waits for.
//! 4. [`subscriber`]: waits for messages; [`shared_frame`]: a frame that is read in place.
//! 5. [`bare`]: iceoryx2 used directly, for benchmarks.
//!
//! The service of a topic is called `eddy<topic>`, such as `eddy/particles`, and in a ROS domain other than 0
//! `eddy<domain>:<topic>`. Frames are sent as a slice of `Particle` with
//! a [`FrameHeader`](layout::FrameHeader), those of three dimensions in a service of their own ([`names`]), other messages as CDR bytes. An
//! event service of the topic wakes subscribers: event 0 is a new sample.
//!
//! Overflow and buffer length are properties of the service, set by its creator. eddy creates services without overflow
//! and with buffers of 32 messages, which serve blocking and dropping publishers alike: the publisher waits for a
//! subscriber with a full buffer, or skips it. Services created by other programs are used as they are.
//!
//! The `frame_id` of a frame is not transmitted: subscribers see `world`.
#![expect(unsafe_code, reason = "types in shared memory guarantee their layout")]

mod backpressure;
#[cfg(feature = "lab")]
pub(super) mod bare;
mod failure;
pub(super) mod layout;
mod names;
mod publisher;
mod service;
mod shared_frame;
mod subscriber;

use std::sync::Arc;

use iceoryx2::service::port_factory::PortFactory as _;

#[cfg(feature = "lab")]
use super::BarePublisher;
use super::{
    Link, Publisher, Reliability, SeenTopic, Subscriber, TransportError, TransportOptions,
    descriptors::Cost, middleware::Middleware, patience::Patience, transports::is_frames,
};
pub use service::SharedMemory;
pub use shared_frame::SharedFrame;

#[cfg(feature = "lab")]
use eddy_messages::{Message, ParticleFrame};
use eddy_messages::{QosProfile, TypeSupport};
use layout::{FrameHeader, SharedParticle};
use publisher::{BytesPublisher, FramePublisher, Writer};
use service::Services;
use subscriber::{BytesSubscriber, FrameSubscriber, Wakes};

/// Measured, with one port on the other side: a publisher opens 7 and 3 for each subscriber, a subscriber 8 and 2 for each publisher. For frames
/// of both dimensions a publisher opens 14 and 6, a subscriber 11 and 4.
pub(super) const COST: Cost = Cost { middleware: 4, publisher: 10, subscriber: 10, of_frames: 10 };

/// The shared memory of this process.
pub(super) struct ShmNode {
    services: Services,
    /// How long a blocking publisher waits for a subscriber.
    patience: Patience,
}

impl ShmNode {
    pub(super) fn open(
        link: &Link,
        options: &TransportOptions,
        patience: Patience,
    ) -> Result<Self, TransportError> {
        let services = Services::open(link, options)?;
        Ok(Self { services, patience })
    }
}

impl Middleware for ShmNode {
    fn topics(&self, link: &Link) -> Result<Vec<SeenTopic>, TransportError> {
        self.services.topics(link)
    }

    fn publisher(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
        reliability: Reliability,
        _offered: Option<QosProfile>,
    ) -> Result<Box<dyn Publisher>, TransportError> {
        let (events, cleaner) = (self.services.events(link)?, self.services.cleaner());
        let type_name = support.name.as_str();
        let patience = self.patience.clone();
        Ok(if is_frames(type_name) {
            let topic = self.services.topic::<SharedParticle, FrameHeader>(link, type_name)?;
            let plane = Writer::open(link, topic, &events, cleaner, reliability, patience)?;
            Box::new(FramePublisher { node: self, reliability, plane, space: None })
        } else {
            let topic = self.services.topic::<u8, ()>(link, type_name)?;
            let writer = Writer::open(link, topic, &events, cleaner, reliability, patience)?;
            Box::new(BytesPublisher { writer, type_name: type_name.to_owned() })
        })
    }

    fn subscriber(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
        _requested: Option<QosProfile>,
    ) -> Result<Box<dyn Subscriber>, TransportError> {
        let (events, cleaner) = (self.services.events(link)?, self.services.cleaner());
        let type_name = support.name.as_str();
        Ok(if is_frames(type_name) {
            let topic = self.services.topic::<SharedParticle, FrameHeader>(link, type_name)?;
            let borrowable = topic.static_config().subscriber_max_borrowed_samples();
            let space = subscriber::port(link, &self.services.space(link)?)?;
            let plane = subscriber::port(link, &topic)?;
            let wakes = Wakes::open(link, &events, cleaner)?;
            Box::new(FrameSubscriber::new(wakes, plane, space, borrowable))
        } else {
            let topic = self.services.topic::<u8, ()>(link, type_name)?;
            let subscriber = subscriber::port(link, &topic)?;
            Box::new(BytesSubscriber { wakes: Wakes::open(link, &events, cleaner)?, subscriber })
        })
    }

    fn shared_memory(
        &self,
        link: &Link,
        type_name: &str,
    ) -> Result<Option<SharedMemory>, TransportError> {
        Ok(Some(if is_frames(type_name) {
            let plane = self.services.topic::<SharedParticle, FrameHeader>(link, type_name)?;
            let (memory, space) = (SharedMemory::of(&plane), self.services.space(link)?);
            SharedMemory { bytes: memory.bytes + SharedMemory::of(&space).bytes, ..memory }
        } else {
            SharedMemory::of(&self.services.topic::<u8, ()>(link, type_name)?)
        }))
    }

    #[cfg(feature = "lab")]
    fn untouched(
        &self,
        link: &Link,
        particles: usize,
    ) -> Result<Option<Box<dyn BarePublisher>>, TransportError> {
        let (events, cleaner) = (self.services.events(link)?, self.services.cleaner());
        let topic =
            self.services.topic::<SharedParticle, FrameHeader>(link, ParticleFrame::TYPE)?;
        let writer =
            Writer::open(link, topic, &events, cleaner, Reliability::Block, self.patience.clone())?;
        Ok(Some(Box::new(bare::Untouched { writer, particles })))
    }
}
