//! Whether and when to restart a failed process.

use std::time::Duration;

use super::RestartPlan;

/// Consecutive failures of one process.
#[derive(Clone, Copy, Debug)]
pub(super) struct Backoff {
    plan: RestartPlan,
    failures: u32,
}

impl Backoff {
    pub(super) fn new(plan: RestartPlan) -> Self {
        Self { plan, failures: 0 }
    }

    /// Whether this process has ever failed.
    pub(super) fn has_failed(&self) -> bool {
        self.failures > 0
    }

    /// Maximum number of consecutive restarts.
    pub(super) fn limit(&self) -> u32 {
        self.plan.limit
    }

    /// Delay before the restart of a process that failed after `running`; `None` when it has failed too often.
    pub(super) fn failed(&mut self, running: Duration) -> Option<Duration> {
        if running.as_secs_f64() >= self.plan.calm {
            self.failures = 0;
        }
        if self.failures == self.plan.limit {
            return None;
        }
        let doubled = self.plan.delay * f64::from(self.failures.min(30)).exp2();
        self.failures += 1;
        Some(Duration::from_secs_f64(doubled.min(self.plan.longest)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLAN: RestartPlan = RestartPlan { delay: 0.5, longest: 3.0, limit: 5, calm: 30.0 };

    fn seconds(delay: Option<Duration>) -> Option<f64> {
        delay.map(|delay| delay.as_secs_f64())
    }

    #[test]
    fn each_consecutive_restart_waits_twice_as_long_up_to_the_longest() {
        let mut backoff = Backoff::new(PLAN);
        let delays: Vec<_> =
            (0..6).map(|_| seconds(backoff.failed(Duration::from_secs(1)))).collect();
        assert_eq!(delays, [Some(0.5), Some(1.0), Some(2.0), Some(3.0), Some(3.0), None]);
    }

    #[test]
    fn failures_are_forgotten_after_a_calm_time() {
        let mut backoff = Backoff::new(PLAN);
        for _ in 0..100 {
            assert_eq!(seconds(backoff.failed(Duration::from_secs(30))), Some(0.5));
        }
    }

    #[test]
    fn without_restarts_the_first_failure_is_the_last() {
        let mut backoff = Backoff::new(RestartPlan { limit: 0, ..PLAN });
        assert_eq!(backoff.failed(Duration::ZERO), None);
    }
}
