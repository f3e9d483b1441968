//! The one place that asks the system for the time. Everything else gets it as an argument.
#![expect(clippy::disallowed_methods, reason = "the one place that asks")]

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crate::Stamp;

/// A clock that never goes back, counted from its start.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    start: Instant,
}

impl Clock {
    /// Starts at zero.
    pub fn start() -> Self {
        Self { start: Instant::now() }
    }

    /// Time since the start.
    pub fn now(&self) -> Duration {
        self.start.elapsed()
    }
}

/// The system's time of day, since the Unix epoch.
pub fn wall() -> Stamp {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Stamp(i64::try_from(since_epoch.as_nanos()).unwrap_or(i64::MAX))
}
