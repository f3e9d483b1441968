//! Tools of robots: frames of particles and poses of cups and blades in, frames of tools out.
//!
//! 1. `file`: which tools there are and where their poses come from.
//! 2. `rigid`: positions and rotations and their motion. `track`: the poses of one source. `tree`: transforms between coordinate frames.
//! 3. `follower`: [`ToolFollower`], which pairs frames with poses; it knows neither transport nor clock. `warnings`: what it says, limited in number.
//! 4. `topics`: the topics of tools. `drive`: the loop that connects them.

mod drive;
mod file;
mod follower;
mod rigid;
#[cfg(test)]
mod tests;
mod topics;
mod track;
mod tree;
mod warnings;

pub use drive::{ToolInputs, follow};
pub use file::{FollowedTool, ToolsFile};
pub use follower::{FollowCounts, FramePlace, NoPose, ToolFollower};
pub use topics::{ToolTopics, delivered_or_missed};
