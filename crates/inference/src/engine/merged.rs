//! Combines linear layers of the particle model that have no activation between them.
//!
//! | layers of the checkpoint | computed instead |
//! |---|---|
//! | `encoder.1` on particles, sums on nodes, first convolution | sums of `encoder.0`'s outputs on nodes, a convolution of E channels |
//! | last convolution, gathering, its columns of `context` on particles | a convolution of H outputs, gathering, a sum |
//!
//! Sums on nodes and gathering are linear too, so that only the rounding of the results differs. It saves products where E < C0 and
//! H <= C0, as in the networks that `eddy train` makes without other widths. In the shipped model a particle takes three quarters of
//! the products, and the first convolution three fifths: a tenth less time for a frame.

use std::collections::BTreeMap;

use crate::checkpoint::{
    GridOptions, Weights,
    grid::grid_layers,
    layout::{self, NODE_FEATURES},
};

/// Inputs of a node in the combined first convolution beside the E averages: their constant, which is 1 but for the smallest masses,
/// and those of the checkpoint's.
pub(super) const MERGED_NODE_FEATURES: usize = 1 + NODE_FEATURES;

/// The weight and the bias of a layer.
type Layer = [Weights; 2];

/// The tensors of the combined layers, by the names of the checkpoint's, beside those of the other layers; `encoder.1` is left out.
pub(super) fn merged(
    grid: &GridOptions,
    tensors: &BTreeMap<String, Weights>,
) -> BTreeMap<String, Weights> {
    let linear = |layer: &str| layout::names(layer).map(|name| tensors[&name].clone());
    let layers = grid_layers(grid);
    let (first, last) = (&layers[0].name, &layers[layers.len() - 1].name);
    let [encoder, encoder_out, context] = ["encoder.0", "encoder.1", "context"].map(linear);
    let (last_layer, own_context) = merged_last(linear(last), &context, encoder[0].shape[1]);

    let mut all = tensors.clone();
    layout::names("encoder.1").iter().for_each(|name| drop(all.remove(name)));
    for (layer, tensors) in [
        ("encoder.0", with_one(encoder)),
        (first, merged_first(&encoder_out, linear(first))),
        (last, last_layer),
        ("context", own_context),
    ] {
        all.extend(layout::names(layer).into_iter().zip(tensors));
    }
    all
}

/// `encoder.0` with outputs `[E + 1 + NODE_FEATURES]`: a constant one behind the first E, and zeros, the places of the nodes' own inputs.
fn with_one([weight, bias]: Layer) -> Layer {
    let outputs = weight.shape[0] + MERGED_NODE_FEATURES;
    let (mut weights, mut biases) = (weight.values, bias.values);
    weights.resize(outputs * weight.shape[1], 0.0);
    biases.push(1.0);
    biases.resize(outputs, 0.0);
    [matrix(outputs, weights), vector(biases)]
}

/// The first convolution, `[O, 9, C0 + NODE_FEATURES]`, after `encoder.1`, `[C0, E]`: `[O, 9, E + 1 + NODE_FEATURES]`.
fn merged_first([encoder, encoder_bias]: &Layer, [weight, bias]: Layer) -> Layer {
    let channels = encoder_bias.values.len();
    let mut weights = Vec::new();
    for inputs in weight.values.chunks_exact(channels + NODE_FEATURES) {
        let (averages, of_node) = inputs.split_at(channels);
        weights.extend(product(averages, &encoder.values));
        weights.extend(product(averages, &encoder_bias.values));
        weights.extend_from_slice(of_node);
    }
    [matrix(weight.shape[0], weights), bias]
}

/// The last convolution, `[C0, 9 C]`, before `context`, `[H, F + C0]`: `[H, 9 C]`, and what is left of `context`, `[H, F]`.
fn merged_last(
    [weight, bias]: Layer,
    [context, context_bias]: &Layer,
    features: usize,
) -> (Layer, Layer) {
    let hidden = context.shape[0];
    let [mut left, mut weights, mut biases] = [Vec::new(), Vec::new(), Vec::new()];
    for inputs in context.values.chunks_exact(features + bias.values.len()) {
        let (of_particle, gathered) = inputs.split_at(features);
        left.extend_from_slice(of_particle);
        weights.extend(product(gathered, &weight.values));
        biases.extend(product(gathered, &bias.values));
    }
    ([matrix(hidden, weights), vector(biases)], [matrix(hidden, left), context_bias.clone()])
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
