//! The only place that reads the system's clocks. Everything else takes the time as an argument.
#![expect(clippy::disallowed_methods, reason = "the only place that reads the clocks")]

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crate::Stamp;

/// A monotonic clock that starts at zero.
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

/// System time since the Unix epoch.
pub fn wall() -> Stamp {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Stamp(i64::try_from(since_epoch.as_nanos()).unwrap_or(i64::MAX))
}
