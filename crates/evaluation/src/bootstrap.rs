//! Percentile bootstrap intervals (B. Efron, "Bootstrap Methods: Another Look at the Jackknife", Annals of
//! Statistics 7(1), 1979).

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::Interval;

/// Number of resamples.
const RESAMPLES: usize = 1000;
/// Fixed, so that the same sample gives the same intervals.
const SEED: u64 = 1;
/// Probability below and above an interval.
const TAIL: f64 = 0.025;

/// Minimum number of scenes for an interval.
pub const MIN_SCENES: usize = 5;

/// Draws resamples.
pub struct Draw(ChaCha8Rng);

impl Draw {
    /// `count` indices below `count`, drawn with replacement.
    pub fn of(&mut self, count: usize) -> Vec<usize> {
        (0..count).map(|_| self.0.random_range(0..count)).collect()
    }
}

/// The 95 % intervals of `statistics`, which draws a resample and returns a fixed number of statistics of it.
pub fn bootstrap(mut statistics: impl FnMut(&mut Draw) -> Vec<f64>) -> Vec<Interval> {
    let mut draw = Draw(ChaCha8Rng::seed_from_u64(SEED));
    let drawn: Vec<Vec<f64>> = (0..RESAMPLES).map(|_| statistics(&mut draw)).collect();
    let interval = |number: usize| {
        let mut values: Vec<f64> = drawn.iter().map(|numbers| numbers[number]).collect();
        values.sort_by(f64::total_cmp);
        let cut = (TAIL * RESAMPLES as f64) as usize;
        Interval { lower: values[cut], upper: values[RESAMPLES - 1 - cut] }
    };
    (0..drawn.first().map_or(0, Vec::len)).map(interval).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interval_of_a_mean_matches_its_standard_error() {
        let sample: Vec<f64> = (0..400).map(|number| f64::from(number % 2)).collect();
        let mean = |draw: &mut Draw| {
            let chosen = draw.of(sample.len());
            vec![chosen.iter().map(|&one| sample[one]).sum::<f64>() / sample.len() as f64]
        };
        let [Interval { lower, upper }] = bootstrap(mean)[..] else { panic!("one number") };
        // 1.96 standard errors of 0.5 / sqrt(400).
        assert!((lower - 0.451).abs() < 0.006 && (upper - 0.549).abs() < 0.006, "{lower} {upper}");
    }
}
