//! Weights for several stiffnesses ("knots"): a step has those between them, and changes those of each knot by its share of the gradient.
//!
//! Tensors of all knots are in lists, those of each knot one after the other, in the order of the optimizer.

use eddy_inference::checkpoint::{MOST_KNOTS, knot_shares};

/// The shares of the only weights.
pub(super) const ONE_SET: [f32; MOST_KNOTS] = [1.0, 0.0, 0.0, 0.0];

/// What the weights of each knot count for in a batch, whose streams have about the same stiffness: by the mean of its logarithm. The only
/// weights count alone.
pub(super) fn shares(
    knots: &[f32],
    stiffnesses: impl Iterator<Item = Option<f32>>,
) -> [f32; MOST_KNOTS] {
    if knots.is_empty() {
        return ONE_SET;
    }
    let (mut sum, mut count) = (0.0, 0.0);
    for stiffness in stiffnesses.flatten() {
        sum += f64::from(stiffness).ln();
        count += 1.0;
    }
    knot_shares(knots, sum / count)
}

/// The weighted mean of the weights of a tensor, `[knots]`.
pub(super) fn mix<'a>(
    values: &mut [f32],
    of_knots: impl Iterator<Item = &'a [f32]>,
    shares: &[f32],
) {
    values.fill(0.0);
    for (of_knot, share) in of_knots.zip(shares) {
        values.iter_mut().zip(of_knot).for_each(|(sum, value)| *sum = share.mul_add(*value, *sum));
    }
}
