//! The surrogate node: frames in, predictions out.
//!
//! 1. [`parameter`]: what a setting may be. [`settings`]: the table of all settings; `options` (feature `clap`): the
//!    same as command-line options.
//! 2. [`counters`]: frames that were rejected, and why; losses. [`rejections`]: when that is said.
//! 3. `stream`: what the node keeps of one stream: hidden state, sequence, warm-up, free run.
//! 4. `steps`: what a frame does to its own stream, in parallel with other streams. `prediction`: what comes of it.
//! 5. [`node`]: which frames are used and what they do to the set of streams.
//! 6. [`queue`]: between the subscriber and the node.
//! 7. [`diagnostics`]: counters, rate and latency as `diagnostic_msgs/DiagnosticArray`. [`cloud`]: frames as point
//!    clouds. [`observer`]: the node's output within this process.
//! 8. [`lifecycle`]: states of a managed node. [`handle`]: requests to a running node. `services`: the same as ROS
//!    services.
//! 9. [`group`]: nodes that share streams.
//! 10. [`time`]: system time or `/clock`.
//! 11. [`driver`]: the loop that receives, predicts and publishes. `running`: its predicting side. `sink`: its publishing
//!     side. `failures`: logs errors of outputs; the node continues after them. `load`: measures whether the node keeps up
//!     with its input. `warnings`: logs missing and dropped frames.
//! 12. [`links`]: input and outputs. [`outputs`]: the topics that belong to an output. [`publishers`]: opens them. [`live`]:
//!     a node with all of them open.

mod cloud;
mod counters;
pub mod diagnostics;
mod driver;
mod failures;
mod group;
mod handle;
mod lifecycle;
mod links;
mod live;
mod load;
mod node;
mod observer;
#[cfg(feature = "clap")]
mod options;
mod outputs;
mod parameter;
mod prediction;
mod publishers;
mod queue;
mod rejections;
mod running;
mod services;
mod settings;
mod sink;
mod steps;
mod stream;
mod time;
mod warnings;

#[cfg(test)]
mod tests;

pub use cloud::CloudTopic;
pub use counters::{Counters, Rejection};
pub use driver::{DriveError, NodeContext, drive};
pub use group::{GroupCounts, GroupMember};
pub use handle::{NodeHandle, NodeRequest, NodeResponse, RequestError};
pub use lifecycle::{LifecycleState, LifecycleTransition, TRANSITIONS};
pub use links::{InvalidLinks, NodeLinks};
pub use live::{LiveNode, OpenError};
pub use node::{Arrival, OutputCallback, SurrogateNode};
pub use observer::{NodeReport, Observer};
#[cfg(feature = "clap")]
pub use options::{NodeOptions, PredictOptions};
pub use outputs::Outputs;
pub use parameter::Values;
pub use prediction::Prediction;
pub use queue::FrameQueue;
pub use rejections::{Rejected, RejectionLog};
pub use services::{lifecycle_services, node_services};
pub use settings::{InvalidSettings, NodeSettings, PARAMETERS, ParameterSpec, Publish, parameter};
pub use time::{OpenClock, RosTime};
