//! How long a blocking publisher waits for a subscriber that does not read.

use std::{
    sync::{
        Arc, OnceLock,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use eddy_frames::clock::Clock;

/// How long all publishers together go on waiting after the stop flag was raised.
pub(crate) const GRACE: Duration = Duration::from_millis(500);
/// Longest wait before the stop flag is checked.
const SLICE: Duration = Duration::from_millis(20);

/// How long a blocking publisher waits: up to a limit, and hardly longer than a stop flag is raised.
#[derive(Clone, Debug)]
pub(crate) struct Patience {
    limit: Duration,
    stop: Arc<AtomicBool>,
    /// Runs since a publisher first saw the flag raised.
    stopped: Arc<OnceLock<Clock>>,
}

impl Patience {
    pub(crate) fn new(limit: Duration, stop: Arc<AtomicBool>) -> Self {
        Self { limit, stop, stopped: Arc::default() }
    }

    /// Longest wait without a stop.
    pub(crate) fn limit(&self) -> Duration {
        self.limit
    }

    /// Time since the stop flag was first seen raised.
    fn since_stop(&self) -> Option<Duration> {
        let is_raised = self.stop.load(Ordering::Relaxed);
        is_raised.then(|| self.stopped.get_or_init(Clock::start).now())
    }

    /// Whether the program was asked to stop.
    pub(crate) fn is_stopped(&self) -> bool {
        self.since_stop().is_some()
    }

    /// Time left after `waited`.
    pub(crate) fn left(&self, waited: Duration) -> Duration {
        let left = self.limit.saturating_sub(waited);
        self.since_stop().map_or(left, |since| left.min(GRACE.saturating_sub(since)))
    }

    /// Repeats `attempt`, which waits for as long as it is told, until it succeeds. The last attempt does not wait.
    /// `None` when the patience is over.
    pub(crate) fn wait<T>(&self, mut attempt: impl FnMut(Duration) -> Option<T>) -> Option<T> {
        let clock = Clock::start();
        loop {
            let left = self.left(clock.now());
            if let Some(done) = attempt(left.min(SLICE)) {
                return Some(done);
            }
            if left.is_zero() {
                return None;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;

    fn never(slice: Duration) -> Option<()> {
        thread::sleep(slice);
        None
    }

    #[test]
    fn a_wait_ends_at_the_limit() {
        let patience = Patience::new(Duration::from_millis(60), Arc::default());
        let (clock, mut attempts) = (Clock::start(), 0);
        let counted = |slice| {
            attempts += 1;
            never(slice)
        };
        assert_eq!(patience.wait(counted), None);
        assert!(clock.now() >= Duration::from_millis(60));
        assert!(attempts >= 2, "{attempts}");
    }

    #[test]
    fn a_stop_ends_all_waits_together() {
        let stop = Arc::<AtomicBool>::default();
        let patience = Patience::new(Duration::from_secs(600), Arc::clone(&stop));
        assert!(!patience.is_stopped());
        thread::scope(|scope| {
            let waits = [(); 2].map(|()| scope.spawn(|| patience.wait(never)));
            stop.store(true, Ordering::Relaxed);
            let clock = Clock::start();
            for wait in waits {
                assert_eq!(wait.join().unwrap(), None);
            }
            assert!(clock.now() < GRACE + Duration::from_secs(5));
        });
        // The grace is not granted again.
        assert_eq!(patience.left(Duration::ZERO), Duration::ZERO);
        assert_eq!(patience.wait(|_| Some(7)), Some(7), "what is possible at once is done");
    }
}
