//! The nodes' logic: what happens when a frame arrives, without any concrete transport.
//!
//! 1. [`surrogate`]: frame in, predictions out; which frames are used and which are refused.
//! 2. [`track`]: what the node knows of one stream: hidden state, sequence, warm-up, free run.
//! 3. [`counters`]: everything that was dropped, and why.
//! 4. [`queue`]: bounded, between a subscriber and the node.
//! 5. [`diagnostics`]: counters, rate and latency as a `diagnostic_msgs/DiagnosticArray`.
//! 6. [`driver`]: receives, predicts, publishes, until told to end.
//! 7. `cache`: what waits to be recorded, bounded in bytes.
//! 8. `recorder`: what arrives into a bag.
//! 9. `player`: a bag as it was recorded: which message is due when; `read_ahead` has it ready,
//!    `timeline` knows rates and pauses, `keys` what the user wants.
//! 10. `playback`: plays, until told to end.

mod cache;
mod counters;
pub mod diagnostics;
mod driver;
mod keys;
mod playback;
mod player;
mod queue;
mod read_ahead;
mod recorder;
mod settings;
mod surrogate;
mod timeline;
mod track;

#[cfg(test)]
mod tests;

pub use cache::{Cache, Producer, Taken};
pub use counters::{Counters, Refusal};
pub use driver::{Outputs, drive};
pub use keys::Wish;
pub use playback::{Stage, play};
pub use player::{Due, Player, PlayerError, PlayerOptions};
pub use queue::FrameQueue;
pub use recorder::Recorder;
pub use settings::{InvalidSettings, NodeSettings, Publish};
pub use surrogate::{Prediction, SurrogateNode};
