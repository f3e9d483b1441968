//! A described network without its weights, and the frames that it is computed for.

use std::sync::Arc;

use burn::tensor::Tensor;

use super::{grid_context::GridContext, state::StaticInputs};
use eddy_inference::{
    checkpoint::{Description, plan::Plan},
    ops::{
        ballistic::Ballistic,
        cell::AnyCell,
        decoder::{Decoded, ResidualStep},
        features::{FrameFeatures, ParticleFeatures},
    },
};

/// A described network without its weights.
#[derive(Debug)]
pub(crate) struct Model {
    pub(crate) description: Description,
    pub(crate) plan: Plan,
    pub(crate) ballistic: Ballistic,
    pub(crate) cell: AnyCell,
    /// Features and step of the particle model.
    pub(crate) features: ParticleFeatures,
    pub(crate) step: ResidualStep,
    /// The same of the frame model.
    pub(crate) frame_features: FrameFeatures,
    pub(crate) decoded: Decoded,
}

impl Model {
    pub(crate) fn new(description: &Description) -> Arc<Self> {
        Arc::new(Self {
            plan: Plan::new(description),
            ballistic: Ballistic::new(description),
            cell: AnyCell::new(description),
            features: ParticleFeatures::new(description),
            step: ResidualStep::new(description),
            frame_features: FrameFeatures::new(description),
            decoded: Decoded::new(description),
            description: description.clone(),
        })
    }

    /// The nodes around the particles of T frames, `[T R]` (domain lengths), of a particle model.
    pub(crate) fn grid(
        &self,
        position: &[[f32; 2]],
        fixed: &StaticInputs,
        frames: usize,
    ) -> Option<GridContext> {
        let Self { description: Description { grid, domain, .. }, ballistic, .. } = self;
        let windows = frames * fixed.windows;
        grid.as_ref().map(|grid| GridContext::new(grid, ballistic, *domain, position, windows))
    }

    /// Rows and columns of the states of a core that has so many rows a frame, `[L R, S H]`.
    pub(crate) fn state_shape(&self, rows: usize) -> [usize; 2] {
        let Description { core, sizes, .. } = &self.description;
        [sizes.layers * rows, core.states() * sizes.hidden]
    }
}

/// T frames of B windows for the operations of a network.
pub(crate) struct Inputs {
    /// T.
    pub(crate) frames: usize,
    /// `[T R, 2]`.
    pub(crate) position: Tensor<2>,
    /// `[T R, 2]`.
    pub(crate) velocity: Tensor<2>,
    /// The velocities that were expected of the first frame, `[R, 2]`.
    pub(crate) expected: Tensor<2>,
    /// [`RecurrentState::states`] before the first frame.
    pub(crate) states: Tensor<2>,
    pub(crate) fixed: Arc<StaticInputs>,
    /// [`Dropout::masks`].
    pub(crate) masks: Vec<Vec<f32>>,
}

/// What the operations give.
pub(crate) struct Outputs {
    /// Positions and velocities of the frame after each, `[T R, 4]`.
    pub(crate) next: Tensor<2>,
    /// The velocities that are expected of the frame after each, `[T R, 2]`, in a particle model.
    pub(crate) expected: Option<Tensor<2>>,
    /// [`RecurrentState::states`] after the last frame.
    pub(crate) states: Tensor<2>,
}
