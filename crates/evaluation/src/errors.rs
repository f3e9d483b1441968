//! Squared errors summed over windows, by material and frame ahead.

use serde::{Deserialize, Serialize};

use super::FEATURES;
use eddy_frames::{Material, State};

/// Divisors of normalised errors of x, y, vx, vy, from the first checkpoint's training data.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Units {
    /// Range of each feature, for MinMax errors.
    pub ranges: [f64; FEATURES],
    /// Standard deviation of each feature, for z-score errors.
    pub deviations: [f64; FEATURES],
}

impl Units {
    /// No normalisation.
    pub const ONE: Self = Self { ranges: [1.0; FEATURES], deviations: [1.0; FEATURES] };
}

/// Sums over particles and windows.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Errors {
    /// Particles summed over.
    pub count: f64,
    /// Sum of |x - x'|^2 (domain lengths squared).
    pub position: f64,
    /// Sum of |v - v'|^2 (domain lengths squared per second squared).
    pub velocity: f64,
    /// Sum over the four features of squared errors in units of the feature's range.
    pub minmax: f64,
    /// Sum over the four features of squared errors in units of the feature's standard deviation.
    pub zscore: f64,
}

impl Errors {
    /// Root mean square of |x - x'| (domain lengths).
    pub fn position_rmse(&self) -> f64 {
        (self.position / self.count).sqrt()
    }

    /// Root mean square of |v - v'| (domain lengths per second).
    pub fn velocity_rmse(&self) -> f64 {
        (self.velocity / self.count).sqrt()
    }

    /// Mean squared error of the MinMax-normalised features x, y, vx, vy.
    pub fn minmax_mse(&self) -> f64 {
        self.minmax / (FEATURES as f64 * self.count)
    }

    /// Mean squared error of the features x, y, vx, vy as z-scores.
    pub fn zscore_mse(&self) -> f64 {
        self.zscore / (FEATURES as f64 * self.count)
    }

    /// Adds other sums.
    pub fn add(&mut self, other: &Self) {
        self.count += other.count;
        self.position += other.position;
        self.velocity += other.velocity;
        self.minmax += other.minmax;
        self.zscore += other.zscore;
    }
}

/// Errors for each frame ahead and each material.
#[derive(Clone, Debug, PartialEq)]
pub struct ErrorSums {
    units: Units,
    sums: Vec<[Errors; Material::COUNT]>,
}

impl ErrorSums {
    /// Zero sums for `horizon` frames ahead.
    pub fn new(horizon: usize, units: Units) -> Self {
        Self { units, sums: vec![Default::default(); horizon] }
    }

    /// Adds one window: predicted and true states, one per frame ahead. Frames without truth add nothing.
    pub fn add(&mut self, material: &[Material], predicted: &[State], truth: &[State]) {
        for ((sums, predicted), truth) in self.sums.iter_mut().zip(predicted).zip(truth) {
            for (particle, &kind) in material.iter().enumerate() {
                let dx = difference(predicted.position[particle], truth.position[particle]);
                let dv = difference(predicted.velocity[particle], truth.velocity[particle]);
                let errors = [dx[0], dx[1], dv[0], dv[1]];
                let relative = |units: [f64; FEATURES]| {
                    errors.iter().zip(units).map(|(e, unit)| (e / unit) * (e / unit)).sum()
                };
                sums[kind as usize].add(&Errors {
                    count: 1.0,
                    position: square(dx),
                    velocity: square(dv),
                    minmax: relative(self.units.ranges),
                    zscore: relative(self.units.deviations),
                });
            }
        }
    }

    /// Adds the sums of other windows.
    pub fn merge(&mut self, other: &Self) {
        for (sums, others) in self.sums.iter_mut().zip(&other.sums) {
            sums.iter_mut().zip(others).for_each(|(sum, other)| sum.add(other));
        }
    }

    /// Errors of one material, one entry per frame ahead.
    pub fn of(&self, material: Material) -> Vec<Errors> {
        self.sums.iter().map(|sums| sums[material as usize]).collect()
    }

    /// Errors over all materials, one entry per frame ahead.
    pub fn total(&self) -> Vec<Errors> {
        let add = |mut total: Errors, errors: &Errors| {
            total.add(errors);
            total
        };
        self.sums.iter().map(|sums| sums.iter().fold(Errors::default(), add)).collect()
    }
}

/// `a - b`, subtracted in double precision.
pub(super) fn difference(a: [f32; 2], b: [f32; 2]) -> [f64; 2] {
    [f64::from(a[0]) - f64::from(b[0]), f64::from(a[1]) - f64::from(b[1])]
}

/// The squared length of a vector.
pub(super) fn square([x, y]: [f64; 2]) -> f64 {
    x * x + y * y
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_root_mean_squares_in_domain_units_and_in_units_of_the_range() {
        let truth = State { position: vec![[0.0; 2]; 2], velocity: vec![[0.0; 2]; 2] };
        let predicted = State {
            position: vec![[0.3, 0.4], [0.0, 0.0]],
            velocity: vec![[0.0, 0.0], [2.0, 0.0]],
        };
        let units = Units { ranges: [1.0, 1.0, 4.0, 4.0], deviations: [0.5; 4] };
        let mut sums = ErrorSums::new(2, units);
        sums.add(&[Material::Liquid, Material::Rope], &[predicted.clone(), predicted], &[truth]);
        let close = |a: f64, b: f64| (a - b).abs() < 1e-6;
        let liquid = sums.of(Material::Liquid)[0];
        assert!(close(liquid.position_rmse(), 0.5));
        assert!(close(liquid.minmax_mse(), 0.25 / 4.0));
        assert!(close(liquid.zscore_mse(), 4.0 * 0.25 / 4.0));
        let total = sums.total()[0];
        assert!(close(total.position_rmse(), 0.5 / 2f64.sqrt()));
        assert!(close(total.velocity_rmse(), 2.0 / 2f64.sqrt()));
        assert_eq!(sums.of(Material::Snow)[0].count, 0.0);
        assert_eq!(sums.total()[1].count, 0.0, "there is no truth two frames ahead");

        let mut twice = sums.clone();
        twice.merge(&sums);
        assert_eq!(twice.total()[0].count, 4.0);
        assert_eq!(twice.total()[0].position_rmse(), total.position_rmse());
    }
}
