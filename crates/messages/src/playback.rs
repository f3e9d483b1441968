//! Requests and responses of rosbag2's player (`rosbag2_interfaces`); those without fields are
//! [`Empty`](super::services::Empty).

use serde::{Deserialize, Serialize};

use super::Time;

/// Response of `PlayNext`, `SetRate` and `Seek`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Success {
    /// Whether the request succeeded.
    pub success: bool,
}

/// Response of `IsPaused`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Paused {
    /// Whether the player is paused.
    pub paused: bool,
}

/// Request of `SetRate`, response of `GetRate`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PlayingRate {
    /// Factor of the recorded speed.
    pub rate: f64,
}

/// Request of `Seek`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SeekRequest {
    /// Recorded time.
    pub time: Time,
}
