//! Statistics of the times between messages, as in `ros2 topic hz`.

use std::{collections::VecDeque, fmt, num::NonZeroUsize, time::Duration};

/// The times between the most recent messages.
#[derive(Clone, Debug)]
pub struct Rate {
    window: NonZeroUsize,
    last: Option<Duration>,
    /// Times between messages (s), oldest first.
    between: VecDeque<f64>,
}

impl Rate {
    /// Covers the last `window` intervals.
    pub fn new(window: NonZeroUsize) -> Self {
        Self { window, last: None, between: VecDeque::new() }
    }

    /// Records the arrival of a message.
    pub fn arrived(&mut self, now: Duration) {
        if let Some(last) = self.last.replace(now) {
            if self.between.len() == self.window.get() {
                self.between.pop_front();
            }
            self.between.push_back(now.saturating_sub(last).as_secs_f64());
        }
    }

    /// The statistics; `None` before the second message.
    pub fn statistics(&self) -> Option<RateStatistics> {
        let count = self.between.len();
        let mean = self.between.iter().sum::<f64>() / count as f64;
        let variance = |x: &f64| (x - mean).powi(2) / count as f64;
        (count > 0).then(|| RateStatistics {
            rate: 1.0 / mean,
            shortest: self.between.iter().copied().fold(f64::INFINITY, f64::min),
            longest: self.between.iter().copied().fold(0.0, f64::max),
            deviation: self.between.iter().map(variance).sum::<f64>().sqrt(),
            count,
        })
    }
}

/// Statistics of the times between messages.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RateStatistics {
    /// Mean rate (Hz).
    pub rate: f64,
    /// Shortest interval (s).
    pub shortest: f64,
    /// Longest interval (s).
    pub longest: f64,
    /// Standard deviation of the intervals (s).
    pub deviation: f64,
    /// Number of intervals.
    pub count: usize,
}

impl fmt::Display for RateStatistics {
    /// The two lines of `ros2 topic hz`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { rate, shortest, longest, deviation, count } = self;
        writeln!(f, "average rate: {rate:.3}")?;
        write!(
            f,
            "\tmin: {shortest:.3}s max: {longest:.3}s std dev: {deviation:.5}s window: {count}"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(window: usize, milliseconds: &[u64]) -> Option<RateStatistics> {
        let mut rate = Rate::new(NonZeroUsize::new(window).unwrap());
        for &time in milliseconds {
            rate.arrived(Duration::from_millis(time));
        }
        rate.statistics()
    }

    #[test]
    fn two_messages_are_needed() {
        assert_eq!(of(10, &[]), None);
        assert_eq!(of(10, &[5]), None);
    }

    #[test]
    fn statistics_cover_the_times_between_messages() {
        let text = of(10, &[0, 10, 40, 60]).unwrap().to_string();
        let expected =
            "average rate: 50.000\n\tmin: 0.010s max: 0.030s std dev: 0.00816s window: 3";
        assert_eq!(text, expected);
    }

    #[test]
    fn only_the_last_messages_count() {
        let statistics = of(2, &[0, 1000, 1010, 1020]).unwrap();
        assert_eq!(statistics.count, 2);
        assert!((statistics.rate - 100.0).abs() < 1e-6, "{statistics:?}");
    }
}
