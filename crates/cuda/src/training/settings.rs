//! What a training step is made of, and what comes of it.

use super::Window;
use eddy_inference::checkpoint::MOST_KNOTS;

/// What a training step is made of.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// B, windows of a batch, of those on this device where several train together.
    pub batch: usize,
    /// W, observed frames of a window.
    pub warm_up: usize,
    /// K, frames predicted freely after them.
    pub unroll: usize,
    /// Free frames after which gradients through time are cut; 0 never cuts. Of the particle model only.
    pub truncation: usize,
    /// Whether the loss is the root of each window's sum.
    pub relative: bool,
    /// What is added to that sum before the root.
    pub error_floor: f32,
    /// Weight of the predictions made during the warm-up.
    pub observed_weight: f32,
    /// Weight of the density maps' mean squared error.
    pub density_weight: f32,
    /// Nodes of a density map along an axis.
    pub density_nodes: usize,
    /// Share of the core's outputs dropped after each layer.
    pub dropout: f32,
    /// Standard deviations of the noise on positions (domain lengths) and velocities (domain lengths per second).
    pub noise: [f32; 2],
    /// Largest norm of a tensor's gradient.
    pub clip: f32,
    /// Keeps a step finite where gradients vanish.
    pub epsilon: f32,
    /// Whether a running average of the weights is kept.
    pub average: bool,
    /// Whether Muon changes the weights of hidden layers instead of Adam. Of the particle model only.
    pub muon: bool,
    /// Stiffnesses for which there are weights, between which those of a step are interpolated; 1 if there is one set of weights. Of
    /// the particle model only.
    pub knots: usize,
}

impl Settings {
    /// The mean squared error of all frames, and nothing beside it, for windows of `warm_up` observed frames and the next.
    pub fn plain(batch: usize, warm_up: usize) -> Self {
        Self {
            batch,
            warm_up,
            unroll: 1,
            truncation: 0,
            relative: false,
            error_floor: 1e-8,
            observed_weight: 1.0,
            density_weight: 0.0,
            density_nodes: 32,
            dropout: 0.0,
            noise: [0.0, 0.0],
            clip: f32::INFINITY,
            epsilon: 1e-8,
            average: false,
            muon: false,
            knots: 1,
        }
    }

    /// The first frame that the decoder runs on: earlier predictions count only where the loss asks for them.
    pub(crate) fn first_decoded(&self) -> usize {
        if self.observed_weight > 0.0 { 0 } else { self.warm_up - 1 }
    }
}

/// One step, as the host prepares it.
#[derive(Clone, Debug, PartialEq)]
pub struct Batch {
    /// B windows.
    pub windows: Vec<Window>,
    /// Learning rate, corrected for the first moment's start from zero.
    pub rate: f32,
    /// Learning rate without that correction, for Muon.
    pub plain_rate: f32,
    /// 1 / sqrt(1 - beta_2^t).
    pub correction: f32,
    /// Share of the running average that stays.
    pub kept: f32,
    /// What the weights of each stiffness count for, where there are several.
    pub shares: [f32; MOST_KNOTS],
    /// Seed of ChaCha8 for dropout masks.
    pub dropout: [u8; 32],
    /// Weights of squared errors of x, y, vx, vy, `[K, B, MATERIALS]`, where they differ from batch to batch.
    pub weights: Option<Vec<[f32; 4]>>,
}

/// What came of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outcome {
    /// The loss before the step.
    pub loss: f32,
    /// Norm of the gradient by all tensors, before any was shortened.
    pub gradient_norm: f32,
    /// Whether that was not finite; then tensors without a finite gradient stayed as they were.
    pub not_finite: bool,
}
