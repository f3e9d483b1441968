//! The particle model's layers as they are computed: two linear layers with no activation between them are merged into one.
//!
//! | layers of the checkpoint | computed instead |
//! |---|---|
//! | `encoder.1` on particles, sums on nodes, first convolution | sums of `encoder.0`'s outputs on nodes, a convolution of E channels |
//! | last convolution, gathering, its columns of `context` on particles | a convolution of H outputs, gathering, a sum |
//!
//! Sums on nodes and gathering are linear too, so that only the rounding of the results differs. In the shipped model a particle
//! takes three quarters of the products, and the first convolution three fifths: a tenth less time for a frame.

use std::collections::BTreeMap;

use crate::checkpoint::{
    GridOptions, Weights,
    grid::grid_layers,
    layout::{self, NODE_FEATURES},
};

/// Inputs of a node in the merged first convolution beside the E averages: their constant, which is 1 but for the smallest masses,
/// and those of the checkpoint's.
pub(super) const MERGED_NODE_FEATURES: usize = 1 + NODE_FEATURES;

/// The tensors of the merged layers, by the names of the checkpoint's; `encoder.1` is left out.
///
/// - `encoder.0`: outputs `[E + 1 + NODE_FEATURES]`, a constant one behind the first E, then zeros, the places of the nodes' own inputs.
/// - first layer on nodes: inputs `[9, E + 1 + NODE_FEATURES]`.
/// - last layer on nodes: outputs `[H]`, to add to those of `context`.
/// - `context`: inputs `[F]`.
pub(super) fn merged(
    grid: &GridOptions,
    tensors: &BTreeMap<String, Weights>,
) -> BTreeMap<String, Weights> {
    let linear = |layer: &str| layout::names(layer).map(|name| &tensors[&name]);
    let layers = grid_layers(grid);
    let (Some(first), Some(last)) = (layers.first(), layers.last()) else {
        return tensors.clone();
    };
    let channels = grid.channels[0];

    let [encoder, one] = linear("encoder.0");
    let [encoder_out, encoder_out_bias] = linear("encoder.1");
    let (width, features) = (encoder.shape[0], encoder.shape[1]);
    let outputs = width + MERGED_NODE_FEATURES;
    let (mut weight, mut bias) = (encoder.values.clone(), one.values.clone());
    weight.resize(outputs * features, 0.0);
    bias.push(1.0);
    bias.resize(outputs, 0.0);
    let encoder = [matrix(outputs, weight), vector(bias)];

    // [outputs, 9, C0 + NODE_FEATURES] to [outputs, 9, E + 1 + NODE_FEATURES].
    let [convolution, convolution_bias] = linear(&first.name);
    let mut weight = Vec::new();
    for inputs in convolution.values.chunks_exact(channels + NODE_FEATURES) {
        let (averages, own) = inputs.split_at(channels);
        weight.extend(product(averages, &encoder_out.values));
        weight.extend(product(averages, &encoder_out_bias.values));
        weight.extend_from_slice(own);
    }
    let first_weights = [matrix(convolution.shape[0], weight), convolution_bias.clone()];

    // [H, F + C0] to [H, F], and [C0, 9 C] to [H, 9 C].
    let [context, context_bias] = linear("context");
    let [convolution, convolution_bias] = linear(&last.name);
    let hidden = context.shape[0];
    let [mut own, mut weight, mut bias] = [Vec::new(), Vec::new(), Vec::new()];
    for inputs in context.values.chunks_exact(features + channels) {
        let (particle, gathered) = inputs.split_at(features);
        own.extend_from_slice(particle);
        weight.extend(product(gathered, &convolution.values));
        bias.extend(product(gathered, &convolution_bias.values));
    }
    let last_weights = [matrix(hidden, weight), vector(bias)];
    let context = [matrix(hidden, own), context_bias.clone()];

    let mut all = tensors.clone();
    layout::names("encoder.1").iter().for_each(|name| drop(all.remove(name)));
    for (layer, weights) in [
        ("encoder.0", encoder),
        (&first.name, first_weights),
        (&last.name, last_weights),
        ("context", context),
    ] {
        all.extend(layout::names(layer).into_iter().zip(weights));
    }
    all
}

/// A row vector times a matrix with as many rows, summed in f64.
fn product(row: &[f32], matrix: &[f32]) -> Vec<f32> {
    let mut sums = vec![0.0; matrix.len() / row.len()];
    for (&factor, numbers) in row.iter().zip(matrix.chunks_exact(sums.len())) {
        for (sum, &number) in sums.iter_mut().zip(numbers) {
            *sum += f64::from(factor) * f64::from(number);
        }
    }
    sums.into_iter().map(|sum| sum as f32).collect()
}

fn matrix(outputs: usize, values: Vec<f32>) -> Weights {
    Weights { shape: vec![outputs, values.len() / outputs], values }
}

fn vector(values: Vec<f32>) -> Weights {
    Weights { shape: vec![values.len()], values }
}
