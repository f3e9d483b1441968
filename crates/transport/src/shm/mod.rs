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
//! of `Particle` with a [`FrameHeader`](layout::FrameHeader); every other message as
//! CDR bytes. An event service of the same name wakes readers: event 0 is a new sample.
//!
//! Overflow and buffer length belong to the service and are fixed by whoever creates it. eddy
//! creates services without overflow and with room for 32 messages a reader, so that one service serves
//! blocking and dropping publishers alike: it is the publisher that waits for a full reader or passes
//! it over. A service made by another program is taken as it is.
//!
//! A frame's `frame_id` does not travel: readers see `world`, whatever the bytes given to
//! [`publish_cdr`](super::Publisher::publish_cdr) said.
#![expect(unsafe_code, reason = "types in shared memory promise their layout")]

#[cfg(feature = "lab")]
pub(super) mod bare;
pub(super) mod layout;
mod lent;
mod publisher;
mod service;
mod subscriber;

use std::{num::NonZeroUsize, sync::Arc, time::Duration};

use iceoryx2::service::port_factory::PortFactory as _;

#[cfg(feature = "lab")]
use super::BarePublisher;
use super::{
    Link, Publisher, Reliability, SeenTopic, Subscriber, TransportError, TransportOptions,
    middleware::Middleware, opener::is_frames,
};
pub use lent::SharedFrame;
pub use service::SharedMemory;

use eddy_messages::TypeSupport;
#[cfg(feature = "lab")]
use eddy_messages::{Message, ParticleFrame};
use layout::{FrameHeader, SharedParticle};
use publisher::{BytesPublisher, FramePublisher, Outlet};
use service::Services;
use subscriber::{BytesSubscriber, FrameSubscriber, Inlet};

/// This process among the users of shared memory.
pub(super) struct ShmNode {
    services: Services,
    /// How long a publisher that blocks waits for a subscriber.
    patience: Duration,
}

impl ShmNode {
    pub(super) fn open(link: &Link, options: &TransportOptions) -> Result<Self, TransportError> {
        let services = Services::open(link, &options.node_name)?;
        Ok(Self { services, patience: options.patience })
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
        _kept: Option<NonZeroUsize>,
    ) -> Result<Box<dyn Publisher>, TransportError> {
        let (events, cleaner) = (self.services.events(link)?, self.services.cleaner());
        let type_name = support.name.as_str();
        let patience = self.patience;
        Ok(if is_frames(type_name) {
            let topic = self.services.topic::<SharedParticle, FrameHeader>(link, type_name)?;
            let outlet = Outlet::open(link, topic, &events, cleaner, reliability, patience)?;
            Box::new(FramePublisher { outlet })
        } else {
            let topic = self.services.topic::<u8, ()>(link, type_name)?;
            let outlet = Outlet::open(link, topic, &events, cleaner, reliability, patience)?;
            Box::new(BytesPublisher { outlet, type_name: type_name.to_owned() })
        })
    }

    fn subscriber(
        self: Arc<Self>,
        link: &Link,
        support: &TypeSupport,
    ) -> Result<Box<dyn Subscriber>, TransportError> {
        let (events, cleaner) = (self.services.events(link)?, self.services.cleaner());
        let type_name = support.name.as_str();
        Ok(if is_frames(type_name) {
            let topic = self.services.topic::<SharedParticle, FrameHeader>(link, type_name)?;
            let borrowable = topic.static_config().subscriber_max_borrowed_samples();
            let inlet = Inlet::open(link, &topic, &events, cleaner)?;
            Box::new(FrameSubscriber::new(inlet, borrowable))
        } else {
            let topic = self.services.topic::<u8, ()>(link, type_name)?;
            Box::new(BytesSubscriber { inlet: Inlet::open(link, &topic, &events, cleaner)? })
        })
    }

    fn shared_memory(
        &self,
        link: &Link,
        type_name: &str,
    ) -> Result<Option<SharedMemory>, TransportError> {
        Ok(Some(if is_frames(type_name) {
            SharedMemory::of(&self.services.topic::<SharedParticle, FrameHeader>(link, type_name)?)
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
        let outlet =
            Outlet::open(link, topic, &events, cleaner, Reliability::Block, self.patience)?;
        Ok(Some(Box::new(bare::Untouched { outlet, particles })))
    }
}
