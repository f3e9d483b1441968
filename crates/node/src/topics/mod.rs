//! Topics as a command line sees them: found, printed, measured.
//!
//! 1. [`find`]: wait until a topic is published.
//! 2. [`yaml`]: messages as text.
//! 3. [`rate`]: statistics of the times between messages.

mod find;
mod rate;
mod yaml;

pub use find::{FindError, MAX_FIND_TIME, find_topic};
pub use rate::{Rate, RateStatistics};
pub use yaml::message_text;
