//! Weights for several stiffnesses ("knots"): the weights of a step are their weighted mean, and the gradient of a knot's weights is that
//! of the step times the knot's share. Adam and Muon divide by the size of past gradients: a knot with a small share still takes steps of
//! nearly full length, one with a share of 0 none.
//!
//! Lists of tensors have the tensors of each knot one after the other, in the order of the optimizer.

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
