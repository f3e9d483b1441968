//! The recorder: topics into a bag.
//!
//! 1. [`writer`]: messages into a bag, flushed at least once a second.
//! 2. [`intake`]: messages of one topic into a bounded queue.
//! 3. [`discovery`]: topics that appear while recording.
//! 4. [`recording`]: the loop from the queue into the bag.

mod discovery;
mod intake;
mod recording;
mod writer;

pub use discovery::{Reasons, TopicDiscovery};
pub use intake::Losses;
pub use recording::{RecordError, RecordingOptions, record};
pub use writer::Recorder;
