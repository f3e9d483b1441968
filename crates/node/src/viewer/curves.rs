//! Recent errors, over time and by horizon.

use eddy_inference::engine::Baseline;
use std::collections::VecDeque;

/// Simulation time over which errors are averaged (s).
const WINDOW: f64 = 1.0;
/// Error of the best baseline below which skill is undefined (domain lengths): at rest it is exact.
const AT_REST: f64 = 1e-4;
/// Maximum number of pairs in the window.
const WINDOW_PAIRS: usize = 1024;

/// Mean errors at one horizon, over the last second of simulation time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Summary {
    /// Frames ahead.
    pub horizon: u32,
    /// Root mean square position error of the model (domain lengths).
    pub error: f64,
    /// The best trivial baseline and its error (domain lengths).
    pub baseline: Option<(Baseline, f64)>,
}

/// A point of the curve over time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Simulation time (s).
    pub time: f64,
    /// Error of the model (domain lengths).
    pub error: f64,
    /// Error of the best baseline (domain lengths).
    pub baseline: Option<f64>,
}

/// The curves below the particles.
#[derive(Clone, Debug, Default)]
pub struct Curves {
    /// Error over time.
    pub time: Vec<Point>,
    /// Error by frames ahead, for those that are predicted at present.
    pub by_horizon: Vec<Summary>,
    /// Mean errors over the last second at the horizon of the last pair.
    pub now: Option<Summary>,
}

impl Summary {
    /// 1 - squared error / squared error of the best baseline; `None` at rest, or without a baseline.
    pub fn skill(&self) -> Option<f64> {
        let (_, best) = self.baseline.filter(|&(_, best)| best > AT_REST)?;
        Some(1.0 - (self.error / best).powi(2))
    }
}

/// Squared errors of one pair (domain lengths squared).
#[derive(Clone, Copy, Debug)]
pub(super) struct Squared {
    /// Simulation time (s).
    pub(super) time: f64,
    pub(super) model: f64,
    pub(super) baselines: Option<[f64; Baseline::ALL.len()]>,
}

/// Recent errors at one horizon.
#[derive(Debug, Default)]
pub(super) struct Recent {
    errors: VecDeque<Squared>,
    /// Count of pairs at the last use, for eviction.
    pub(super) used: u64,
}

impl Recent {
    /// Adds a pair and drops pairs outside of the window.
    pub(super) fn push(&mut self, squared: Squared) {
        let old = |first: &Squared| (squared.time - first.time).abs() >= WINDOW;
        while self.errors.len() >= WINDOW_PAIRS || self.errors.front().is_some_and(old) {
            self.errors.pop_front();
        }
        self.errors.push_back(squared);
    }

    /// The baseline with the smallest mean of squared errors, and that mean.
    pub(super) fn best(&self) -> Option<(Baseline, f64)> {
        let known = || self.errors.iter().filter_map(|squared| squared.baselines);
        let count = known().count();
        let mean = |which: usize| known().map(|all| all[which]).sum::<f64>() / count as f64;
        let means = Baseline::ALL.into_iter().enumerate().map(|(i, one)| (one, mean(i)));
        means.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|_| count > 0)
    }

    pub(super) fn summary(&self, horizon: u32) -> Option<Summary> {
        let count = self.errors.len();
        let mean = self.errors.iter().map(|squared| squared.model).sum::<f64>() / count as f64;
        let baseline = self.best().map(|(best, mean)| (best, mean.sqrt()));
        (count > 0).then(|| Summary { horizon, error: mean.sqrt(), baseline })
    }
}
