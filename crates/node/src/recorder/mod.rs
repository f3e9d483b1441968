//! The recorder: topics into a bag.
//!
//! 1. [`writer`]: messages into a bag, flushed at least once a second.
//! 2. [`intake`]: messages of one topic into a bounded queue.
//! 3. [`definitions`]: subscribers, and the definitions of their types.
//! 4. [`discovery`]: topics that are published, now or later.
//! 5. [`recording`]: the loop from the queue into the bag.

mod definitions;
mod discovery;
mod intake;
mod recording;
mod writer;

pub use definitions::{OpenTopic, TopicOpener};
pub use discovery::{Reasons, TopicDiscovery};
pub use intake::Losses;
pub use recording::{RecordError, RecordingOptions, record};
pub use writer::Recorder;
