//! Range, mean and deviation of the features x, y, vx, vy.

use super::Stream;
use crate::checkpoint::Normalization;

/// Statistics over every particle of every state of `streams`, summed in f64.
pub(super) fn normalization(streams: &[Stream]) -> Normalization {
    let mut minimum = [f32::INFINITY; 4];
    let mut maximum = [f32::NEG_INFINITY; 4];
    let mut count = 0.0;
    let mut sum = [0.0f64; 4];
    let mut squares = [0.0f64; 4];
    for state in streams.iter().flat_map(|stream| &stream.states) {
        for (&[x, y], &[vx, vy]) in state.position.iter().zip(&state.velocity) {
            count += 1.0;
            for (feature, value) in [x, y, vx, vy].into_iter().enumerate() {
                minimum[feature] = minimum[feature].min(value);
                maximum[feature] = maximum[feature].max(value);
                sum[feature] += f64::from(value);
                squares[feature] += f64::from(value) * f64::from(value);
            }
        }
    }
    let mean = sum.map(|total| total / count);
    let standard_deviation =
        std::array::from_fn(|f| (squares[f] / count - mean[f] * mean[f]).max(0.0).sqrt() as f32);
    Normalization { minimum, maximum, mean: mean.map(|m| m as f32), standard_deviation }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        dataset::State,
        frame::{Domain, Material, Stamp},
    };

    #[test]
    fn four_numbers_describe_each_feature() {
        let state = State {
            position: vec![[0.25, 0.5], [0.75, 0.5]],
            velocity: vec![[-1.0, 2.0], [3.0, 2.0]],
        };
        let stream = Stream {
            id: 0,
            source: "memory".into(),
            dt: 0.016,
            domain: Domain::UNIT,
            material: vec![Material::Liquid; 2],
            first_sequence: 0,
            first_stamp: Stamp(0),
            states: vec![state],
        };
        let found = normalization(&[stream]);
        assert_eq!(found.minimum, [0.25, 0.5, -1.0, 2.0]);
        assert_eq!(found.maximum, [0.75, 0.5, 3.0, 2.0]);
        assert_eq!(found.mean, [0.5, 0.5, 1.0, 2.0]);
        assert_eq!(found.standard_deviation, [0.25, 0.0, 2.0, 0.0]);
    }
}
