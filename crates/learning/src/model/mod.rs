//! The networks, written in burn.
//!
//! 1. `ballistic`: the step of a particle that nothing else touches, over tensors.
//! 2. `features`: frames to the numbers a network sees.
//! 3. `layers`: the linear layers both networks are made of; weights in, weights out.
//! 4. `core`: the layers of the core: `mlp` without recurrence, `gru` and `lstm` frame by frame,
//!    `mingru` and `minlstm` as coefficients of a linear recurrence.
//! 5. `scan`: that recurrence over all frames at once (training) or one at a time (streaming).
//! 6. `fused`, `training`: layers whose values and gradients are computed by [`kernels`](eddy_inference::kernels)
//!    rather than by tensor operations, where gradients are recorded on the CPU.
//! 7. `frame_model`: the paper's network (Table 1), one hidden state for a frame.
//! 8. `particle_model`: one hidden state for a particle, a residual on the ballistic step. It sees
//!    `grid` on a `sparse` grid, and the `strain` of solids.
//! 9. `network`: either of the two, behind one set of calls.
//! 10. [`mod@reference`]: a network that predicts frames one after the other, for comparison.
//!
//! Letters in shapes: `T` frames, `B` windows, `N` particles of a window, `R` = B N rows, `F` input
//! features, `E` encoder width, `H` hidden width.

pub mod reference;

pub(crate) mod ballistic;
pub(crate) mod core;
pub(crate) mod features;
pub(crate) mod frame_model;
pub(crate) mod fused;
pub(crate) mod grid;
pub(crate) mod gru;
pub(crate) mod layers;
pub(crate) mod lstm;
pub(crate) mod mingru;
pub(crate) mod minlstm;
pub(crate) mod mlp;
pub(crate) mod network;
pub(crate) mod particle_model;
pub(crate) mod scan;
pub(crate) mod sparse;
pub(crate) mod strain;
pub(crate) mod training;

pub use reference::Reference;

pub use eddy_inference::checkpoint::{Architecture, Core};

use std::{panic, sync::Arc};

use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};

use eddy_frames::Material;
use eddy_inference::{checkpoint::GridOptions, kernels::rest_shape::RestShape};

/// What computes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum DeviceKind {
    /// burn-flex: this machine's CPU, the default.
    #[default]
    Flex,
    /// burn-ndarray: this machine's CPU; deprecated upstream, kept for comparison.
    Ndarray,
    /// The best GPU that Vulkan finds.
    #[cfg(feature = "vulkan")]
    Vulkan,
}

impl DeviceKind {
    /// The word in files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Flex => "flex",
            Self::Ndarray => "ndarray",
            #[cfg(feature = "vulkan")]
            Self::Vulkan => "vulkan",
        }
    }

    /// Whether it is there.
    ///
    /// # Errors
    /// [`NoDevice`] where the first operation fails, as it does without a driver.
    pub fn check(self) -> Result<(), NoDevice> {
        // burn knows no other way to say it than to panic, on a thread of its own, too.
        let hook = panic::take_hook();
        panic::set_hook(Box::new(|_| {}));
        let outcome = panic::catch_unwind(|| Tensor::<1>::zeros([1], &self.device()).into_data());
        panic::set_hook(hook);
        outcome.map(|_| ()).map_err(|_| NoDevice { found: self.name() })
    }

    /// The device, without a record for gradients.
    pub(crate) fn device(self) -> Device {
        match self {
            Self::Flex => Device::flex(),
            #[expect(deprecated, reason = "selectable on purpose, see the variant")]
            Self::Ndarray => Device::ndarray(),
            #[cfg(feature = "vulkan")]
            Self::Vulkan => Device::vulkan(burn::tensor::DeviceKind::DefaultDevice),
        }
    }
}

/// What was to compute is not there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "device: found no driver for {found}, expected a device that this machine has, such as flex"
)]
pub struct NoDevice {
    found: &'static str,
}

/// Positions and velocities of particles at one instant, each `[R, 2]`, in domain lengths and
/// domain lengths per second.
#[derive(Clone, Debug)]
pub(crate) struct Bodies {
    pub(crate) position: Tensor<2>,
    pub(crate) velocity: Tensor<2>,
}

/// What does not change from frame to frame.
#[derive(Clone, Debug)]
pub(crate) struct Matter {
    /// Materials, one-hot, `[R, 4]`.
    pub(crate) material: Tensor<2>,
    /// The same numbers.
    pub(crate) one_hot: Arc<Vec<f32>>,
    /// B; each window has equally many particles.
    pub(crate) windows: usize,
    /// The shapes that solids rest in.
    pub(crate) rest: Arc<RestShape>,
}

impl Matter {
    /// Of B windows one below the other, with their particles' positions at rest, `[R]`. The particle
    /// model needs to know how far apart its particles are.
    pub(crate) fn new(
        material: &[Material],
        rest: &[[f32; 2]],
        windows: usize,
        grid: Option<&GridOptions>,
        device: &Device,
    ) -> Self {
        let spacing = grid.map_or(0.0, |grid| grid.spacing);
        let rest = Arc::new(RestShape::new(rest, material, windows, spacing));
        let one_hot = Arc::new(features::one_hot(material));
        let data = TensorData::new(one_hot.to_vec(), [material.len(), Material::COUNT]);
        Self { material: Tensor::from_data(data, device), one_hot, windows, rest }
    }

    /// Particles of a window.
    pub(crate) fn particles(&self) -> usize {
        self.rest.len() / self.windows
    }
}

/// `[R, 2]` as a list of pairs.
pub(crate) fn pairs(tensor: Tensor<2>) -> Vec<[f32; 2]> {
    let numbers: Vec<f32> = tensor.inner().into_data().iter::<f32>().collect();
    numbers.as_chunks::<2>().0.to_vec()
}

/// Positions and velocities over time, each `[T, R, 2]`.
#[derive(Clone, Debug)]
pub(crate) struct Track {
    pub(crate) position: Tensor<3>,
    pub(crate) velocity: Tensor<3>,
}

impl Track {
    /// The bodies at frame `t`.
    pub(crate) fn at(&self, t: usize) -> Bodies {
        let pick = |track: &Tensor<3>| {
            let [_, rows, axes] = track.dims();
            track.clone().slice([t..t + 1, 0..rows, 0..axes]).reshape([rows, axes])
        };
        Bodies { position: pick(&self.position), velocity: pick(&self.velocity) }
    }

    /// Bodies of consecutive frames, one after the other.
    pub(crate) fn stack(frames: Vec<Bodies>) -> Self {
        let (position, velocity) = frames.into_iter().map(|b| (b.position, b.velocity)).unzip();
        Self {
            position: Tensor::stack::<3>(position, 0),
            velocity: Tensor::stack::<3>(velocity, 0),
        }
    }
}

#[cfg(test)]
mod engine_tests;
#[cfg(test)]
mod tests;
