//! What takes the steps of a training.

#[cfg(feature = "cuda")]
use std::sync::Arc;

#[cfg(feature = "cuda")]
use super::{DenseConfig, VALIDATION_PAIRS};
use super::{network::Network, pairs::Frames};
#[cfg(feature = "cuda")]
pub(super) use eddy_cuda::dense::Move;
#[cfg(feature = "cuda")]
use eddy_cuda::{dense, device::Device, kernels::Program};
use eddy_inference::checkpoint::Activation;
use eddy_learning::train::{TrainConfig, TrainError};

/// Decays of Adam's moments.
pub(super) const BETAS: [f64; 2] = [0.9, 0.999];

/// How Adam moves: its rate and 1 / sqrt(1 - beta_2^t), both corrected for the start from zero, and its epsilon.
#[cfg(not(feature = "cuda"))]
#[derive(Clone, Copy, Debug)]
pub(super) struct Move {
    pub(super) rate: f32,
    pub(super) correction: f32,
    pub(super) epsilon: f32,
}

/// The network where it is trained.
enum Place {
    Processor(Network),
    #[cfg(feature = "cuda")]
    Gpu(Box<dense::Dense>),
}

/// The network and the number of its steps.
pub(super) struct Trainer {
    place: Place,
    steps: i32,
}

/// Opens a device with the kernels of a program.
#[cfg(feature = "cuda")]
pub(super) type OpenDevice<'a> = dyn Fn(&dyn Program) -> Result<Arc<dyn Device>, TrainError> + 'a;

impl Trainer {
    /// From the weights `[in, out]` and bias of each layer.
    pub(super) fn on_processor(activation: Activation, weights: Vec<[Vec<f32>; 2]>) -> Self {
        Self { place: Place::Processor(Network::new(activation, weights)), steps: 0 }
    }

    #[cfg(feature = "cuda")]
    pub(super) fn on_device(
        config: &DenseConfig,
        activation: Activation,
        weights: &[[Vec<f32>; 2]],
        open: &OpenDevice<'_>,
    ) -> Result<Self, TrainError> {
        let constants = dense::Constants { width: config.width, activation };
        let rows = config.batch.max(VALIDATION_PAIRS);
        let features = weights.last().map_or(0, |[_, bias]| bias.len());
        let network = dense::Dense::new(open(&constants)?, constants, features, weights, rows)?;
        Ok(Self { place: Place::Gpu(Box::new(network)), steps: 0 })
    }

    /// A step of Adam without clipping; the mean squared error before it.
    #[cfg_attr(not(feature = "cuda"), expect(clippy::unnecessary_wraps, reason = "a GPU can fail"))]
    pub(super) fn step(&mut self, [input, truth]: &Frames, rate: f64) -> Result<f64, TrainError> {
        self.steps = self.steps.saturating_add(1);
        let [first, second] = BETAS.map(|beta| 1.0 - beta.powi(self.steps));
        let by = Move {
            rate: (rate / first) as f32,
            correction: 1.0 / second.sqrt() as f32,
            epsilon: TrainConfig::paper().optimizer.epsilon,
        };
        Ok(match &mut self.place {
            Place::Processor(network) => network.step(input, truth, by),
            #[cfg(feature = "cuda")]
            Place::Gpu(network) => network.step(input, truth, by)?,
        })
    }

    /// The mean squared error of predictions.
    #[cfg_attr(not(feature = "cuda"), expect(clippy::unnecessary_wraps, reason = "a GPU can fail"))]
    pub(super) fn loss(&mut self, [input, truth]: &Frames) -> Result<f64, TrainError> {
        Ok(match &mut self.place {
            Place::Processor(network) => network.loss(input, truth),
            #[cfg(feature = "cuda")]
            Place::Gpu(network) => network.loss(input, truth)?,
        })
    }
}
