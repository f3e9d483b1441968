//! Errors lately, by frames ahead, and as time passes.

use std::collections::VecDeque;

use eddy_evaluation::Baseline;

/// Simulation time that errors are averaged over for each number of frames ahead (s), and pairs, at most.
const AVERAGED: f64 = 1.0;
const AVERAGED_PAIRS: usize = 1024;

/// Mean errors of predictions so many frames ahead, over the second of simulation time before the last of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Summary {
    /// Frames ahead.
    pub frames: u32,
    /// Root mean square of the position errors (domain lengths).
    pub error: f64,
    /// The best trivial baseline and the same of it.
    pub baseline: Option<(Baseline, f64)>,
}

/// One instant of the curve over time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Simulation time (s).
    pub time: f64,
    /// Of the model (domain lengths).
    pub error: f64,
    /// Of the best baseline (domain lengths).
    pub baseline: Option<f64>,
}

/// What a page draws below the frames.
#[derive(Clone, Debug, Default)]
pub struct Curves {
    /// Errors as time passes.
    pub time: Vec<Point>,
    /// Errors by frames ahead.
    pub ahead: Vec<Summary>,
}

/// Squared errors of one pair: the model's, and each baseline's.
#[derive(Clone, Copy, Debug)]
pub(super) struct Squared {
    /// Simulation time (s).
    pub(super) time: f64,
    pub(super) model: f64,
    pub(super) baselines: Option<[f64; Baseline::ALL.len()]>,
}

/// The last errors of one number of frames ahead.
#[derive(Debug, Default)]
pub(super) struct Recent {
    errors: VecDeque<Squared>,
    /// The count of pairs when it was used last.
    pub(super) used: u64,
}

impl Recent {
    /// One more; those from more than a second before, or after, go.
    pub(super) fn push(&mut self, squared: Squared) {
        let old = |first: &Squared| (squared.time - first.time).abs() >= AVERAGED;
        while self.errors.len() >= AVERAGED_PAIRS || self.errors.front().is_some_and(old) {
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

    pub(super) fn summary(&self, frames: u32) -> Option<Summary> {
        let count = self.errors.len();
        let mean = self.errors.iter().map(|squared| squared.model).sum::<f64>() / count as f64;
        let baseline = self.best().map(|(best, mean)| (best, mean.sqrt()));
        (count > 0).then(|| Summary { frames, error: mean.sqrt(), baseline })
    }
}
