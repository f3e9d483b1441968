//! The bag player: a bag onto topics, at its recorded pace.
//!
//! 1. [`timeline`]: real time to playing time, with rates and pauses.
//! 2. [`command`]: commands by keys, services or the live page. [`keys`]: keys of a terminal.
//! 3. `read_ahead`: messages are read before they are due.
//! 4. [`options`] and [`schedule`]: which message is due when.
//! 5. [`playback`]: the loop that waits and publishes.
//! 6. [`outputs`]: a publisher for every topic of the bag, and one for the clock.
//! 7. [`services`]: the services of rosbag2's player.
//! 8. [`pacer`]: a simulation in place of a bag.

mod command;
mod keys;
mod options;
mod outputs;
mod pacer;
mod playback;
mod read_ahead;
mod schedule;
mod services;
mod timeline;

pub use command::{CommandOutcome, PendingCommand, PlayerCommand, PlayerHandle, SKIP};
pub use keys::parse_keys;
pub use options::{PlayerError, PlayerOptions};
pub use outputs::{OutputError, OutputOptions, PlayedTopic, TopicOutputs, playable_topics};
pub use pacer::Pacer;
pub use playback::{PlaybackSink, PlaybackStatus, play};
pub use schedule::{Due, Executed, Player};
pub use services::{PlayerServices, player_services};
pub use timeline::Timeline;
