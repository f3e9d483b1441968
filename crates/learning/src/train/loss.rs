//! The loss: weighted squared errors of a free unroll, and of density maps.

use burn::tensor::Tensor;

use super::{LossConfig, LossKind, batch::Batch, density::density_maps};
use crate::model::{
    dropout::Dropout,
    network::Network,
    state::{RecurrentState, TrajectoryBatch},
};
use eddy_frames::Domain;

/// The network observes the warm-up and predicts the rest from its own output, with gradients cut every `truncation` frames if
/// that is not 0. Returns the predicted future and the one-step predictions during the warm-up, of which the last is the first
/// frame of the future.
pub(super) fn unroll(
    network: &Network,
    batch: &Batch,
    truncation: usize,
    dropout: &mut Dropout,
) -> (TrajectoryBatch, TrajectoryBatch) {
    let [warm_up, _, _] = batch.observed.position.dims();
    let [frames, _, _] = batch.future.position.dims();
    let (steps, mut hidden) =
        network.observe(&batch.observed, &batch.fixed, RecurrentState::default(), dropout);
    let mut future = vec![steps.at(warm_up - 1)];
    while future.len() < frames {
        let mut last = future[future.len() - 1].clone();
        if future.len().is_multiple_of(truncation) {
            (last, hidden) = (last.without_gradient(), hidden.without_gradient());
        }
        let (next, after) = network.step(&last, &batch.fixed, hidden, dropout);
        hidden = after;
        future.push(next);
    }
    (TrajectoryBatch::stack(future), steps)
}

/// The loss of predicted frames, averaged over the windows of the batch, `[1]`.
pub(super) fn loss(
    config: &LossConfig,
    batch: &Batch,
    predicted: &TrajectoryBatch,
    steps: &TrajectoryBatch,
    domain: Domain,
) -> Tensor<1> {
    let TrajectoryBatch { position, velocity } = predicted.clone();
    let squares = (position - batch.future.position.clone()).square()
        * batch.weights.position.clone()
        + (velocity - batch.future.velocity.clone()).square() * batch.weights.velocity.clone();
    let mut loss = over_windows(config, squares, batch.fixed.windows);
    if config.observed_weight > 0.0 {
        loss = loss + observed(config, batch, steps).mul_scalar(config.observed_weight);
    }
    if config.density_weight > 0.0 {
        let maps = |position: &Tensor<3>| {
            density_maps(position.clone(), batch.fixed.windows, config.density_grid, domain)
        };
        let difference = maps(&predicted.position) - maps(&batch.future.position);
        loss = loss + difference.square().mean().mul_scalar(config.density_weight);
    }
    loss
}

/// The loss of one-step predictions during the warm-up, with the weights of the first free frame.
fn observed(config: &LossConfig, batch: &Batch, steps: &TrajectoryBatch) -> Tensor<1> {
    let [warm_up, rows, _] = batch.observed.position.dims();
    let [unroll, _, _] = batch.future.position.dims();
    if warm_up < 2 {
        return Tensor::zeros([1], &batch.observed.position.device());
    }
    let squares = |found: &Tensor<3>, truth: &Tensor<3>, weight: &Tensor<3>| {
        let found = found.clone().slice([0..warm_up - 1, 0..rows, 0..2]);
        let truth = truth.clone().slice([1..warm_up, 0..rows, 0..2]);
        let weight = weight.clone().slice([0..1, 0..rows, 0..2]);
        (found - truth).square() * weight
    };
    let squares = squares(&steps.position, &batch.observed.position, &batch.weights.position)
        + squares(&steps.velocity, &batch.observed.velocity, &batch.weights.velocity);
    let even = unroll as f32 / (warm_up - 1) as f32;
    over_windows(config, squares.mul_scalar(even), batch.fixed.windows)
}

/// Sums `[T, R, 2]` over each window, takes the square root for the relative loss, and averages over windows.
fn over_windows(config: &LossConfig, squares: Tensor<3>, windows: usize) -> Tensor<1> {
    let [frames, rows, axes] = squares.dims();
    let sums = squares
        .reshape([frames, windows, rows / windows * axes])
        .sum_dim(2)
        .sum_dim(0)
        .reshape([windows]);
    match config.kind {
        LossKind::Mse => sums.mean(),
        LossKind::Relative => sums.add_scalar(config.error_floor).sqrt().mean(),
    }
}
