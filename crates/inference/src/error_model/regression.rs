//! A linear function of features, and one with the distribution of its residuals.

use serde::{Deserialize, Serialize};

use super::{FEATURES, Features};

/// The levels of the stored quantiles of residuals.
pub const LEVELS: [f32; 21] = [
    0.01, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8,
    0.85, 0.9, 0.95, 0.99,
];

/// A linear function of features.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Linear {
    /// The value where all features are 0.
    pub intercept: f32,
    /// One per feature.
    pub weights: [f32; FEATURES],
}

/// A quantity that is a linear function of features plus a residual of known distribution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Regression {
    /// The function.
    pub linear: Linear,
    /// Quantiles of the residuals at [`LEVELS`] (1 %, 5 % to 95 % in steps of 5 %, 99 %), in increasing order.
    pub residuals: [f32; LEVELS.len()],
}

impl Linear {
    /// The value.
    pub fn value(&self, features: &Features) -> f32 {
        let products = self.weights.iter().zip(&features.0).map(|(weight, x)| weight * x);
        self.intercept + products.sum::<f32>()
    }

    /// The value as a logit of a probability.
    pub fn probability(&self, features: &Features) -> f32 {
        1.0 / (1.0 + (-self.value(features)).exp())
    }

    /// The function `part` of the way to another one.
    pub(super) fn towards(&self, other: &Self, part: f32) -> Self {
        let [intercept] = between(&[self.intercept], &[other.intercept], part);
        Self { intercept, weights: between(&self.weights, &other.weights, part) }
    }
}

fn between<const N: usize>(from: &[f32; N], to: &[f32; N], part: f32) -> [f32; N] {
    std::array::from_fn(|k| from[k] + part * (to[k] - from[k]))
}

impl Regression {
    /// The quantile at `level`, interpolated; at most the last stored one, at least the first.
    pub fn quantile(&self, features: &Features, level: f32) -> f32 {
        self.linear.value(features) + interpolate(&LEVELS, &self.residuals, level)
    }

    /// The level of a value in the distribution: 0 below the first of the stored quantiles, 1 above the last.
    pub fn level(&self, features: &Features, value: f32) -> f32 {
        let residual = value - self.linear.value(features);
        match self.residuals {
            [first, ..] if residual < first => 0.0,
            [.., last] if residual > last => 1.0,
            _ => interpolate(&self.residuals, &LEVELS, residual),
        }
    }

    /// The function `part` of the way to another one, with residuals in between.
    pub(super) fn towards(&self, other: &Self, part: f32) -> Self {
        Self {
            linear: self.linear.towards(&other.linear, part),
            residuals: between(&self.residuals, &other.residuals, part),
        }
    }
}

/// The piecewise linear function through the points (from, to) at `x`, constant beyond the ends. `from` does not decrease; where
/// it is constant, the function jumps.
fn interpolate(from: &[f32], to: &[f32], x: f32) -> f32 {
    let after = from.partition_point(|&at| at < x);
    let last = from.len() - 1;
    match after {
        0 => to[0],
        _ if after > last => to[last],
        _ => {
            let part = (x - from[after - 1]) / (from[after] - from[after - 1]);
            to[after - 1] + part * (to[after] - to[after - 1])
        }
    }
}
