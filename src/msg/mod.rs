//! ROS 2 messages: Rust twins of the `.msg` files, their bytes and their names.
//!
//! 1. [`twins`]: one Rust struct a message, field by field as in `msgs/`.
//! 2. [`cdr`]: struct to bytes and back (CDR, XCDR1, little-endian header `00 01 00 00`).
//! 3. [`schema`]: the `.msg` text with its dependencies, as MCAP files carry it, and the type
//!    description parsed from it.
//! 4. [`convert`]: [`Frame`](crate::frame::Frame) from and to its message.
//!
//! The `.msg` files in `msgs/` are the source of truth: schema text and type hash come from them,
//! and a test holds the twins against them.

pub mod cdr;
mod convert;
pub mod schema;
mod twins;

pub use convert::BadFrame;
pub use schema::{TypeSupport, UnknownType, type_support};
pub use twins::{
    Clock, DiagnosticArray, DiagnosticStatus, Header, KeyValue, ParticleFrame, PredictionStatus,
    RosString, StreamState, Time,
};

use serde::{Serialize, de::DeserializeOwned};

/// A message that travels on a topic.
pub trait Message: Serialize + DeserializeOwned {
    /// The type's name, such as `eddy_msgs/msg/ParticleFrame`.
    const TYPE: &'static str;
}
