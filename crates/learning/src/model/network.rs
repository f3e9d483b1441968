//! A network on a device, with the state it carries from frame to frame.

use std::sync::Arc;

use burn::tensor::{Device, Gradients, Tensor};

use super::{
    definition::Definition,
    dropout::Dropout,
    grid_context::GridContext,
    recorded::Recorded,
    state::{ParticleState, RecurrentState, StaticInputs, TrajectoryBatch},
};
use eddy_inference::{
    checkpoint::{Architecture, Description, plan::Plan},
    ops::{
        ballistic::Ballistic,
        cell::AnyCell,
        decoder::{Decoded, ResidualStep},
        features::{Features, FrameFeatures},
    },
};

/// A described network without its weights.
#[derive(Clone, Debug)]
pub(crate) struct Model {
    pub(crate) description: Description,
    pub(crate) plan: Plan,
    pub(crate) ballistic: Ballistic,
    pub(crate) cell: AnyCell,
    /// Features and step of the particle model.
    pub(crate) features: Features,
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
            features: Features::new(description),
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

/// A network with weights.
#[derive(Clone, Debug)]
pub(crate) struct Network {
    model: Arc<Model>,
    form: Form,
}

/// Who computes it.
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "there is one per network")]
enum Form {
    Definition(Definition),
    Recorded(Recorded),
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

impl Network {
    /// The network with weights in the order of the plan. With autodiff, gradients by all of them are recorded.
    pub(crate) fn new(model: &Arc<Model>, weights: &Arc<Vec<Vec<f32>>>, device: &Device) -> Self {
        let form = if device.is_autodiff() && *device == Device::flex() {
            Form::Recorded(Recorded::new(Arc::clone(weights), device))
        } else {
            Form::Definition(Definition::new(model, weights, device))
        };
        Self { model: Arc::clone(model), form }
    }

    /// Predicts the frame after each frame of a trajectory `[T, R, 2]`, all frames at once: R = B N rows, window by window.
    /// Returns the predictions, `[T, R, 2]`, and the state after the last frame.
    pub(crate) fn observe(
        &self,
        trajectory: &TrajectoryBatch,
        fixed: &Arc<StaticInputs>,
        hidden: RecurrentState,
        dropout: &mut Dropout,
    ) -> (TrajectoryBatch, RecurrentState) {
        let Description { architecture, sizes, .. } = &self.model.description;
        let [frames, rows, _] = trajectory.position.dims();
        let flat = |t: &Tensor<3>| t.clone().reshape([frames * rows, 2]);
        let (position, velocity) = (flat(&trajectory.position), flat(&trajectory.velocity));
        let of_frame = |t: Tensor<2>, frame| t.slice([frame * rows..(frame + 1) * rows, 0..2]);
        let expected = hidden.expected_velocity.unwrap_or_else(|| of_frame(velocity.clone(), 0));
        let core_rows = match architecture {
            Architecture::Frame => fixed.windows,
            Architecture::Particle => rows,
        };
        let device = position.device();
        let zeros = || Tensor::zeros(self.model.state_shape(core_rows), &device);
        let states = hidden.states.unwrap_or_else(zeros);
        let masks = dropout.masks(sizes.layers, frames * core_rows * sizes.hidden);
        let fixed = Arc::clone(fixed);
        let inputs = Inputs { frames, position, velocity, expected, states, fixed, masks };
        let Outputs { next, expected, states } = match &self.form {
            Form::Definition(definition) => definition.run(&self.model, inputs),
            Form::Recorded(recorded) => recorded.run(&self.model, inputs),
        };
        let part = |first| next.clone().slice([0..frames * rows, first..first + 2]);
        let [position, velocity] = [0, 2].map(|first| part(first).reshape([frames, rows, 2]));
        let predicted = TrajectoryBatch { position, velocity };
        let expected_velocity = expected.map(|expected| of_frame(expected, frames - 1));
        (predicted, RecurrentState { states: Some(states), expected_velocity })
    }

    /// Predicts the next frame: [`Network::observe`] for a single frame.
    pub(crate) fn step(
        &self,
        state: &ParticleState,
        fixed: &Arc<StaticInputs>,
        hidden: RecurrentState,
        dropout: &mut Dropout,
    ) -> (ParticleState, RecurrentState) {
        let frame = TrajectoryBatch::stack(vec![state.clone()]);
        let (next, hidden) = self.observe(&frame, fixed, hidden, dropout);
        (next.at(0), hidden)
    }

    /// The core alone from a zero state: the outputs of its last layer, `[T, R, H]`, from the inputs of the first one, `[T, R, I]`.
    pub(crate) fn core(&self, input: Tensor<3>) -> Tensor<3> {
        match &self.form {
            Form::Definition(definition) => definition.core(&self.model, input),
            Form::Recorded(recorded) => recorded.core(&self.model, input),
        }
    }

    /// The gradients by the weights, in their order, once the loss was differentiated; empty if it does not depend on them.
    pub(crate) fn gradients(&self, gradients: &mut Gradients) -> Vec<Vec<f32>> {
        match &self.form {
            Form::Definition(definition) => definition.gradients(gradients),
            Form::Recorded(recorded) => recorded.gradients(),
        }
    }
}
