//! A network on a device, with the state it carries from frame to frame.

use std::sync::Arc;

use burn::tensor::{Device, Gradients, Tensor};

use super::{
    definition::Definition,
    described::{Inputs, Model, Outputs},
    dropout::Dropout,
    recorded::Recorded,
    state::{ParticleState, RecurrentState, StaticInputs, TrajectoryBatch},
};
use eddy_inference::checkpoint::{Architecture, Description};

/// A network with weights.
#[derive(Clone, Debug)]
pub(crate) struct Network {
    model: Arc<Model>,
    executor: Executor,
}

/// Who computes it.
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "there is one per network")]
enum Executor {
    Definition(Definition),
    Recorded(Recorded),
}

impl Network {
    /// The network with weights in the order of the plan. With autodiff, gradients by all of them are recorded.
    pub(crate) fn new(model: &Arc<Model>, weights: &Arc<Vec<Vec<f32>>>, device: &Device) -> Self {
        let executor = if device.is_autodiff() && *device == Device::flex() {
            Executor::Recorded(Recorded::new(Arc::clone(weights), device))
        } else {
            Executor::Definition(Definition::new(model, weights, device))
        };
        Self { model: Arc::clone(model), executor }
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
        let Outputs { next, expected, states } = match &self.executor {
            Executor::Definition(definition) => definition.run(&self.model, inputs),
            Executor::Recorded(recorded) => recorded.run(&self.model, inputs),
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
        match &self.executor {
            Executor::Definition(definition) => definition.core(&self.model, input),
            Executor::Recorded(recorded) => recorded.core(&self.model, input),
        }
    }

    /// The gradients by the weights, in their order, once the loss was differentiated; empty if it does not depend on them.
    pub(crate) fn gradients(&self, gradients: &mut Gradients) -> Vec<Vec<f32>> {
        match &self.executor {
            Executor::Definition(definition) => definition.gradients(gradients),
            Executor::Recorded(recorded) => recorded.gradients(),
        }
    }
}
