//! Linear and logistic regression with a ridge.

use crate::normal_equations::solve;
use eddy_inference::error_model::{FEATURES, Features, Linear};

/// Coefficients: the intercept and one per feature.
const NUMBERS: usize = FEATURES + 1;
/// Weight of the squared coefficients of standardised features: that of a single observation.
const RIDGE: f64 = 1.0;
/// Largest number of Newton steps; some ten are enough.
const NEWTON_STEPS: usize = 50;

/// Features, and a quantity to predict from them.
pub(super) type Observation = (Features, f64);

/// The linear function with the least squares of its residuals.
pub(super) fn least_squares(observations: &[Observation]) -> Linear {
    let scale = Scale::of(observations);
    let rows = observations.iter().map(|(features, value)| (scale.row(features), 1.0, *value));
    scale.unscaled(weighted_least_squares(rows, &[0.0; NUMBERS]))
}

/// The logit of the probability that a quantity is 1 and not 0, by maximum likelihood (iteratively reweighted least squares).
pub(super) fn logistic(observations: &[Observation]) -> Linear {
    let scale = Scale::of(observations);
    let (count, ones) = (observations.len() as f64, observations.iter().map(|o| o.1).sum::<f64>());
    let mut found = [0.0; NUMBERS];
    // Half an observation of each keeps the logit finite.
    found[0] = ((ones + 0.5) / (count - ones + 0.5)).ln();
    if ones == 0.0 || ones == count {
        return scale.unscaled(found);
    }
    let rows: Vec<_> = observations.iter().map(|(x, value)| (scale.row(x), *value)).collect();
    let logit = |row: &[f64; NUMBERS], at: &[f64; NUMBERS]| -> f64 {
        row.iter().zip(at).map(|(x, weight)| x * weight).sum()
    };
    let loss = |at: &[f64; NUMBERS]| {
        let of = |(row, value): &([f64; NUMBERS], f64)| {
            let logit = logit(row, at);
            // ln(1 + exp(x)) without overflow.
            logit.max(0.0) + (-logit.abs()).exp().ln_1p() - value * logit
        };
        let ridge: f64 = at[1..].iter().map(|weight| weight * weight).sum();
        rows.iter().map(of).sum::<f64>() + 0.5 * RIDGE * ridge
    };
    for _ in 0..NEWTON_STEPS {
        let reweighted = rows.iter().map(|(row, value)| {
            let probability = 1.0 / (1.0 + (-logit(row, &found)).exp());
            let weight = (probability * (1.0 - probability)).max(1e-12);
            (*row, weight, (value - probability) / weight)
        });
        let step = weighted_least_squares(reweighted, &found);
        // Half the step until the loss falls.
        let before = loss(&found);
        let after =
            |size: f64| -> [f64; NUMBERS] { std::array::from_fn(|k| found[k] + size * step[k]) };
        let sizes = (0..20).map(|halvings| 0.5f64.powi(halvings));
        let better = sizes.map(after).find(|at| loss(at) < before);
        let Some(better) = better else { break };
        let is_done = before - loss(&better) < 1e-9 * before;
        found = better;
        if is_done {
            break;
        }
    }
    scale.unscaled(found)
}

/// The change of the coefficients `from` that minimises the weighted squares of (row . change - value) plus the ridge of the
/// coefficients after it. Rows have a weight and a value each.
fn weighted_least_squares(
    rows: impl Iterator<Item = ([f64; NUMBERS], f64, f64)>,
    from: &[f64; NUMBERS],
) -> [f64; NUMBERS] {
    let (mut products, mut side) = ([[0.0; NUMBERS]; NUMBERS], [[0.0; NUMBERS]]);
    for (x, weight, value) in rows {
        for (row, a) in products.iter_mut().zip(x) {
            row.iter_mut().zip(x).for_each(|(sum, b)| *sum += weight * a * b);
        }
        side[0].iter_mut().zip(x).for_each(|(sum, a)| *sum += weight * a * value);
    }
    // The intercept has no ridge.
    for k in 1..NUMBERS {
        products[k][k] += RIDGE;
        side[0][k] -= RIDGE * from[k];
    }
    // Singular only if nearly all weights have vanished: then nothing is left to change.
    solve(products, side).map_or([0.0; NUMBERS], |[found]| found)
}

