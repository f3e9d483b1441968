//! Weights for several stiffnesses ("knots"), between which those of a stream are interpolated in the logarithm of its stiffness.

use std::collections::BTreeMap;

use super::{Checkpoint, Description, WeightFormat, Weights};

/// Most stiffnesses that a checkpoint has weights for.
pub const MOST_KNOTS: usize = 4;

/// What [`valid_knots`] are.
pub const VALID_KNOTS: &str = "nothing, or 2 to 4 positive numbers, each larger than the one before, for a network with stiffness = true";

/// The stiffnesses that a network can assume of streams.
pub const VALID_ASSUMPTION: &str =
    "nothing, or a positive number for a network with stiffness = true";

/// Whether a network can assume this stiffness of streams that state none.
pub fn valid_assumption(assumed: f32, conditioned: bool) -> bool {
    conditioned && assumed.is_finite() && assumed > 0.0
}

/// Whether a network can have weights for these stiffnesses.
pub fn valid_knots(knots: &[f32], conditioned: bool) -> bool {
    let positive = knots.iter().all(|knot| knot.is_finite() && *knot > 0.0);
    let rising = knots.is_sorted_by(|lower, upper| lower < upper);
    knots.is_empty() || conditioned && (2..=MOST_KNOTS).contains(&knots.len()) && positive && rising
}

impl Checkpoint {
    /// The network for streams of a stiffness (density x velocity^2), with one set of weights, not calibrated: interpolated ones if the
    /// checkpoint has some for several stiffnesses ([`Description::stiffness_knots`]), else its own.
    pub fn at_stiffness(&self, stiffness: f32) -> Self {
        let knots = &self.description.stiffness_knots;
        if knots.is_empty() {
            return Self::new(self.description.clone(), self.tensors.clone());
        }
        let shares = knot_shares(knots, f64::from(stiffness).ln());
        let description = Description {
            stiffness_knots: Vec::new(),
            // Numbers between two of 16 bits have more.
            weights: WeightFormat::F32,
            ..self.description.clone()
        };
        let tensors = self.tensors.iter();
        let tensors = tensors.map(|(name, weights)| (name.clone(), mixed(weights, &shares)));
        Self::new(description, tensors.collect())
    }
}

/// What the weights of each knot count for, by the logarithm of the stiffness: linearly between two knots; beyond the ends, the nearest one
/// counts alone.
pub fn knot_shares(knots: &[f32], logarithm: f64) -> [f32; MOST_KNOTS] {
    let mut shares = [0.0; MOST_KNOTS];
    let places: Vec<f64> = knots.iter().map(|&knot| f64::from(knot).ln()).collect();
    let upper = places.partition_point(|&place| place <= logarithm);
    match (upper.checked_sub(1), places.get(upper)) {
        (Some(lower), Some(&end)) => {
            let share = (logarithm - places[lower]) / (end - places[lower]);
            (shares[lower], shares[upper]) = ((1.0 - share) as f32, share as f32);
        }
        (Some(last), None) => shares[last] = 1.0,
        (None, _) => shares[0] = 1.0,
    }
    shares
}

/// The mean of the knots' values of a tensor, weighted by `shares`, `[knots]`.
pub fn mix<'a>(values: &mut [f32], of_knots: impl Iterator<Item = &'a [f32]>, shares: &[f32]) {
    values.fill(0.0);
    for (of_knot, share) in of_knots.zip(shares) {
        values.iter_mut().zip(of_knot).for_each(|(sum, value)| *sum = share.mul_add(*value, *sum));
    }
}

/// The weighted mean of the knots' weights.
fn mixed(weights: &Weights, shares: &[f32]) -> Weights {
    let shape = weights.shape[1..].to_vec();
    let mut values = vec![0.0; shape.iter().product()];
    let of_knots = weights.values.chunks(values.len().max(1));
    mix(&mut values, of_knots, shares);
    Weights { shape, values }
}

/// The tensors of one knot out of those with all along the first axis.
pub fn tensors_of_knot(
    tensors: &BTreeMap<String, Weights>,
    knot: usize,
) -> BTreeMap<String, Weights> {
    let of_knot = |weights: &Weights| {
        let shape = weights.shape[1..].to_vec();
        let size = shape.iter().product::<usize>();
        Weights { shape, values: weights.values[knot * size..][..size].to_vec() }
    };
    tensors.iter().map(|(name, weights)| (name.clone(), of_knot(weights))).collect()
}

/// The tensors of all knots, along the first axis: the inverse of [`tensors_of_knot`].
pub fn tensors_of_knots(knots: &[BTreeMap<String, Weights>]) -> BTreeMap<String, Weights> {
    let names = knots.iter().take(1).flat_map(BTreeMap::iter);
    let all = |name: &String, shape: &[usize]| {
        let values = knots.iter().filter_map(|tensors| tensors.get(name));
        let values = values.flat_map(|weights| &weights.values).copied().collect();
        Weights { shape: [&[knots.len()], shape].concat(), values }
    };
    names.map(|(name, Weights { shape, .. })| (name.clone(), all(name, shape))).collect()
}
