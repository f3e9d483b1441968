//! Training steps on synthetic data, for benchmarks: the paper's network, or its core alone.

use burn::tensor::{Device, Gradients, Tensor, TensorData};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{
    LossConfig, OptimizerConfig, TrainConfig, adam::Adam, batch::Batch, loss,
    loss_weights::LossScale, window::Window,
};
use crate::model::{DeviceKind, dropout::Dropout, network::Network};
use eddy_evaluation::dataset::State;
use eddy_frames::{Domain, Material};
use eddy_inference::{
    checkpoint::{Architecture, Core, Description, initial_weights},
    engine::Ballistic,
};

/// Number of particles of the paper's scenes.
pub const PARTICLES: usize = 2500;

/// The part of the network to train.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Part {
    /// The whole frame model: observes the frames, predicts the next one, and minimises the mean squared error.
    Frame,
    /// The core alone, on random encodings: minimises its mean squared output.
    Core,
}

/// A network with a batch of data.
pub struct StepBenchmark {
    network: Network,
    task: Task,
    adam: Adam,
    optimizer: OptimizerConfig,
}

enum Task {
    Frame {
        batch: Box<Batch>,
        loss: LossConfig,
        domain: Domain,
    },
    /// Encodings, `[T, B, H]`.
    Core(Tensor<3>),
}

impl StepBenchmark {
    /// A network with the paper's widths, and `windows` windows of `frames` observed frames.
    pub fn new(part: Part, core: Core, frames: usize, windows: usize, device: DeviceKind) -> Self {
        let mut config = TrainConfig::defaults(Architecture::Frame);
        config.loss.density_weight = 0.0;
        config.optimizer.clip = f32::INFINITY;
        let sizes = config.sizes(PARTICLES);
        let description = Description::untrained(Architecture::Frame, core, sizes);
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let plain = device.device();
        let recorded = plain.clone().autodiff();
        // With the initial decoder of zeros, other layers would have no gradients.
        let mut tensors = initial_weights(&description, 1);
        for weight in tensors.get_mut("decoder.weight").into_iter().flat_map(|w| &mut w.values) {
            *weight = random.random_range(-0.03..0.03);
        }
        let network = Network::new(&description, &tensors, &recorded);
        let task = match part {
            Part::Core => Task::Core(encodings(
                [frames, windows, description.sizes.hidden],
                &recorded,
                &mut random,
            )),
            Part::Frame => {
                let windows: Vec<Window> =
                    (0..windows).map(|_| window(frames + 1, description.dt, &mut random)).collect();
                let scale = LossScale {
                    loss: &config.loss,
                    normalization: &description.normalization,
                    ballistic: Ballistic::new(&description),
                    common: Vec::new(),
                };
                let batch = Batch::new(&windows, frames, &scale, None, &plain);
                let domain = description.domain;
                Task::Frame { batch: Box::new(batch), loss: config.loss.clone(), domain }
            }
        };
        Self { network, task, adam: Adam::default(), optimizer: config.optimizer }
    }

    /// Forward pass, loss, backward pass and optimizer step. Returns the loss before the step.
    pub fn step(&mut self) -> f32 {
        let (value, mut gradients) = self.gradients();
        let mut step = self.adam.step(self.optimizer.learning_rate, &self.optimizer);
        self.network.layers_mut().update(&mut gradients, |tensor, values, gradient| {
            step.change(tensor, values, gradient);
        });
        value
    }

    fn gradients(&self) -> (f32, Gradients) {
        let loss = match &self.task {
            Task::Frame { batch, loss, domain } => {
                let (predicted, steps) = loss::unroll(&self.network, batch, &mut Dropout::none());
                loss::loss(loss, batch, &predicted, &steps, *domain)
            }
            Task::Core(encodings) => {
                let layers = &self.network.layers().core;
                let signal = layers
                    .iter()
                    .fold(encodings.clone(), |signal, layer| layer.observe(signal, None).0);
                signal.square().mean()
            }
        };
        (loss.clone().inner().into_scalar(), loss.backward())
    }
}

fn encodings(shape: [usize; 3], device: &Device, random: &mut ChaCha8Rng) -> Tensor<3> {
    let values: Vec<f32> =
        (0..shape.iter().product()).map(|_| random.random_range(-1.0..1.0)).collect();
    Tensor::from_data(TensorData::new(values, shape), device).require_grad()
}

/// Particles that move uniformly.
fn window(frames: usize, dt: f32, random: &mut ChaCha8Rng) -> Window {
    let mut pairs = |low: f32, high: f32| -> Vec<[f32; 2]> {
        (0..PARTICLES).map(|_| [(); 2].map(|()| random.random_range(low..high))).collect()
    };
    let (start, velocity) = (pairs(0.2, 0.8), pairs(-1.0, 1.0));
    let states = (0..frames).map(|t| {
        let moved = |(x, v): (&[f32; 2], &[f32; 2])| {
            [x[0] + v[0] * dt * t as f32, x[1] + v[1] * dt * t as f32]
        };
        let position = start.iter().zip(&velocity).map(moved).collect();
        State { position, velocity: velocity.clone() }
    });
    Window {
        stream: 0,
        start: 0,
        material: vec![Material::Liquid; PARTICLES],
        rest: start.clone(),
        states: states.collect(),
        noisy: None,
    }
}
