//! Percentiles of times.

use std::time::Duration;

use serde::Serialize;

/// Median and 99th percentile of a time (ms).
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Spread {
    /// Median (ms).
    pub p50: f64,
    /// 99th percentile (ms).
    pub p99: f64,
}

impl Spread {
    /// Percentiles of times; NaN without any.
    pub(super) fn of(mut times: Vec<Duration>) -> Self {
        times.sort_unstable();
        let at = |percent: usize| {
            let time = times.get(times.len().saturating_sub(1) * percent / 100);
            time.map_or(f64::NAN, |time| time.as_secs_f64() * 1e3)
        };
        Self { p50: at(50), p99: at(99) }
    }
}

/// The longest times (ms).
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Tail {
    /// 99.9th percentile (ms).
    pub p999: f64,
    /// Longest time (ms).
    pub worst: f64,
}

impl Tail {
    /// The longest of times; NaN without any.
    pub(super) fn of(mut times: Vec<Duration>) -> Self {
        times.sort_unstable();
        let milliseconds =
            |time: Option<&Duration>| time.map_or(f64::NAN, |time| time.as_secs_f64() * 1e3);
        let p999 = times.get(times.len().saturating_sub(1) * 999 / 1000);
        Self { p999: milliseconds(p999), worst: milliseconds(times.last()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_of_the_times_are_below_the_median() {
        let times = (0..=100).rev().map(Duration::from_millis).collect();
        let Spread { p50, p99 } = Spread::of(times);
        assert_eq!((p50, p99), (50.0, 99.0));
        assert!(Spread::of(Vec::new()).p50.is_nan());
    }

    #[test]
    fn one_time_of_a_thousand_is_longer_than_the_tail() {
        let times = (0..=1_000).rev().map(Duration::from_millis).collect();
        let Tail { p999, worst } = Tail::of(times);
        assert_eq!((p999, worst), (999.0, 1_000.0));
        assert!(Tail::of(Vec::new()).worst.is_nan());
    }
}
