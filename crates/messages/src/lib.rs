//! ROS 2 messages: Rust structs for the `.msg` files, their CDR encoding, schema text and type hashes.
//!
//! 1. [`messages`]: one Rust struct per message, with the fields of the `.msg` file.
//! 2. [`cdr`]: encoding and decoding (CDR, XCDR1, little-endian header `00 01 00 00`).
//! 3. `library`: the built-in `.msg` texts. `definition`: the language of these files.
//! 4. [`schema`]: the `.msg` text with its dependencies, as stored in MCAP files, and the type
//!    description parsed from it. [`type_descriptions`]: definitions from the nodes that use a type.
//! 5. [`services`], [`playback`], [`lifecycle`]: requests and responses, also one struct each.
//! 6. [`service_type`]: the `.srv` files and their type hashes.
//!    [`dynamic`]: messages of any type.
//! 7. [`convert`]: [`Frame`](eddy_frames::Frame) from and to its message. `tools`: tools and their poses.
//! 8. `dds_type`: type names in DDS. [`qos`]: quality of service.
//! 9. [`cloud`]: a frame as `PointCloud2`, for programs that do not know `ParticleFrame`.
//!
//! The `.msg` and `.srv` files in `msgs/` are the source of truth: schema text and type hashes are derived from them,
//! and a test compares the structs with them.

pub mod cdr;
pub mod cloud;
mod convert;
mod dds_type;
mod definition;
pub mod dynamic;
mod library;
pub mod lifecycle;
mod messages;
pub mod playback;
pub mod qos;
pub mod schema;
pub mod service_type;
pub mod services;
mod tools;
pub mod type_descriptions;

pub use convert::{BadFrame, FrameCdr, UnusableFrame};
pub use dds_type::{dds_type, ros_type};
pub use definition::InvalidDefinition;
pub use library::{names as built_in_types, text_of as built_in_text};
pub use messages::{
    Clock, DiagnosticArray, DiagnosticStatus, Header, KeyValue, Log, ParameterEvent, ParticleFrame,
    Point, PointCloud2, PointField, Pose, PoseStamped, PredictionStatus, Quaternion, RosString,
    StreamState, TFMessage, Time, Tool, ToolDescription, ToolFrame, ToolPart, Transform,
    TransformStamped, Twist, Vector3, Wrench,
};
pub use qos::{QosProfile, TOOL_DESCRIPTION_QOS};
pub use schema::{TypeSupport, UnknownType, type_support};
pub use service_type::{UnknownService, service_hash, service_messages};
pub use tools::{BadTool, tool_topics};

use serde::{Serialize, de::DeserializeOwned};

/// A message of a topic.
pub trait Message: Serialize + DeserializeOwned {
    /// Name of the type, such as `eddy_msgs/msg/ParticleFrame`.
    const TYPE: &'static str;
}

/// The message type of a topic of eddy, from the last part of its name: status, tools, description, cloud, fields, diagnostics,
/// clock, log, parameter events and transitions have fixed names, all other topics carry frames.
pub fn topic_type(topic: &str) -> &'static str {
    match topic.rsplit('/').next() {
        Some("status") => PredictionStatus::TYPE,
        Some("tools") => ToolFrame::TYPE,
        Some("description") => ToolDescription::TYPE,
        Some("diagnostics") => DiagnosticArray::TYPE,
        Some("clock") => Clock::TYPE,
        Some("cloud" | "fields") => PointCloud2::TYPE,
        Some("parameter_events") => ParameterEvent::TYPE,
        Some("rosout") => Log::TYPE,
        Some("transition_event") => lifecycle::TransitionEvent::TYPE,
        _ => ParticleFrame::TYPE,
    }
}

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_carry_frames_unless_their_last_part_says_otherwise() {
        let cases = [
            ("/particles", ParticleFrame::TYPE),
            ("/left/prediction", ParticleFrame::TYPE),
            ("/prediction/status", PredictionStatus::TYPE),
            ("/tools", ToolFrame::TYPE),
            ("/left/tools/description", ToolDescription::TYPE),
            ("/diagnostics", DiagnosticArray::TYPE),
            ("/clock", Clock::TYPE),
            ("/prediction/cloud", PointCloud2::TYPE),
            ("/parameter_events", ParameterEvent::TYPE),
            ("/rosout", Log::TYPE),
            ("/eddy_node/transition_event", lifecycle::TransitionEvent::TYPE),
        ];
        for (topic, expected) in cases {
            assert_eq!(topic_type(topic), expected, "{topic}");
        }
    }
}
