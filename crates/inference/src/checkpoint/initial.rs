//! The weights of an untrained network.

use std::collections::BTreeMap;

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{
    Architecture, Description, Weights,
    plan::{LinearLayer, Plan},
};

/// Initial weights: uniform in +-sqrt(gain / in). Biases are zero, except that gates of minimal cores start open
/// (sigmoid(1) = 0.73 of the candidate enters per frame). The decoder is zero, so that an untrained network adds nothing to
/// the ballistic step. The gain is 1 for the frame model, as in PyTorch's layers, and 3 for the narrow particle model, which
/// preserves the variance of its inputs.
pub fn initial_weights(description: &Description, seed: u64) -> BTreeMap<String, Weights> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let gain = match description.architecture {
        Architecture::Frame => 1.0f32,
        Architecture::Particle => 3.0,
    };
    let mut tensors = BTreeMap::new();
    for layer in Plan::new(description).layers {
        let LinearLayer { weight, bias, input, output, sharing } = layer;
        let bound = if weight.starts_with("decoder") { 0.0 } else { (gain / input as f32).sqrt() };
        let opens = bias.ends_with(".gate.bias") || bias.ends_with(".input_gate.bias");
        let values = (0..output * input).map(|_| bound * (2.0 * random.random::<f32>() - 1.0));
        let values = values.collect();
        tensors.insert(weight, Weights { shape: vec![output, input], values });
        let biases = output / sharing;
        let values = vec![if opens { 1.0 } else { 0.0 }; biases];
        tensors.insert(bias, Weights { shape: vec![biases], values });
    }
    tensors
}
