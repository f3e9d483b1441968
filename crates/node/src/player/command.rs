//! Commands to a player.

use crate::requests::{PendingRequest, RequestChannel};
use eddy_frames::Stamp;

/// Distance that a key skips forward or back (recorded s).
pub const SKIP: f64 = 5.0;

/// A command to a player.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PlayerCommand {
    /// Change nothing; return rate and pause.
    Status,
    /// Pause, or resume.
    TogglePause,
    /// Pause.
    Pause,
    /// Resume.
    Resume,
    /// Publish the next message now, paused or not.
    Next,
    /// Raise the rate by 10 %.
    Faster,
    /// Lower the rate by the same factor.
    Slower,
    /// Set the rate (playing time per real time).
    Rate(f64),
    /// Continue at this recorded time.
    Seek(Stamp),
    /// Skip forward, or back if negative (recorded s).
    Skip(f64),
}

/// The outcome of a command, and the state of the player since.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CommandOutcome {
    /// Whether the command was carried out.
    pub done: bool,
    /// Playing time per real time.
    pub rate: f64,
    /// Whether the player is paused.
    pub paused: bool,
}

/// Sends commands to a player on another thread.
pub type PlayerHandle = RequestChannel<PlayerCommand, CommandOutcome>;

/// A command that the player has not accepted yet.
pub type PendingCommand = PendingRequest<PlayerCommand, CommandOutcome>;
