//! The bag player: a bag onto topics, at its recorded pace.
//!
//! 1. [`timeline`]: real time to playing time, with rates and pauses.
//! 2. [`command`]: commands by keys, services or the live page. [`keys`]: keys of a terminal.
//! 3. `read_ahead`: messages are read before they are due.
//! 4. [`options`] and [`schedule`]: which message is due when.
//! 5. [`playback`]: the loop that waits and publishes.
//! 6. [`plan`]: what of the bag is published, where, and what is left out.
//! 7. [`outputs`]: a publisher for every planned topic, and one for the clock.
//! 8. [`services`]: the services of rosbag2's player.
//! 9. [`pacer`]: a simulation in place of a bag.

mod command;
mod keys;
mod options;
mod outputs;
mod pacer;
mod plan;
mod playback;
mod read_ahead;
mod schedule;
mod services;
mod timeline;

pub use command::{CommandOutcome, PendingCommand, PlayerCommand, PlayerHandle, SKIP};
pub use keys::parse_keys;
pub use options::{PlayerError, PlayerOptions};
pub use outputs::{PlayedTopic, TopicOutputs};
pub use pacer::Pacer;
pub use plan::{OutputOptions, PlanError, PlannedTopic, PlaybackPlan};
pub use playback::{PlaybackSink, PlaybackStatus, play};
pub use schedule::{Due, Executed, LongPause, Player};
pub use services::{PlayerServices, player_services};
pub use timeline::Timeline;