/// Mean and standard deviation of each feature.
struct Scale {
    means: [f64; FEATURES],
    deviations: [f64; FEATURES],
}

impl Scale {
    fn of(observations: &[Observation]) -> Self {
        let count = (observations.len() as f64).max(1.0);
        let mean = |of: &dyn Fn(&Features) -> f64| {
            observations.iter().map(|(features, _)| of(features)).sum::<f64>() / count
        };
        let means: [f64; FEATURES] = std::array::from_fn(|k| mean(&|x| x.0[k].into()));
        let deviations = std::array::from_fn(|k| {
            let variance = mean(&|x| (f64::from(x.0[k]) - means[k]).powi(2));
            // A feature that never varies gets no weight.
            if variance > 1e-12 { variance.sqrt() } else { f64::INFINITY }
        });
        Self { means, deviations }
    }

    /// 1 and the standardised features.
    fn row(&self, features: &Features) -> [f64; NUMBERS] {
        std::array::from_fn(|k| match k.checked_sub(1) {
            None => 1.0,
            Some(k) => (f64::from(features.0[k]) - self.means[k]) / self.deviations[k],
        })
    }

    /// The function of features for coefficients of [`Scale::row`].
    fn unscaled(&self, found: [f64; NUMBERS]) -> Linear {
        let weights: [f64; FEATURES] = std::array::from_fn(|k| found[k + 1] / self.deviations[k]);
        let shift: f64 = weights.iter().zip(self.means).map(|(weight, mean)| weight * mean).sum();
        Linear {
            intercept: (found[0] - shift) as f32,
            weights: weights.map(|weight| weight as f32),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers that look random, evenly spread over -1 to 1.
    fn spread(number: usize, step: f64) -> f64 {
        2.0 * (number as f64 * step).fract() - 1.0
    }

    /// Two features that matter, one that never varies; `value` of 2 + 3 a - b / 2 and a number from -1 to 1.
    fn observations(count: usize, value: impl Fn(f64, f64) -> f64) -> Vec<Observation> {
        let observation = |number: usize| {
            let mut features = [0.0; FEATURES];
            features[1] = spread(number, 0.618_034) as f32;
            features[3] = 10.0 * spread(number, 0.414_214) as f32;
            features[5] = 7.0;
            let law = 2.0 + 3.0 * f64::from(features[1]) - 0.5 * f64::from(features[3]);
            (Features(features), value(law, spread(number, 0.732_051)))
        };
        (0..count).map(observation).collect()
    }

    fn assert_is_the_law(found: &Linear, tolerance: f32) {
        let close = |found: f32, expected: f32| (found - expected).abs() < tolerance;
        let Linear { intercept, weights } = found;
        assert!(close(*intercept, 2.0) && close(weights[1], 3.0), "{found:?}");
        assert!(close(weights[3], -0.5) && weights[5] == 0.0, "{found:?}");
    }

    #[test]
    fn a_linear_law_is_found_through_noise() {
        assert_is_the_law(
            &least_squares(&observations(2000, |law, noise| law + 0.5 * noise)),
            0.03,
        );
    }

    #[test]
    fn a_logistic_law_is_found_from_what_happened() {
        let happened = |law: f64, chance: f64| {
            let probability = 1.0 / (1.0 + (-law).exp());
            f64::from(u8::from(0.5 * (chance + 1.0) < probability))
        };
        assert_is_the_law(&logistic(&observations(20_000, happened)), 0.2);
    }

    #[test]
    fn what_never_or_always_happened_or_is_separable_has_a_finite_logit() {
        let features = Features([0.0; FEATURES]);
        let never = logistic(&observations(99, |_, _| 0.0)).probability(&features);
        assert!((never - 0.005).abs() < 1e-6, "{never}");
        let always = logistic(&observations(99, |_, _| 1.0)).probability(&features);
        assert!((always - 0.995).abs() < 1e-6, "{always}");
        let sign = observations(99, |law, _| f64::from(u8::from(law > 0.0)));
        let found = logistic(&sign);
        assert!(found.weights.iter().all(|weight| weight.abs() < 100.0), "{found:?}");
        let right = |(x, value): &&Observation| (found.probability(x) > 0.5) == (*value == 1.0);
        assert!(sign.iter().filter(right).count() > 95);
    }
}
