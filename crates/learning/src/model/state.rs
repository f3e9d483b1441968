//! Particles, trajectories and hidden states as tensors.

use std::sync::Arc;

use burn::tensor::Tensor;

use eddy_frames::Material;
use eddy_inference::{
    checkpoint::GridOptions, engine::scales::stiffness_feature, kernels::rest_shape::RestShape,
};

/// Positions and velocities of particles at one instant, `[R, 2]` each (domain lengths and domain lengths per second).
#[derive(Clone, Debug)]
pub(crate) struct ParticleState {
    pub(crate) position: Tensor<2>,
    pub(crate) velocity: Tensor<2>,
}

impl ParticleState {
    /// The same values, through which no gradient passes.
    pub(crate) fn without_gradient(self) -> Self {
        Self { position: self.position.detach(), velocity: self.velocity.detach() }
    }
}

/// Inputs that do not change from frame to frame.
#[derive(Clone, Debug)]
pub(crate) struct StaticInputs {
    /// Numbers of the materials, `[R]`.
    pub(crate) material: Vec<u8>,
    /// The feature of each window's stiffness, `[B]`, if the network is conditioned on it.
    pub(crate) stiffness: Option<Vec<f32>>,
    /// B; all windows have the same number of particles.
    pub(crate) windows: usize,
    /// The rest shapes of solids.
    pub(crate) rest: RestShape,
}

impl StaticInputs {
    /// The inputs of B windows, from materials and rest positions, `[R]` each, and the stiffness of each window for a network that
    /// is conditioned on it, `[B]` (density x velocity^2). The grid options are those of the particle model, which uses the spacing of
    /// particles.
    pub(crate) fn new(
        material: &[Material],
        rest: &[[f32; 2]],
        windows: usize,
        stiffness: Option<&[f32]>,
        grid: Option<&GridOptions>,
    ) -> Arc<Self> {
        let spacing = grid.map_or(0.0, |grid| grid.spacing);
        Arc::new(Self {
            material: material.iter().map(|&material| material as u8).collect(),
            stiffness: stiffness.map(|all| all.iter().copied().map(stiffness_feature).collect()),
            windows,
            rest: RestShape::new(rest, material, windows, spacing),
        })
    }

    /// N.
    pub(crate) fn particles(&self) -> usize {
        self.material.len() / self.windows
    }
}

/// `[R, 2]` as a list of pairs.
pub(crate) fn pairs(tensor: Tensor<2>) -> Vec<[f32; 2]> {
    let numbers: Vec<f32> = tensor.inner().into_data().iter::<f32>().collect();
    numbers.as_chunks::<2>().0.to_vec()
}

/// Positions and velocities over time, `[T, R, 2]` each.
#[derive(Clone, Debug)]
pub(crate) struct TrajectoryBatch {
    pub(crate) position: Tensor<3>,
    pub(crate) velocity: Tensor<3>,
}

impl TrajectoryBatch {
    /// The particles at frame `t`.
    pub(crate) fn at(&self, t: usize) -> ParticleState {
        ParticleState { position: at(&self.position, t), velocity: at(&self.velocity, t) }
    }

    /// The trajectory of consecutive frames.
    pub(crate) fn stack(frames: Vec<ParticleState>) -> Self {
        let (position, velocity) = frames.into_iter().map(|s| (s.position, s.velocity)).unzip();
        Self {
            position: Tensor::stack::<3>(position, 0),
            velocity: Tensor::stack::<3>(velocity, 0),
        }
    }
}

/// Frame `t` of `[T, R, width]`.
pub(crate) fn at(frames: &Tensor<3>, t: usize) -> Tensor<2> {
    let [_, rows, width] = frames.dims();
    frames.clone().slice([t..t + 1, 0..rows, 0..width]).reshape([rows, width])
}

/// The state that a network carries from frame to frame; empty before the first frame.
#[derive(Clone, Debug, Default)]
pub(crate) struct RecurrentState {
    /// The states of the core's L layers, one behind another: a row per window in the frame model, per particle in the particle
    /// model, with the last outputs, then the cells of an LSTM: `[L R, S H]`.
    pub(crate) states: Option<Tensor<2>>,
    /// Particle model: the velocities that the ballistic step expects in the coming frame, `[R, 2]`.
    pub(crate) expected_velocity: Option<Tensor<2>>,
}

impl RecurrentState {
    /// The same values, through which no gradient passes.
    pub(crate) fn without_gradient(self) -> Self {
        let Self { states, expected_velocity } = self;
        Self {
            states: states.map(Tensor::detach),
            expected_velocity: expected_velocity.map(Tensor::detach),
        }
    }
}
