//! Publishers and subscribers on several transports: one small pair of traits, one folder per middleware.
//!
//! 1. `link`: a transport and a topic, written `zenoh:/particles`.
//! 2. [`Publisher`], [`Subscriber`]: implemented by every transport; [`Payload`]: one message.
//! 3. `transports`: [`Transports`] opens them, with one session per middleware and process; `middleware`: the trait that
//!    each middleware implements.
//! 4. `discovered`: topics found on a transport.
//! 5. `queue`: the bounded queue between a middleware's thread and a subscriber.
//! 6. `membership`: groups of processes that share work.
//! 7. `patience`: how long a blocking publisher waits; `descriptors`: file descriptors of this process.
//! 8. `memory`: within this process.
//! 9. `shm`: shared memory (iceoryx2).
//! 10. `zenoh`: the wire format of ROS 2's rmw_zenoh.
//! 11. `dds`: the wire format of ROS 2's DDS middlewares (RTPS).
//! 12. `foxglove`: a WebSocket server for Foxglove's application, publishing only; `address`: where it listens.
//! 13. `bare`: middleware without eddy's layers, for benchmarks.
//!
//! A topic of type `eddy_msgs/msg/ParticleFrame` carries frames; every other topic carries CDR bytes.
//! A transport may carry frames in its own form (shared memory does), so subscribers of frames must expect every
//! variant of [`Payload`].

mod address;
#[cfg(feature = "lab")]
mod bare;
#[cfg(feature = "dds")]
mod dds;
mod descriptors;
mod discovered;
#[cfg(feature = "lab")]
pub mod foreign;
#[cfg(feature = "foxglove")]
mod foxglove;
mod link;
mod membership;
mod memory;
mod middleware;
mod patience;
mod payload;
mod qos;
mod queue;
#[cfg(feature = "shm")]
mod shm;
mod transports;
#[cfg(feature = "zenoh")]
mod zenoh;

pub use link::{is_absolute_name, is_name_token};
pub use queue::{Producer, PushError, Queue};

#[cfg(feature = "foxglove")]
pub use self::foxglove::{FoxgloveAddress, FoxgloveServer, NotServed};
pub use address::{InvalidAddress, ListenAddress};
#[cfg(feature = "lab")]
pub use bare::{BarePair, BarePublisher, BareSubscriber};
pub use link::{InvalidLink, Link, TransportKind};
pub use membership::{Lease, Membership};
pub use payload::Payload;
pub use qos::default_qos;
#[cfg(feature = "shm")]
pub use shm::{SharedFrame, SharedMemory};

pub use discovered::{SeenService, SeenTopic};
pub use transports::{
    DdsOptions, DiscoveryRange, PublisherOptions, TopicType, TransportOptions, Transports,
    ZenohOptions,
};

