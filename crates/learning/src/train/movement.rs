//! Whether a run's weights move: how far they are from their start, and how much of Adam's step its epsilon takes away.

use std::collections::BTreeMap;

use super::{
    OptimizerConfig,
    adam::{Adam, Correction},
};
use eddy_inference::checkpoint::Weights;

/// Share of the steps that epsilon takes away from which on a run is said not to move.
const LOST: f64 = 0.9;

/// How far weights have moved, and what holds them back.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Movement {
    /// Distance of the weights from the initial ones, relative to the norm of these.
    pub(super) distance: f64,
    /// Mean of epsilon / (root + epsilon) over all weights, root being that of the corrected second moment: the share of a step
    /// of Adam that its epsilon takes away. 0 before the first step.
    pub(super) lost: f64,
}

impl Movement {
    /// Of the weights after some steps.
    pub(super) fn of(
        initial: &BTreeMap<String, Weights>,
        weights: &BTreeMap<String, Weights>,
        adam: &Adam,
        config: &OptimizerConfig,
    ) -> Self {
        let pairs = initial.iter().filter_map(|(name, before)| Some((before, weights.get(name)?)));
        let [mut moved, mut all] = [0.0; 2];
        for (before, after) in pairs {
            for (&before, &after) in before.values.iter().zip(&after.values) {
                let (before, after) = (f64::from(before), f64::from(after));
                moved += (after - before).powi(2);
                all += before.powi(2);
            }
        }
        let root = f64::from(Correction::new(adam.steps.max(1), 0.0, config).root);
        let epsilon = f64::from(config.epsilon);
        let second = adam.moments.iter().flat_map(|moments| &moments.second);
        let (mut lost, mut count) = (0.0, 0.0);
        for &second in second {
            lost += epsilon / (f64::from(second).sqrt() / root + epsilon);
            count += 1.0;
        }
        Self { distance: (moved / all).sqrt(), lost: if count > 0.0 { lost / count } else { 0.0 } }
    }

    /// What to do if the weights hardly move.
    pub(super) fn warning(&self, config: &OptimizerConfig) -> Option<String> {
        (self.lost > LOST).then(|| {
            format!(
                "the weights hardly move: optimizer.epsilon = {:e} takes {:.1} % of each step away, because gradients are \
                 smaller (distance from the start {:.1e}); choose a loss with larger gradients (loss.kind = \"relative\") or a \
                 smaller epsilon",
                config.epsilon,
                100.0 * self.lost,
                self.distance
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::{
        super::{TrainConfig, adam::Moments},
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
            let adam = Adam { steps: 100_000, moments: vec![moments] };
            Movement::of(&weights(&[3.0, 4.0]), &weights(&[3.0, 4.5]), &adam, &config)
        };
        let small = of(1e-12);
        assert!((small.distance - 0.1).abs() < 1e-9 && small.lost > 0.9998, "{small:?}");
        let said = small.warning(&config).unwrap();
        assert!(said.contains("optimizer.epsilon = 1e-8 takes 100.0 %"), "{said}");
        let even = of(1e-8);
        assert!((even.lost - 0.5).abs() < 1e-6, "{even:?}");
        assert_eq!(even.warning(&config), None);
        let before = Movement::of(&weights(&[1.0]), &weights(&[1.0]), &Adam::default(), &config);
        assert_eq!(before, Movement { distance: 0.0, lost: 0.0 });
    }
}
