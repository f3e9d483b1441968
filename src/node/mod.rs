//! The nodes' logic: what happens when a frame arrives, without any concrete transport.
//!
//! 1. [`surrogate`]: frame in, predictions out; which frames are used and which are refused.
//! 2. [`track`]: what the node knows of one stream: hidden state, sequence, warm-up, free run.
//! 3. [`counters`]: everything that was dropped, and why.
//! 4. [`queue`]: bounded, between a subscriber and the node.
//! 5. [`diagnostics`]: counters, rate and latency as a `diagnostic_msgs/DiagnosticArray`.
//! 6. [`driver`]: receives, predicts, publishes, until told to end.
//! 7. [`control`]: what may be asked of a running node; `services`: how ROS asks it.
//! 8. `recorder`: what arrives into a bag.
//! 9. `player`: a bag as it was recorded: which message is due when.

mod control;
mod counters;
pub mod diagnostics;
mod driver;
mod player;
mod queue;
mod recorder;
mod services;
mod settings;
mod surrogate;
mod track;

#[cfg(test)]
mod tests;

pub use control::{Answer, Control, Request, Unanswered};
pub use counters::{Counters, Refusal};
pub use driver::{Outputs, drive};
pub use player::{Due, Player, PlayerError, PlayerOptions};
pub use queue::FrameQueue;
pub use recorder::Recorder;
pub use services::{Service, services};
pub use settings::{HORIZON, InvalidSettings, NodeSettings, Publish};
pub use surrogate::{Prediction, SurrogateNode};
