//! Steps as the device takes them: settings, windows, weights of errors.

use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use crate::train::{
    LossKind, OptimizerKind, TrainConfig, TrainError,
    loss_weights::{LossScale, WindowKind},
    optimizer::Correction,
    window::{Draw, Sampler},
};
use eddy_cuda::training::{Batch, Settings, Window};
use eddy_frames::Material;
use eddy_inference::checkpoint::{Architecture, MOST_KNOTS};

/// What a step is made of in the stage with so many free frames, on one of `devices` devices.
pub(in crate::train) fn settings(config: &TrainConfig, unroll: usize, devices: usize) -> Settings {
    Settings {
        batch: config.windows.batch / devices,
        warm_up: config.windows.warm_up,
        unroll,
        truncation: config.truncation,
        relative: config.loss.kind == LossKind::Relative,
        error_floor: config.loss.error_floor,
        observed_weight: config.loss.observed_weight,
        density_weight: config.loss.density_weight,
        density_nodes: config.loss.density_grid,
        dropout: config.network.dropout,
        noise: [config.windows.noise.position, config.windows.noise.velocity],
        clip: config.optimizer.clip,
        epsilon: config.optimizer.epsilon,
        average: config.optimizer.average > 0.0,
        muon: config.optimizer.kind == OptimizerKind::Muon,
        knots: config.network.stiffness_knots.len().max(1),
    }
}

/// A step on windows that were drawn. `dropout` is the generator of its masks.
pub(in crate::train) fn batch(
    draws: &[Draw],
    correction: &Correction,
    shares: [f32; MOST_KNOTS],
    dropout: Option<&ChaCha8Rng>,
    weights: Option<Vec<[f32; 4]>>,
) -> Batch {
    let window = |draw: &Draw| Window {
        stream: draw.stream,
        start: draw.start,
        mirrored: draw.mirrored,
        noise: draw.noise.map(|seed| ChaCha8Rng::seed_from_u64(seed).get_seed()),
    };
    Batch {
        windows: draws.iter().map(window).collect(),
        rate: correction.rate,
        plain_rate: correction.plain_rate,
        correction: 1.0 / correction.root,
        kept: correction.kept,
        shares,
        dropout: dropout.map_or([0; 32], ChaCha8Rng::get_seed),
        weights,
    }
}

/// Weights of squared errors of x, y, vx, vy: the same for all batches, or none if they differ.
pub(in crate::train) fn common_weights(
    scale: &LossScale,
    unroll: usize,
    particles: usize,
) -> Option<[f32; 4]> {
    (scale.loss.kind == LossKind::Mse).then(|| scale.squared(unroll * particles))
}

/// Whether the weights of squared errors differ from batch to batch: in a loss that compares with the best trivial predictor,
/// and where windows may have different numbers of particles.
pub(super) fn weights_differ(config: &TrainConfig) -> bool {
    config.loss.kind == LossKind::Relative || config.architecture == Architecture::Particle
}

/// Weights of squared errors of a batch, `[K, B, materials]`.
pub(in crate::train) fn weights(
    scale: &LossScale,
    sampler: &Sampler,
    draws: &[Draw],
    unroll: usize,
) -> Result<Vec<[f32; 4]>, TrainError> {
    type OfFrame = [[f32; 4]; Material::COUNT];
    let of_window = |draw: &Draw| -> Result<Vec<OfFrame>, TrainError> {
        let material = sampler.material(draw);
        if scale.loss.kind == LossKind::Mse {
            return Ok(vec![[scale.squared(unroll * material.len()); Material::COUNT]; unroll]);
        }
        let own = match scale.needs_windows() {
            true => Some(scale.trivial(&sampler.cut(*draw)?, unroll)),
            false => None,
        };
        let of_frame = |[position, velocity]: [[f32; Material::COUNT]; 2]| -> OfFrame {
            std::array::from_fn(|material| {
                let (x, v) = (position[material], velocity[material]);
                [x, x, v, v]
            })
        };
        let kind = WindowKind {
            material,
            stiffness: sampler.stiffness(draw),
            noisy: draw.noise.is_some(),
        };
        Ok(scale.relative(&kind, own.as_ref(), unroll).into_iter().map(of_frame).collect())
    };
    // In parallel: trivial predictors that follow each window take as long as the step on the device.
    let windows = draws.par_iter().map(of_window).collect::<Result<Vec<_>, TrainError>>()?;
    let of_frame = |frame: usize| windows.iter().flat_map(move |window| window[frame]);
    Ok((0..unroll).flat_map(of_frame).collect())
}
