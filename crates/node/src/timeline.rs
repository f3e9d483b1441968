//! How playing time runs: at a rate, not at all while paused.

use std::time::Duration;

/// Maps the time that passes to the time that is played, both from the start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Timeline {
    /// How much faster than recorded.
    rate: f64,
    paused: bool,
    /// A moment (ns that have passed), and what was played by then (recorded ns).
    anchor: (f64, f64),
}

impl Timeline {
    /// Runs from the start.
    pub fn new(rate: f64) -> Self {
        Self { rate, paused: false, anchor: (0.0, 0.0) }
    }

    /// How much faster than recorded.
    pub fn rate(&self) -> f64 {
        self.rate
    }

    /// Whether it stands still.
    pub fn is_paused(&self) -> bool {
        self.paused
    }

    /// What has been played by `now` (recorded ns).
    pub fn position(&self, now: Duration) -> f64 {
        let (moment, position) = self.anchor;
        let passed = if self.paused { 0.0 } else { now.as_nanos() as f64 - moment };
        position + passed * self.rate
    }

    /// How long it takes from `now` until so much is played (ns); never positive for what is due.
    /// `None` while paused.
    pub fn until(&self, position: f64, now: Duration) -> Option<f64> {
        let (moment, played) = self.anchor;
        (!self.paused).then(|| moment + (position - played) / self.rate - now.as_nanos() as f64)
    }

    /// Always possible: `true`.
    pub fn set_paused(&mut self, paused: bool, now: Duration) -> bool {
        self.jump(self.position(now), now);
        self.paused = paused;
        true
    }

    /// `false`, and nothing changes, unless the rate is a positive number.
    pub fn set_rate(&mut self, rate: f64, now: Duration) -> bool {
        let possible = rate.is_finite() && rate > 0.0;
        if possible {
            self.jump(self.position(now), now);
            self.rate = rate;
        }
        possible
    }

    /// Goes on from there.
    pub fn jump(&mut self, position: f64, now: Duration) {
        self.anchor = (now.as_nanos() as f64, position);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: f64 = 1e9;

    #[test]
    fn pauses_and_rates_bend_the_line_without_breaking_it() {
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
