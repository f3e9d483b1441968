//! Windows as tensors.

use std::sync::Arc;

use burn::tensor::{Device, Tensor, TensorData};

use super::{loss_weights::LossScale, window::Window};
use crate::model::state::{ParticleState, StaticInputs, TrajectoryBatch};
use eddy_frames::State;
use eddy_inference::checkpoint::Description;

/// A batch of B windows with N particles each: R = B N rows, window by window.
pub(super) struct Batch {
    pub(super) fixed: Arc<StaticInputs>,
    /// The W frames of the warm-up, `[W, R, 2]`.
    pub(super) observed: TrajectoryBatch,
    /// The K frames to predict freely, `[K, R, 2]`.
    pub(super) future: TrajectoryBatch,
    /// Weights of squared position and velocity errors of the future, `[K, R, 2]`.
    pub(super) weights: TrajectoryBatch,
}

impl Batch {
    /// A batch of windows whose first `warm_up` frames are observed.
    pub(super) fn new(
        windows: &[Window],
        warm_up: usize,
        scale: &LossScale,
        description: &Description,
        device: &Device,
    ) -> Self {
        let material: Vec<_> = windows.iter().flat_map(|w| w.material.iter().copied()).collect();
        let rest: Vec<_> = windows.iter().flat_map(|window| window.rest.iter().copied()).collect();
        let known_stiffness =
            |window: &Window| window.stiffness.expect("checked before a training begins");
        let stiffness: Option<Vec<_>> =
            description.stiffness.then(|| windows.iter().map(known_stiffness).collect());
        let unroll = windows[0].states.len() - warm_up;
        let weights: Vec<_> = windows.iter().map(|window| scale.weights(window, unroll)).collect();
        let rows: usize = windows.iter().map(|window| window.material.len()).sum();
        // From window-major to frame-major order.
        let weight = |part: usize| {
            let mut values: Vec<f32> = Vec::with_capacity(unroll * rows * 2);
            for frame in 0..unroll {
                for (window, weights) in windows.iter().zip(&weights) {
                    let numbers = 2 * window.material.len();
                    values.extend(&weights[part][frame * numbers..(frame + 1) * numbers]);
                }
            }
            Tensor::from_data(TensorData::new(values, [unroll, rows, 2]), device)
        };
        let trajectory = |frames: std::ops::Range<usize>| {
            let state = frames.map(|frame| {
                let join = |pick: fn(&State) -> &Vec<[f32; 2]>| {
                    let values: Vec<f32> = windows
                        .iter()
                        .flat_map(|window| pick(observed(window, frame, warm_up)).as_flattened())
                        .copied()
                        .collect();
                    Tensor::from_data(TensorData::new(values, [rows, 2]), device)
                };
                ParticleState { position: join(|s| &s.position), velocity: join(|s| &s.velocity) }
            });
            TrajectoryBatch::stack(state.collect())
        };
        Self {
            fixed: StaticInputs::new(
                &material,
                &rest,
                windows.len(),
                stiffness.as_deref(),
                description.grid.as_ref(),
            ),
            observed: trajectory(0..warm_up),
            future: trajectory(warm_up..warm_up + unroll),
            weights: TrajectoryBatch { position: weight(0), velocity: weight(1) },
        }
    }
}

/// The state that the network observes in a frame of a window.
fn observed(window: &Window, frame: usize, warm_up: usize) -> &State {
    match &window.noisy {
        Some(noisy) if frame + 1 == warm_up => noisy,
        _ => &window.states[frame],
    }
}
