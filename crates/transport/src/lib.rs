//! Publishers and subscribers on several transports: one small pair of traits, one folder per middleware.
//!
//! 1. `link`: a transport and a topic, written `zenoh:/particles`.
//! 2. [`Publisher`], [`Subscriber`]: implemented by every transport; [`Payload`]: one message.
//! 3. `opener`: [`Transports`] opens them, with one session per middleware and process; `middleware`: the trait that
//!    each middleware implements.
//! 4. `seen`: topics found on a transport.
//! 5. `queue`: the bounded queue between a middleware's thread and a subscriber.
//! 6. `memory`: within this process.
//! 7. `shm`: shared memory (iceoryx2).
//! 8. `zenoh`: the wire format of ROS 2's rmw_zenoh.
//! 9. `dds`: the wire format of ROS 2's DDS middlewares (RTPS).
//! 10. `foxglove`: a WebSocket server for Foxglove's application, publishing only; `address`: where it listens.
//! 11. `bare`: middleware without eddy's layers, for benchmarks.
//!
//! A topic of type `eddy_msgs/msg/ParticleFrame` carries frames; every other topic carries CDR bytes.
//! A transport may carry frames in its own form (shared memory does), so subscribers of frames must expect every
//! variant of [`Payload`].

mod address;
#[cfg(feature = "lab")]
mod bare;
#[cfg(feature = "dds")]
mod dds;
#[cfg(feature = "lab")]
pub mod foreign;
#[cfg(feature = "foxglove")]
mod foxglove;
mod link;
mod memory;
mod middleware;
mod opener;
mod payload;
mod queue;
mod seen;
#[cfg(feature = "shm")]
mod shm;
#[cfg(feature = "zenoh")]
mod zenoh;

pub use link::{is_absolute_name, is_name_token};
pub use queue::Queue;

#[cfg(feature = "foxglove")]
pub use self::foxglove::{FoxgloveAddress, FoxgloveServer, NotServed};
pub use address::{InvalidAddress, ListenAddress};
#[cfg(feature = "lab")]
pub use bare::{BarePair, BarePublisher, BareSubscriber};
pub use link::{InvalidLink, Link, TransportKind};
pub use payload::Payload;
#[cfg(feature = "shm")]
pub use shm::{SharedFrame, SharedMemory};

pub use opener::{DdsOptions, DiscoveryRange, TransportOptions, Transports, ZenohOptions};
pub use seen::SeenTopic;

use std::time::Duration;

use serde::Deserialize;

use eddy_frames::Frame;
use eddy_messages::{BadFrame, UnknownService, UnknownType};

/// What a publisher does when a subscriber cannot keep up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Reliability {
    /// Waits for the subscriber, at most [`TransportOptions::patience`]; nothing is lost.
    /// Advertised to ROS 2 as reliable, keep all.
    Block,
    /// Gives up the message; the publisher is never slowed. Advertised as best effort, keep last.
    Drop,
}

/// Sends the messages of one topic.
pub trait Publisher: Send {
    /// Sends a frame in the transport's own form.
    ///
    /// # Errors
    /// [`TransportError`] when the transport cannot take it; the publisher stays usable.
    fn publish_frame(&mut self, frame: &Frame) -> Result<(), TransportError>;

    /// Sends a message given as CDR bytes with their header.
    ///
    /// # Errors
    /// As [`Publisher::publish_frame`]; also when a topic of frames gets bytes that are no frame
    /// and the transport cannot carry them as they are.
    fn publish_cdr(&mut self, bytes: &[u8]) -> Result<(), TransportError>;

    /// How many subscribers are connected now, as far as the transport knows.
    fn subscribers(&self) -> usize;
}

/// Receives the messages of one topic.
pub trait Subscriber: Send {
    /// The next message, or `None` when none came within `timeout`.
    ///
    /// # Errors
    /// [`TransportError`] when the transport failed. A message that is no frame is not such a
    /// failure: it is delivered as CDR bytes, for the receiver to judge.
    fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError>;

    /// Messages that the transport could not deliver, since the start.
    fn refused(&self) -> u64;
}

/// Turns the CDR of a request into the CDR of its response; `None` where none can be given.
pub type Handler = Box<dyn FnMut(&[u8]) -> Option<Vec<u8>> + Send>;

/// A service that is answered as long as this lives.
pub trait Served: Send {}

/// Why a transport failed.
#[derive(Debug, thiserror::Error)]
pub enum TransportError {
    /// The topic's message type is not one of ours.
    #[error(transparent)]
    Type(#[from] UnknownType),
    /// The service's type is not one of ours.
    #[error(transparent)]
    Service(#[from] UnknownService),
    /// The topic carries frames, the bytes are none.
    #[error("{link}: {reason}")]
    Frame {
        /// The topic's link.
        link: Link,
        /// What is wrong with the bytes.
        reason: BadFrame,
    },
    /// The topic is in use for messages of another type.
    #[error("{link}: found message type {found}, expected {expected}")]
    TopicType {
        /// The topic's link.
        link: Link,
        /// The type that the topic carries.
        found: String,
        /// The type that was asked for.
        expected: String,
    },
    /// An environment variable cannot be used.
    #[error("{variable}: found `{found}`, expected {expected}")]
    Environment {
        /// Its name.
        variable: &'static str,
        /// Its value, or the part of it that is wrong.
        found: String,
        /// What it should be.
        expected: String,
    },
    /// A subscriber took nothing for as long as a blocking publisher is willing to wait.
    #[error(
        "{link}: found a subscriber that took nothing for {seconds} s, expected one that reads (or --reliability drop)"
    )]
    Stalled {
        /// The topic's link.
        link: Link,
        /// How long the publisher waited (s).
        seconds: f64,
    },
    /// The transport cannot carry so large a message soundly.
    #[error(
        "{link}: found a message of {found} bytes, expected at most {limit} (use shm or zenoh for larger ones)"
    )]
    TooLarge {
        /// The topic's link.
        link: Link,
        /// Its size (bytes).
        found: usize,
        /// The largest it carries (bytes).
        limit: usize,
    },
    /// This program was built without the transport.
    #[error(
        "{link}: found a transport that this program was built without, expected one it has (feature `{}` of eddy-transport)",
        link.transport
    )]
    NotBuilt {
        /// The topic's link.
        link: Link,
    },
    /// The middleware refused.
    #[error("{link}: {action}: {reason}")]
    Middleware {
        /// The topic's link.
        link: Link,
        /// What was tried.
        action: &'static str,
        /// What the middleware said, and what to do about it.
        reason: String,
    },
}

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
