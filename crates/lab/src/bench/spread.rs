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
}
