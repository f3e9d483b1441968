//! Playing time as a function of real time: linear at a rate, constant while paused.

use std::time::Duration;

/// Maps real time to playing time, both since the start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Timeline {
    /// Playing time per real time.
    rate: f64,
    paused: bool,
    /// A real time and its playing time (ns).
    anchor: (f64, f64),
}

impl Timeline {
    /// Starts at zero.
    pub fn new(rate: f64) -> Self {
        Self { rate, paused: false, anchor: (0.0, 0.0) }
    }

    /// Playing time per real time.
    pub fn rate(&self) -> f64 {
        self.rate
    }

    /// Whether playing time is paused.
    pub fn is_paused(&self) -> bool {
        self.paused
    }

    /// Playing time at `now` (ns).
    pub fn position(&self, now: Duration) -> f64 {
        let (start, position) = self.anchor;
        let passed = if self.paused { 0.0 } else { now.as_nanos() as f64 - start };
        position + passed * self.rate
    }

    /// Real time from `now` until a playing time (ns), zero or negative if that has passed; `None` while paused.
    pub fn until(&self, position: f64, now: Duration) -> Option<f64> {
        let (start, played) = self.anchor;
        (!self.paused).then(|| start + (position - played) / self.rate - now.as_nanos() as f64)
    }

    /// Pauses or resumes; always returns `true`.
    pub fn set_paused(&mut self, paused: bool, now: Duration) -> bool {
        self.jump(self.position(now), now);
        self.paused = paused;
        true
    }

    /// Sets the rate. Returns `false` and changes nothing unless it is positive and finite.
    pub fn set_rate(&mut self, rate: f64, now: Duration) -> bool {
        let possible = rate.is_finite() && rate > 0.0;
        if possible {
            self.jump(self.position(now), now);
            self.rate = rate;
        }
        possible
    }

    /// Continues at another playing time (ns).
    pub fn jump(&mut self, position: f64, now: Duration) {
        self.anchor = (now.as_nanos() as f64, position);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: f64 = 1e9;

    #[test]
    fn pauses_and_rates_change_the_slope_without_a_jump() {
        let at = Duration::from_secs;
        let mut line = Timeline::new(2.0);
        assert_eq!(line.position(at(3)), 6.0 * SECOND);
        line.set_paused(true, at(3));
        assert_eq!((line.position(at(10)), line.until(7.0, at(10))), (6.0 * SECOND, None));
        line.set_paused(false, at(10));
        line.set_rate(0.5, at(11));
        assert_eq!(line.position(at(11)), 8.0 * SECOND);
        assert_eq!(line.until(9.0 * SECOND, at(11)), Some(2.0 * SECOND));
        for rate in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(!line.set_rate(rate, at(12)), "{rate}");
        }
        assert_eq!((line.rate(), line.position(at(11))), (0.5, 8.0 * SECOND));
        line.jump(0.0, at(20));
        assert_eq!(line.position(at(22)), SECOND);
    }
}
