//! Particles, trajectories and hidden states as tensors.

use std::sync::Arc;

use burn::tensor::{Device, Tensor, TensorData};

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
    /// Features that do not change: materials, one-hot, then the stiffness, if the network is conditioned on it, `[R, 4]` or `[R, 5]`.
    pub(crate) constants: Tensor<2>,
    /// The same as a list.
    pub(crate) constant_list: Arc<Vec<f32>>,
    /// B; all windows have the same number of particles.
    pub(crate) windows: usize,
    /// The rest shapes of solids.
    pub(crate) rest: Arc<RestShape>,
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
        device: &Device,
    ) -> Self {
        let spacing = grid.map_or(0.0, |grid| grid.spacing);
        let rest = Arc::new(RestShape::new(rest, material, windows, spacing));
        let particles = material.len() / windows;
        let constants: Vec<f32> = material
            .iter()
            .enumerate()
            .flat_map(|(row, material)| {
                let one_hot = Material::ALL.map(|kind| f32::from(u8::from(kind == *material)));
                let stiffness = stiffness.map(|all| stiffness_feature(all[row / particles]));
                one_hot.into_iter().chain(stiffness)
            })
            .collect();
        let width = Material::COUNT + usize::from(stiffness.is_some());
        let data = TensorData::new(constants.clone(), [material.len(), width]);
        let tensor = Tensor::from_data(data, device);
        Self { constants: tensor, constant_list: Arc::new(constants), windows, rest }
    }

    /// N.
    pub(crate) fn particles(&self) -> usize {
        self.rest.len() / self.windows
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

/// The state that a layer of the core carries from frame to frame.
#[derive(Clone, Debug)]
pub(crate) struct LayerState {
    /// Its last output, `[R, H]`.
    pub(crate) hidden: Tensor<2>,
    /// The cell of an LSTM, `[R, H]`.
    pub(crate) cell: Option<Tensor<2>>,
}

/// The state that a network carries from frame to frame; empty before the first frame.
#[derive(Clone, Debug, Default)]
pub(crate) struct RecurrentState {
    /// The state of each layer of the core: one row per window in the frame model, one per particle in the particle model.
    pub(crate) layers: Vec<LayerState>,
    /// Particle model: the velocities that the ballistic step expects in the coming frame, `[R, 2]`.
    pub(crate) expected_velocity: Option<Tensor<2>>,
}

impl RecurrentState {
    /// The same values, through which no gradient passes.
    pub(crate) fn without_gradient(self) -> Self {
        let layer = |LayerState { hidden, cell }: LayerState| LayerState {
            hidden: hidden.detach(),
            cell: cell.map(Tensor::detach),
        };
        Self {
            layers: self.layers.into_iter().map(layer).collect(),
            expected_velocity: self.expected_velocity.map(Tensor::detach),
        }
    }
}
