//! Either network, with the state it carries from frame to frame.

use std::collections::BTreeMap;

use burn::tensor::Device;

use super::{
    dropout::Dropout,
    frame_model::FrameModel,
    layers::Layers,
    particle_model::ParticleModel,
    state::{ParticleState, RecurrentState, StaticInputs, TrajectoryBatch},
};
use eddy_inference::checkpoint::{Architecture, Description, Weights};

/// A network.
#[derive(Clone, Debug)]
pub(crate) enum Network {
    Frame(FrameModel),
    Particle(ParticleModel),
}

impl Network {
    /// The described network with weights that match the description. On a device with autodiff it can be trained.
    pub(crate) fn new(
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
        device: &Device,
    ) -> Self {
        let layers = Layers::new(description, tensors, device);
        match description.architecture {
            Architecture::Frame => Self::Frame(FrameModel::new(description, layers, device)),
            Architecture::Particle => {
                Self::Particle(ParticleModel::new(description, layers, device))
            }
        }
    }

    /// A copy with separate gradients.
    pub(crate) fn detached(&self) -> Self {
        let mut network = self.clone();
        *network.layers_mut() = self.layers().detached();
        network
    }

    pub(crate) fn layers(&self) -> &Layers {
        match self {
            Self::Frame(model) => &model.layers,
            Self::Particle(model) => &model.layers,
        }
    }

    pub(crate) fn layers_mut(&mut self) -> &mut Layers {
        match self {
            Self::Frame(model) => &mut model.layers,
            Self::Particle(model) => &mut model.layers,
        }
    }

    /// Observes T consecutive frames at once, from the state `hidden`. Returns the prediction after each of them and the state
    /// after the last.
    pub(crate) fn observe(
        &self,
        trajectory: &TrajectoryBatch,
        fixed: &StaticInputs,
        hidden: RecurrentState,
        dropout: &mut Dropout,
    ) -> (TrajectoryBatch, RecurrentState) {
        match self {
            Self::Frame(model) => model.observe(trajectory, fixed, hidden, dropout),
            Self::Particle(model) => model.observe(trajectory, fixed, hidden, dropout),
        }
    }

    /// Observes one frame, from the state `hidden`. Returns the predicted next frame and the new state.
    pub(crate) fn step(
        &self,
        state: &ParticleState,
        fixed: &StaticInputs,
        hidden: RecurrentState,
        dropout: &mut Dropout,
    ) -> (ParticleState, RecurrentState) {
        match self {
            Self::Frame(model) => model.step(state, fixed, hidden, dropout),
            Self::Particle(model) => model.step(state, fixed, hidden, dropout),
        }
    }
}
