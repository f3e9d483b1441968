//! Predictions of the next frame only, each from the truth before it.

use super::errors::{difference, square};
use crate::dataset::State;

/// Squared position errors of predicted next frames over the windows of rollouts, for comparison with
/// them: one entry a frame ahead.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepSums {
    /// Particles summed over.
    pub count: Vec<f64>,
    /// Sum of |r_k|^2, r_k being the error of the frame that is k ahead of the start, predicted from
    /// the true one before (domain lengths squared).
    pub single: Vec<f64>,
    /// Sum of |r_1 + ... + r_k|^2: where the predicted steps, put end to end, would have led (domain
    /// lengths squared).
    pub cumulated: Vec<f64>,
}

impl StepSums {
    /// No errors yet, for `horizon` frames ahead.
    pub fn new(horizon: usize) -> Self {
        let zero = || vec![0.0; horizon];
        Self { count: zero(), single: zero(), cumulated: zero() }
    }

    /// Adds the sums of other windows.
    pub fn merge(&mut self, other: &Self) {
        for (sums, others) in [
            (&mut self.count, &other.count),
            (&mut self.single, &other.single),
            (&mut self.cumulated, &other.cumulated),
        ] {
            sums.iter_mut().zip(others).for_each(|(sum, other)| *sum += other);
        }
    }

    /// Root mean square of |r_k| (domain lengths), one entry a frame ahead.
    pub fn single_rmse(&self) -> Vec<f64> {
        self.rmse(&self.single)
    }

    /// Root mean square of |r_1 + ... + r_k| (domain lengths), one entry a frame ahead.
    pub fn cumulated_rmse(&self) -> Vec<f64> {
        self.rmse(&self.cumulated)
    }

    fn rmse(&self, sums: &[f64]) -> Vec<f64> {
        sums.iter().zip(&self.count).map(|(sum, count)| (sum / count).sqrt()).collect()
    }
}

/// Follows a stream and adds the errors of next frames to every window that is open.
pub(super) struct Follower<'a> {
    starts: &'a [usize],
    /// r_1 + ... + r_k of each window, `[N, 2]` once it is open.
    sums: Vec<Vec<[f64; 2]>>,
    total: StepSums,
}

impl<'a> Follower<'a> {
    /// Nothing was followed yet; windows open after the frames `starts`.
    pub(super) fn new(starts: &'a [usize], horizon: usize) -> Self {
        Self { starts, sums: vec![Vec::new(); starts.len()], total: StepSums::new(horizon) }
    }

    /// The frame `index` was predicted like this, and was like that. A position that is no number
    /// counts as that of the frame before, `last`.
    pub(super) fn add(
        &mut self,
        index: usize,
        predicted: &[[f32; 2]],
        last: &State,
        truth: &State,
    ) {
        let horizon = self.total.count.len();
        let error = |particle: usize| {
            let position = predicted[particle];
            let whole = position.iter().all(|x| x.is_finite());
            let position = if whole { position } else { last.position[particle] };
            difference(position, truth.position[particle])
        };
        for (&start, sums) in self.starts.iter().zip(&mut self.sums) {
            if !(start + 1..=start + horizon).contains(&index) {
                continue;
            }
            let ahead = index - start - 1;
            sums.resize(truth.position.len(), [0.0; 2]);
            for (particle, sum) in sums.iter_mut().enumerate() {
                let [x, y] = error(particle);
                *sum = [sum[0] + x, sum[1] + y];
                self.total.count[ahead] += 1.0;
                self.total.single[ahead] += square([x, y]);
                self.total.cumulated[ahead] += square(*sum);
            }
        }
    }

    /// The errors.
    pub(super) fn finish(self) -> StepSums {
        self.total
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f32) -> State {
        State { position: vec![[x, 0.0]], velocity: vec![[0.0; 2]] }
    }

    #[test]
    fn a_constant_error_stays_as_it_is_and_adds_up() {
        let starts = [0, 2];
        let mut follower = Follower::new(&starts, 3);
        for index in 1..5 {
            follower.add(index, &[[0.5, 0.0]], &at(0.0), &at(0.25));
        }
        let sums = follower.finish();
        assert_eq!(sums.count, [2.0, 2.0, 1.0]);
        assert_eq!(sums.single_rmse(), [0.25; 3]);
        assert_eq!(sums.cumulated_rmse(), [0.25, 0.5, 0.75]);
    }

    #[test]
    fn a_prediction_that_is_no_number_counts_as_no_movement() {
        let mut follower = Follower::new(&[0], 1);
        follower.add(1, &[[f32::NAN, 0.0]], &at(1.0), &at(0.5));
        assert_eq!(follower.finish().single_rmse(), [0.5]);
    }
}
