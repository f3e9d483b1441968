//! Rust twins of the `.srv` files of rosbag2's player (`rosbag2_interfaces`), field by field; those without
//! fields are [`Empty`](super::services::Empty).

use serde::{Deserialize, Serialize};

use super::Time;

/// Response of `PlayNext`, `SetRate` and `Seek`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Success {
    /// Whether it was done.
    pub success: bool,
}

/// Response of `IsPaused`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Paused {
    /// Whether the player pauses.
    pub paused: bool,
}

/// Request of `SetRate`, response of `GetRate`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PlayingRate {
    /// How much faster than recorded.
    pub rate: f64,
}

/// Request of `Seek`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SeekRequest {
    /// Recorded time.
    pub time: Time,
}