use std::{
    path::PathBuf,
    sync::{Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use serde::Deserialize;

use eddy_frames::Frame;
use eddy_messages::{BadFrame, InvalidDefinition, UnknownService, UnknownType};

use patience::Patience;

/// What a publisher does when a subscriber cannot keep up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Reliability {
    /// Wait for the subscriber, at most 30 s if it reads nothing, then not until it reads again; no other message is lost.
    /// Advertised to ROS 2 as reliable, keep all.
    Block,
    /// Drop the message; the publisher never waits. Advertised to ROS 2 as keep last, frames as best effort.
    Drop,
}

/// Publishes messages on a topic.
pub trait Publisher: Send {
    /// Publishes a frame in the form of the transport.
    ///
    /// # Errors
    /// [`TransportError`]; the publisher stays usable. After [`TransportError::Stalled`] and
    /// [`TransportError::Interrupted`], the other subscribers have the message.
    fn publish_frame(&mut self, frame: &Frame) -> Result<(), TransportError>;

    /// Publishes a message as CDR bytes with their header.
    ///
    /// # Errors
    /// As [`Publisher::publish_frame`]; also on a topic of frames when the bytes are not a frame and the transport
    /// cannot carry them.
    fn publish_cdr(&mut self, bytes: &[u8]) -> Result<(), TransportError>;

    /// Waits until subscribers have what was published, as far as the transport knows; for the end of a program.
    ///
    /// # Errors
    /// [`TransportError::Undelivered`] when they do not within the patience.
    fn flush(&mut self) -> Result<(), TransportError> {
        Ok(())
    }

    /// Number of connected subscribers, as far as the transport knows.
    fn subscribers(&self) -> usize;
}

/// Receives the messages of a topic.
pub trait Subscriber: Send {
    /// The next message, or `None` when none arrives within `timeout`.
    ///
    /// # Errors
    /// [`TransportError`] when the transport fails. A message that is not a valid frame is not an error here: it is
    /// delivered as CDR bytes.
    fn receive(&mut self, timeout: Duration) -> Result<Option<Payload>, TransportError>;

    /// Number of messages that the transport could not deliver.
    fn lost(&self) -> u64;
}

/// Maps the CDR of a request to the CDR of its response; `None` if there is no response.
pub type Handler = Box<dyn FnMut(&[u8]) -> Option<Vec<u8>> + Send>;

/// A service; requests are answered until it is dropped.
pub trait Served: Send {}

/// Why a transport fails.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the message of each variant says what its fields are")]
pub enum TransportError {
    /// The message type is not part of eddy-messages.
    #[error(transparent)]
    Type(#[from] UnknownType),
    /// The service type is not part of eddy-messages.
    #[error(transparent)]
    Service(#[from] UnknownService),
    /// Bytes on a topic of frames are not a valid frame.
    #[error("{link}: {reason}")]
    Frame { link: Link, reason: BadFrame },
    /// The topic has another message type.
    #[error("{link}: found message type {found}, expected {expected}")]
    TopicType { link: Link, found: String, expected: String },
    /// A publisher defines its type in another way than it announces.
    #[error("{link}: {error}")]
    Definition { link: Link, error: InvalidDefinition },
    /// An environment variable, or a part of it, cannot be used.
    #[error("{variable}: found `{found}`, expected {expected}")]
    Environment { variable: &'static str, found: String, expected: String },
    /// A subscriber read nothing for [`TransportOptions::patience`] and missed a message. It is not waited for until it
    /// reads again.
    #[error(
        "{link}: {subscriber} has read nothing for {seconds} s and misses messages; check that it is running, or use --reliability drop"
    )]
    Stalled { link: Link, subscriber: String, seconds: f64 },
    /// The program was asked to stop while a blocking publisher waited for a subscriber, which missed a message.
    #[error("{link}: {subscriber} reads nothing and is not waited for at the end")]
    Interrupted { link: Link, subscriber: String },
    /// Subscribers do not have everything that was published.
    #[error(
        "{link}: up to {messages} messages were not delivered to {subscriber}, within {seconds:.1} s after the last one"
    )]
    Undelivered { link: Link, subscriber: String, messages: u64, seconds: f64 },
    /// The message is too large for the transport (bytes).
    #[error(
        "{link}: found a message of {found} bytes, expected at most {limit} (use shm or zenoh for larger ones)"
    )]
    TooLarge { link: Link, found: usize, limit: usize },
    /// The name of the topic or the node is too long for the transport (bytes).
    #[error("{link}: found a name of {found} bytes, expected at most {limit}")]
    LongName { link: Link, found: usize, limit: usize },
    /// This process may not open as many files as the transport needs.
    #[error(
        "{link}: needs {needed} more open files, found {open} open of {limit}, the most that this process may open: raise the \
         limit (`ulimit -n {}`, `nofile` in /etc/security/limits.conf, LimitNOFILE= in a systemd unit, docker's --ulimit) or \
         use fewer topics",
        open.saturating_add(*needed)
    )]
    Descriptors { link: Link, needed: u64, open: u64, limit: u64 },
    /// Files of shared memory belong to another user.
    #[error(
        "{link}: found {} of the user with id {owner}, expected files of the user with id {user}, who runs this program: run \
         all programs that share memory as one user, or set `root-path` and `prefix` below [global] in \
         ~/.config/iceoryx2/iceoryx2.toml of this one",
        path.display()
    )]
    OtherUser { link: Link, path: PathBuf, owner: u32, user: u32 },
    /// The transport has no groups.
    #[error(
        "group: found {link}, expected a topic on zenoh, whose liveliness tokens say who is alive"
    )]
    NoGroups { link: Link },
    /// This program was built without the transport.
    #[error(
        "{link}: this program was built without this transport (feature `{}` of eddy-transport)",
        link.transport
    )]
    NotBuilt { link: Link },
    /// The middleware reports an error.
    #[error("{link}: {action}: {reason}")]
    Middleware { link: Link, action: &'static str, reason: String },
}

impl TransportError {
    /// Whether a subscriber missed a message because it was not waited for any longer. The publisher stays usable.
    pub fn is_missed(&self) -> bool {
        matches!(self, Self::Stalled { .. } | Self::Interrupted { .. })
    }

    /// A subscriber that is not waited for misses a message.
    fn missed(link: &Link, subscriber: String, patience: &Patience) -> Self {
        let link = link.clone();
        if patience.is_stopped() {
            return Self::Interrupted { link, subscriber };
        }
        Self::Stalled { link, subscriber, seconds: patience.limit().as_secs_f64() }
    }
}

/// Locks a mutex. A panic in another thread leaves its contents consistent: every change is one operation.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
