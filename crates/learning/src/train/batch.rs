//! Windows as tensors.

use burn::tensor::{Device, Tensor, TensorData};

use super::{weigh::Scale, window::Window};
use crate::model::{Bodies, Matter, Track};
use eddy_evaluation::dataset::State;
use eddy_inference::checkpoint::GridOptions;

/// A batch of B windows of N particles each; `R` = B N rows, window by window.
pub(super) struct Batch {
    /// Windows, materials, shapes at rest.
    pub(super) matter: Matter,
    /// The warm-up: W observed frames, `[W, R, 2]`.
    pub(super) observed: Track,
    /// The K frames to predict freely, `[K, R, 2]`.
    pub(super) future: Track,
    /// Weights of squared position and velocity errors of the future, `[K, R, 2]`.
    pub(super) weights: Track,
}

impl Batch {
    /// Puts windows of `warm_up` and further frames together.
    pub(super) fn new(
        windows: &[Window],
        warm_up: usize,
        scale: &Scale,
        grid: Option<&GridOptions>,
        device: &Device,
    ) -> Self {
        let material: Vec<_> = windows.iter().flat_map(|w| w.material.iter().copied()).collect();
        let rest: Vec<_> = windows.iter().flat_map(|window| window.rest.iter().copied()).collect();
        let unroll = windows[0].states.len() - warm_up;
        let weights: Vec<_> = windows.iter().map(|window| scale.weights(window, unroll)).collect();
        let rows: usize = windows.iter().map(|window| window.material.len()).sum();
        // Windows hold their frames together; a batch holds the windows of a frame together.
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
        let track = |frames: std::ops::Range<usize>| {
            let bodies = frames.map(|frame| {
                let join = |pick: fn(&State) -> &Vec<[f32; 2]>| {
                    let values: Vec<f32> = windows
                        .iter()
                        .flat_map(|window| pick(seen(window, frame, warm_up)).as_flattened())
                        .copied()
                        .collect();
                    Tensor::from_data(TensorData::new(values, [rows, 2]), device)
                };
                Bodies { position: join(|s| &s.position), velocity: join(|s| &s.velocity) }
            });
            Track::stack(bodies.collect())
        };
        Self {
            matter: Matter::new(&material, &rest, windows.len(), grid, device),
            observed: track(0..warm_up),
            future: track(warm_up..warm_up + unroll),
            weights: Track { position: weight(0), velocity: weight(1) },
        }
    }
}

/// What the network sees of a window's frame.
fn seen(window: &Window, frame: usize, warm_up: usize) -> &State {
    match &window.disturbed {
        Some(disturbed) if frame + 1 == warm_up => disturbed,
        _ => &window.states[frame],
    }
}
