//! Either network behind one set of calls, with the state it carries from frame to frame.

use std::collections::BTreeMap;

use burn::tensor::{Device, Tensor, TensorData};
use rand::{Rng as _, RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{
    Bodies, Matter, Track, core::LayerState, frame_model::FrameModel, layers::Layers,
    particle_model::ParticleModel,
};
use eddy_inference::checkpoint::{Architecture, Description, Weights};

/// What a network carries from frame to frame. Empty before the first one.
#[derive(Clone, Debug, Default)]
pub(crate) struct Hidden {
    /// The state of each layer of the core: one row a window in the frame model, one a particle in
    /// the particle model.
    pub(crate) states: Vec<LayerState>,
    /// Particle model: the velocities that the ballistic step foretold for the coming frame, `[R, 2]`.
    pub(crate) foretold: Option<Tensor<2>>,
}

impl Hidden {
    /// The carried state for each recurrent layer, `None` before the first frame.
    pub(crate) fn carried(&self, layers: &Layers) -> Vec<Option<LayerState>> {
        (0..layers.core.len()).map(|layer| self.states.get(layer).cloned()).collect()
    }
}

/// Dropout after each recurrent layer, in training only. Its random numbers are its own, so that a
/// seed gives the same masks whatever else computes on the device.
pub(crate) struct Dropout {
    /// Share of the numbers set to zero, and the source of the choice.
    training: Option<(f32, ChaCha8Rng)>,
}

impl Dropout {
    /// Leaves everything as it is.
    pub(crate) fn none() -> Self {
        Self { training: None }
    }

    /// Sets the share `rate` of all numbers to zero.
    pub(crate) fn new(rate: f32, random: ChaCha8Rng) -> Self {
        Self { training: (rate > 0.0).then_some((rate, random)) }
    }

    /// Another one of the same rate whose choices do not depend on what this one still chooses.
    pub(crate) fn fork(&mut self) -> Self {
        let fork = |(rate, random): &mut (f32, ChaCha8Rng)| {
            (*rate, ChaCha8Rng::seed_from_u64(random.next_u64()))
        };
        Self { training: self.training.as_mut().map(fork) }
    }

    /// The source of the choice, if there is one.
    pub(crate) fn random(&self) -> Option<&ChaCha8Rng> {
        self.training.as_ref().map(|(_, random)| random)
    }

    /// What is left, scaled up so that its expected value stays.
    pub(crate) fn apply<const D: usize>(&mut self, signal: Tensor<D>) -> Tensor<D> {
        let Some((rate, random)) = &mut self.training else {
            return signal;
        };
        let kept = 1.0 / (1.0 - *rate);
        let shape = signal.dims();
        let mask: Vec<f32> = (0..shape.iter().product())
            .map(|_| if random.random::<f32>() < *rate { 0.0 } else { kept })
            .collect();
        let device = signal.device();
        signal * Tensor::from_data(TensorData::new(mask, shape), &device)
    }
}

/// A network, ready to compute.
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "one of them lives as long as the process")]
pub(crate) enum Network {
    Frame(FrameModel),
    Particle(ParticleModel),
}

impl Network {
    /// The described network with the given weights, which fit the description. On a device with
    /// autodiff it can be trained.
    pub(crate) fn new(
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
        device: &Device,
    ) -> Self {
        Self::with_layers(description, Layers::new(description, tensors, device), device)
    }

    fn with_layers(description: &Description, layers: Layers, device: &Device) -> Self {
        match description.architecture {
            Architecture::Frame => Self::Frame(FrameModel::new(description, layers, device)),
            Architecture::Particle => {
                Self::Particle(ParticleModel::new(description, layers, device))
            }
        }
    }

    /// The same network, with gradients of its own.
    pub(crate) fn apart(&self) -> Self {
        let mut network = self.clone();
        *network.layers_mut() = self.layers().apart();
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

    /// Observes T consecutive frames at once, from the state `hidden`. Gives the frame predicted
    /// after each of them and the state after the last.
    pub(crate) fn observe(
        &self,
        track: &Track,
        matter: &Matter,
        hidden: Hidden,
        dropout: &mut Dropout,
    ) -> (Track, Hidden) {
        match self {
            Self::Frame(model) => model.observe(track, matter, hidden, dropout),
            Self::Particle(model) => model.observe(track, matter, hidden, dropout),
        }
    }

    /// Observes one frame from the state `hidden`; gives the predicted next one and the new state.
    pub(crate) fn step(
        &self,
        bodies: &Bodies,
        matter: &Matter,
        hidden: Hidden,
        dropout: &mut Dropout,
    ) -> (Bodies, Hidden) {
        match self {
            Self::Frame(model) => model.step(bodies, matter, hidden, dropout),
            Self::Particle(model) => model.step(bodies, matter, hidden, dropout),
        }
    }
}
