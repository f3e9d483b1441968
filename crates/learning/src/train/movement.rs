//! Whether a run's weights move: how far they are from their start, and how much of Adam's step its epsilon takes away.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::{
    OptimizerConfig,
    optimizer::{Correction, Optimizer},
};
use eddy_inference::checkpoint::Weights;

/// Warn if epsilon reduces the steps by more than this share.
const MOST_EPSILON_SHARE: f64 = 0.9;

/// How far weights have moved, and what holds them back.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Movement {
    /// Distance of the weights from the initial ones, relative to the norm of these.
    pub(super) distance: f64,
    /// Mean of epsilon / (root + epsilon) over the weights, root being that of the corrected second moment: the share of a step
    /// of Adam that its epsilon takes away. 0 before the first step. Without the weights that Muon changes: the size of
    /// its steps does not depend on that of gradients.
    pub(super) epsilon_share: f64,
}

impl Movement {
    /// Of the weights after some steps.
    pub(super) fn of(
        initial: &BTreeMap<String, Weights>,
        weights: &BTreeMap<String, Weights>,
        optimizer: &Optimizer,
        config: &OptimizerConfig,
    ) -> Self {
        let pairs = initial.iter().filter_map(|(name, before)| Some((before, weights.get(name)?)));
        let [mut moved, mut all] = [0.0; 2];
        for (before, after) in pairs {
            moved += sum(&before.values, &after.values, |before, after| (after - before).powi(2));
            all += sum(&before.values, &before.values, |before, _| before.powi(2));
        }
        let root = f64::from(Correction::new(optimizer.steps.max(1), 0.0, config).root);
        let epsilon = f64::from(config.epsilon);
        let share = |second: f64, _| epsilon / (second.sqrt() / root + epsilon);
        let second = || optimizer.moments_of_adam().map(|moments| moments.second.as_slice());
        let shares: f64 = second().map(|second| sum(second, second, share)).sum();
        let count = second().map(<[f32]>::len).sum::<usize>();
        let epsilon_share = if count > 0 { shares / count as f64 } else { 0.0 };
        Self { distance: (moved / all).sqrt(), epsilon_share }
    }

    /// What to do if the weights hardly move.
    pub(super) fn warning(&self, config: &OptimizerConfig) -> Option<String> {
        (self.epsilon_share > MOST_EPSILON_SHARE).then(|| {
            format!(
                "the weights hardly move: optimizer.epsilon = {:e} takes {:.1} % of each step away, because gradients are \
                 smaller (distance from the start {:.1e}); choose a loss with larger gradients (loss.kind = \"relative\") or a \
                 smaller epsilon",
                config.epsilon,
                100.0 * self.epsilon_share,
                self.distance
            )
        })
    }
}

/// Numbers of a part of [`sum`].
const PART: usize = 1 << 16;

/// The sum of `of` over pairs of numbers, in parts of fixed size: the same bits with any number of threads.
fn sum(left: &[f32], right: &[f32], of: impl Fn(f64, f64) -> f64 + Sync) -> f64 {
    let parts = left.par_chunks(PART).zip(right.par_chunks(PART)).map(|(left, right)| {
        left.iter().zip(right).map(|(&a, &b)| of(a.into(), b.into())).sum::<f64>()
    });
    parts.collect::<Vec<f64>>().iter().sum()
}

#[cfg(test)]
mod tests {
    use super::{
        super::{TrainConfig, optimizer::Moments},
        *,
    };
    use eddy_inference::checkpoint::Architecture;

    fn weights(values: &[f32]) -> BTreeMap<String, Weights> {
        let weights = Weights { shape: vec![values.len()], values: values.to_vec() };
        BTreeMap::from([("a".to_owned(), weights)])
    }

    #[test]
    fn gradients_far_below_epsilon_do_not_move_the_weights_and_are_said_so() {
        let mut config = TrainConfig::defaults(Architecture::Frame).optimizer;
        config.epsilon = 1e-8;
        let of = |gradient: f32| {
            // A second moment after many steps, whose correction is 1.
            let second = vec![gradient * gradient; 2];
            let moments = Moments { first: vec![gradient; 2], second, average: Vec::new() };
            let optimizer =
                Optimizer { steps: 100_000, moments: vec![moments], ..Optimizer::default() };
            Movement::of(&weights(&[3.0, 4.0]), &weights(&[3.0, 4.5]), &optimizer, &config)
        };
        let small = of(1e-12);
        assert!((small.distance - 0.1).abs() < 1e-9 && small.epsilon_share > 0.9998, "{small:?}");
        let said = small.warning(&config).unwrap();
        assert!(said.contains("optimizer.epsilon = 1e-8 takes 100.0 %"), "{said}");
        let even = of(1e-8);
        assert!((even.epsilon_share - 0.5).abs() < 1e-6, "{even:?}");
        assert_eq!(even.warning(&config), None);
        // Muon's steps are not smaller where gradients are.
        let moments =
            vec![Moments { first: vec![1e-12; 2], second: vec![0.0; 2], average: Vec::new() }];
        let muon = Optimizer { steps: 9, moments, matrices: vec![Some([1, 2])] };
        let moved = Movement::of(&weights(&[3.0, 4.0]), &weights(&[3.0, 4.5]), &muon, &config);
        assert_eq!(moved.epsilon_share, 0.0);
        let before =
            Movement::of(&weights(&[1.0]), &weights(&[1.0]), &Optimizer::default(), &config);
        assert_eq!(before, Movement { distance: 0.0, epsilon_share: 0.0 });
    }
}
