//! Range, mean and standard deviation of the features x, y, vx, vy, and bounding boxes of positions.

use eddy_frames::State;
use eddy_inference::checkpoint::Normalization;

/// Bounding box of all positions seen (domain lengths).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Smallest x and y.
    pub lower: [f32; 2],
    /// Largest x and y.
    pub upper: [f32; 2],
}

impl Default for Bounds {
    /// The empty box.
    fn default() -> Self {
        Self { lower: [f32::INFINITY; 2], upper: [f32::NEG_INFINITY; 2] }
    }
}

impl Bounds {
    /// Extends the box by the positions of a state.
    pub fn widen(&mut self, state: &State) {
        for position in &state.position {
            self.join(&Self { lower: *position, upper: *position });
        }
    }

    /// Extends the box by another one.
    pub fn join(&mut self, other: &Self) {
        for axis in 0..2 {
            self.lower[axis] = self.lower[axis].min(other.lower[axis]);
            self.upper[axis] = self.upper[axis].max(other.upper[axis]);
        }
    }
}

/// Statistics over all particles of all added states, accumulated in f64.
#[derive(Clone, Debug)]
pub(super) struct Statistics {
    minimum: [f32; 4],
    maximum: [f32; 4],
    count: f64,
    sum: [f64; 4],
    squares: [f64; 4],
}

impl Statistics {
    pub(super) fn new() -> Self {
        Self {
            minimum: [f32::INFINITY; 4],
            maximum: [f32::NEG_INFINITY; 4],
            count: 0.0,
            sum: [0.0; 4],
            squares: [0.0; 4],
        }
    }

    /// Adds a state. The order of states affects the last digits.
    pub(super) fn add(&mut self, state: &State) {
        for (&[x, y], &[vx, vy]) in state.position.iter().zip(&state.velocity) {
            self.count += 1.0;
            for (feature, value) in [x, y, vx, vy].into_iter().enumerate() {
                self.minimum[feature] = self.minimum[feature].min(value);
                self.maximum[feature] = self.maximum[feature].max(value);
                self.sum[feature] += f64::from(value);
                self.squares[feature] += f64::from(value) * f64::from(value);
            }
        }
    }

    pub(super) fn normalization(&self) -> Normalization {
        let Self { minimum, maximum, count, sum, squares } = self;
        let mean = sum.map(|total| total / count);
        let standard_deviation = std::array::from_fn(|f| {
            (squares[f] / count - mean[f] * mean[f]).max(0.0).sqrt() as f32
        });
        let (minimum, maximum) = (*minimum, *maximum);
        Normalization { minimum, maximum, mean: mean.map(|m| m as f32), standard_deviation }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_numbers_describe_each_feature() {
        let state = State {
            position: vec![[0.25, 0.5], [0.75, 0.5]],
            velocity: vec![[-1.0, 2.0], [3.0, 2.0]],
        };
        let mut statistics = Statistics::new();
        statistics.add(&state);
        let found = statistics.normalization();
        assert_eq!(found.minimum, [0.25, 0.5, -1.0, 2.0]);
        assert_eq!(found.maximum, [0.75, 0.5, 3.0, 2.0]);
        assert_eq!(found.mean, [0.5, 0.5, 1.0, 2.0]);
        assert_eq!(found.standard_deviation, [0.25, 0.0, 2.0, 0.0]);
    }
}
