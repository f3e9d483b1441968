//! The nodes of eddy as a library: logic that takes the time as an argument and knows no concrete middleware, and the
//! loops that connect it to the links of `eddy-transport`.
//!
//! 1. `requests`: request and response between threads. `service`: a ROS service as bytes in, bytes out.
//! 2. [`ros`]: what `--ros-args` means.
//! 3. [`surrogate`]: the node that predicts.
//! 4. [`recorder`]: topics into a bag.
//! 5. [`player`]: a bag onto topics.
//! 6. [`topics`]: finding, printing and measuring topics.
//! 7. [`clients`]: services and parameters of other nodes.
//! 8. [`tools`]: poses of a robot's tools beside frames.
//! 9. [`viewer`]: the live page of any of them.
//! 10. [`launch`]: several processes from one file.

pub mod clients;
pub mod launch;
pub mod player;
pub mod recorder;
mod requests;
pub mod ros;
mod service;
pub mod surrogate;
pub mod tools;
pub mod topics;
pub mod viewer;

pub use player::{
    CommandOutcome, Pacer, PendingCommand, PlaybackSink, Player, PlayerCommand, PlayerError,
    PlayerHandle, PlayerOptions, Timeline, play,
};
pub use recorder::{Losses, RecordError, Recorder, RecordingOptions, TopicDiscovery, record};
pub use requests::{PendingRequest, RequestChannel, Responder};
pub use service::Service;
pub use surrogate::{
    Arrival, CloudTopic, Counters, DriveError, FrameQueue, GroupCounts, GroupMember, InvalidLinks,
    InvalidSettings, LiveNode, NodeContext, NodeHandle, NodeLinks, NodeReport, NodeRequest,
    NodeResponse, NodeSettings, Observer, OpenClock, OpenError, Outputs, PARAMETERS, ParameterSpec,
    Prediction, Publish, Rejected, Rejection, RejectionLog, RequestError, RosTime, SurrogateNode,
    Values, diagnostics, drive,
};

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
