//! The nodes' logic: what happens when a frame arrives, without any concrete transport.
//!
//! 1. [`surrogate`]: frame in, predictions out; which frames are used and which are refused. `step`: what a
//!    frame does to its own stream.
//! 2. [`track`]: what the node knows of one stream: hidden state, sequence, warm-up, free run.
//! 3. [`counters`]: everything that was dropped, and why.
//! 4. [`queue`]: bounded, between a subscriber and the node.
//! 5. [`diagnostics`]: counters, rate and latency as a `diagnostic_msgs/DiagnosticArray`.
//! 6. [`driver`]: receives, predicts, publishes, until told to end.
//! 7. [`control`]: what may be asked of a running node, `requests` how it waits for an answer; `parameters`: the
//!    table of its settings; `services`: how ROS asks it; `ros_time`: what time it is for it; `cloud`: frames for
//!    those who look at them; [`onlooker`]: who sees them within this process.
//! 8. `cache`: what waits to be recorded, bounded in bytes.
//! 9. `recorder`: what arrives into a bag. [`recording`](record): the loop around it; `discovery`: which topics there
//!    are, `intake`: what arrives on each, until the cache is full.
//! 10. `player`: a bag as it was recorded: which message is due when; `read_ahead` has it ready,
//!     `timeline` knows rates and pauses, `wish` what the user wants.
//! 11. `playback`: plays, until told to end; `player_services` brings wishes from elsewhere.
//! 12. `rate`: how regularly messages arrive.

mod cache;
mod cloud;
mod control;
mod counters;
pub mod diagnostics;
mod discovery;
mod driver;
mod intake;
pub mod launch;
mod onlooker;
mod parameters;
mod playback;
mod player;
mod player_services;
mod queue;
mod rate;
mod read_ahead;
mod recorder;
mod recording;
mod requests;
pub mod ros;
mod ros_time;
mod services;
mod settings;
mod step;
mod surrogate;
mod timeline;
mod track;
pub mod viewer;
mod wish;

#[cfg(test)]
mod tests;

pub use cache::{Brought, Cache, Producer, Taken};
pub use cloud::CloudTopic;
pub use control::{Answer, Control, Request, Unanswered};
pub use counters::{Counters, Refusal};
pub use discovery::{Reasons, TopicSearch};
pub use driver::{Outputs, Presence, drive};
pub use intake::Losses;
pub use onlooker::Onlooker;
pub use parameters::{PARAMETERS, ParameterSpec, Values, parameter};
pub use playback::{Stage, play};
pub use player::{Due, Granted, Player, PlayerError, PlayerOptions};
pub use player_services::player_services;
pub use queue::FrameQueue;
pub use rate::{Figures, Rate};
pub use recorder::Recorder;
pub use recording::{RecordError, RecordingTerms, record};
pub use requests::{Pending, Reply, Requests};
pub use ros_time::{OpenClock, RosTime};
pub use services::{Service, services};
pub use settings::{InvalidSettings, NodeSettings, Publish};
pub use step::Prediction;
pub use surrogate::{Arrival, SurrogateNode, Tell};
pub use timeline::Timeline;
pub use wish::{Asked, Outcome, Remote, Wish};

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
