//! Training steps on synthetic data, for benchmarks: the paper's network, or its core alone. On an NVIDIA GPU, the core alone is the
//! network with [`GPU_CORE_PARTICLES`] particles, whose other layers take next to no time.

use std::{collections::BTreeMap, sync::Arc};

use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

#[cfg(feature = "cuda")]
use super::cuda::Learner;
use super::{
    LossConfig, OptimizerConfig, TrainConfig, TrainError, batch::Batch, loss,
    loss_weights::LossScale, optimizer::Optimizer, window::Window,
};
use crate::model::{DeviceKind, GpuOptions, described::Model, dropout::Dropout, network::Network};
#[cfg(feature = "cuda")]
use eddy_dataset::Trajectory;
use eddy_frames::{Domain, Material, State};
use eddy_inference::{
    checkpoint::{Architecture, Core, Description, MaterialInput, Weights, initial_weights},
    engine::Ballistic,
};

/// Number of particles of the paper's scenes.
pub const PARTICLES: usize = 2500;

/// Number of particles of the network that stands for its core on an NVIDIA GPU.
pub const GPU_CORE_PARTICLES: usize = 8;

/// The part of the network to train.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Part {
    /// The whole frame model: observes the frames, predicts the next one, and minimises the mean squared error.
    Frame,
    /// The core alone, on random encodings: minimises its mean squared output.
    Core,
}

/// A network with data.
pub struct StepBenchmark(Steps);

enum Steps {
    Burn(Box<BurnSteps>),
    #[cfg(feature = "cuda")]
    Cuda(Box<cuda::Steps>),
}

/// Steps through burn, all on the same batch.
struct BurnSteps {
    model: Arc<Model>,
    /// In the order of the plan.
    weights: Arc<Vec<Vec<f32>>>,
    /// With gradients.
    device: Device,
    task: Task,
    optimizer: Optimizer,
    settings: OptimizerConfig,
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

/// The paper's network, with the plain mean squared error of the frame after `frames` observed ones.
fn config(core: Core, frames: usize, windows: usize) -> TrainConfig {
    let mut config = TrainConfig::paper();
    config.network.frame.material = MaterialInput::OneHot;
    config.core = core;
    config.windows.warm_up = frames;
    config.windows.batch = windows;
    config.network.dropout = 0.0;
    config.loss.density_weight = 0.0;
    config.optimizer.clip = f32::INFINITY;
    config
}

/// Initial weights. With the initial decoder of zeros, other layers would have no gradients.
fn weights(description: &Description, random: &mut ChaCha8Rng) -> BTreeMap<String, Weights> {
    let mut tensors = initial_weights(description, 1);
    for weight in tensors.get_mut("decoder.weight").into_iter().flat_map(|w| &mut w.values) {
        *weight = random.random_range(-0.03..0.03);
    }
    tensors
}

impl StepBenchmark {
    /// A network with the paper's widths, and batches of `windows` windows of `frames` observed frames.
    ///
    /// # Errors
    /// [`TrainError`] of an NVIDIA GPU.
    pub fn new(
        part: Part,
        core: Core,
        frames: usize,
        windows: usize,
        device: DeviceKind,
        gpu: GpuOptions,
    ) -> Result<Self, TrainError> {
        Ok(Self(match device {
            #[cfg(feature = "cuda")]
            DeviceKind::Cuda(number) => {
                let config = config(core, frames, windows);
                let particles = match part {
                    Part::Frame => PARTICLES,
                    Part::Core => GPU_CORE_PARTICLES,
                };
                let open = |description: &Description, streams: &[Trajectory]| {
                    let (number, free) = (number.into(), u64::MAX);
                    Learner::new(number, gpu, free, &config, description, streams)
                };
                Steps::Cuda(Box::new(cuda::Steps::new(&config, particles, &open)?))
            }
            _ => {
                let _ = gpu;
                Steps::Burn(Box::new(BurnSteps::new(part, core, frames, windows, device)))
            }
        }))
    }

    /// Takes steps, and returns how many: one through burn, several on an NVIDIA GPU, where training prepares them together.
    ///
    /// # Errors
    /// [`TrainError`] of an NVIDIA GPU.
    pub fn run(&mut self) -> Result<usize, TrainError> {
        match &mut self.0 {
            Steps::Burn(steps) => {
                steps.step();
                Ok(1)
            }
            #[cfg(feature = "cuda")]
            Steps::Cuda(steps) => Ok(steps.run()?.len()),
        }
    }
}

impl BurnSteps {
    fn new(part: Part, core: Core, frames: usize, windows: usize, device: DeviceKind) -> Self {
        let config = config(core, frames, windows);
        let sizes = config.sizes(PARTICLES);
        let description = Description::untrained(Architecture::Frame, core, sizes);
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let plain = device.device();
        let recorded = plain.clone().autodiff();
        let tensors = weights(&description, &mut random);
        let model = Model::new(&description);
        let weights = Arc::new(model.plan.in_order(&tensors));
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
                    noise: &config.windows.noise,
                    normalization: &description.normalization,
                    ballistic: Ballistic::new(&description),
                    common: Vec::new(),
                };
                let batch = Batch::new(&windows, frames, &scale, &description, &plain);
                let domain = description.domain;
                Task::Frame { batch: Box::new(batch), loss: config.loss.clone(), domain }
            }
        };
        let optimizer = Optimizer::new(&config, &description);
        Self { model, weights, device: recorded, task, optimizer, settings: config.optimizer }
    }

    /// Forward pass, loss, backward pass and optimizer step. Returns the loss before the step.
    fn step(&mut self) -> f32 {
        let (value, gradients) = self.gradients();
        let mut step = self.optimizer.step(self.settings.learning_rate, &self.settings);
        let weights = Arc::make_mut(&mut self.weights).iter_mut().zip(&gradients).enumerate();
        for (tensor, (values, gradient)) in weights.filter(|(_, (_, by))| !by.is_empty()) {
            step.change(tensor, values, gradient);
        }
        value
    }

    /// The loss, and its gradients by the weights.
    fn gradients(&self) -> (f32, Vec<Vec<f32>>) {
        let network = Network::new(&self.model, &self.weights, &self.device);
        let loss = match &self.task {
            Task::Frame { batch, loss, domain } => {
                let (predicted, steps) = loss::unroll(&network, batch, 0, &mut Dropout::none());
                loss::loss(loss, batch, &predicted, &steps, *domain)
            }
            Task::Core(encodings) => network.core(encodings.clone()).square().mean(),
        };
        (loss.clone().inner().into_scalar(), network.gradients(&mut loss.backward()))
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
        stiffness: None,
        states: states.collect(),
        sweeps: vec![None; frames - 1],
        noisy: None,
    }
}

/// Steps on an NVIDIA GPU, with all that training does beside them.
#[cfg(feature = "cuda")]
mod cuda {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::super::{
        TrainConfig, TrainError,
        cuda::Learner,
        gradients::GradientTask,
        loss_weights::LossScale,
        state::{RunState, in_order},
        steps::Step,
        window::Sampler,
    };
    use crate::model::DeviceKind;
    use eddy_dataset::{Stream, Trajectory};
    use eddy_frames::{Domain, Material, Stamp, State};
    use eddy_inference::{
        checkpoint::{Architecture, Description},
        engine::Ballistic,
    };

    /// Steps that are prepared together.
    const TOGETHER: usize = 16;
    /// Windows that a stream has.
    const WINDOWS: usize = 64;

    /// Opens a learner for a network and streams.
    type Open<'a> = dyn Fn(&Description, &[Trajectory]) -> Result<Learner, TrainError> + 'a;

    pub(super) struct Steps {
        config: TrainConfig,
        description: Description,
        streams: Vec<Trajectory>,
        learner: Learner,
        state: RunState,
    }

    impl Steps {
        /// The network of `config`, on a stream of particles that move uniformly.
        pub(super) fn new(
            config: &TrainConfig,
            particles: usize,
            open: &Open<'_>,
        ) -> Result<Self, TrainError> {
            let sizes = config.sizes(particles);
            let description = Description::untrained(Architecture::Frame, config.core, sizes);
            let mut random = ChaCha8Rng::seed_from_u64(1);
            let weights = super::weights(&description, &mut random);
            let frames = config.windows.warm_up + WINDOWS;
            let streams = vec![stream(particles, frames, description.dt, &mut random)];
            let learner = open(&description, &streams)?;
            let mut state = RunState::new(config, &description, None);
            state.weights = in_order(&description, &weights).into();
            state.unroll = 1;
            let mut steps = Self { config: config.clone(), description, streams, learner, state };
            steps.with_task(|learner, task, _, state| learner.begin(task, state))?;
            Ok(steps)
        }

        pub(super) fn run(&mut self) -> Result<Vec<Step>, TrainError> {
            let rates = [self.config.optimizer.learning_rate; TOGETHER];
            self.with_task(|learner, task, sampler, state| {
                learner.steps(task, sampler, &rates, state)
            })
        }

        fn with_task<T>(
            &mut self,
            work: impl FnOnce(
                &mut Learner,
                &GradientTask,
                &Sampler,
                &mut RunState,
            ) -> Result<T, TrainError>,
        ) -> Result<T, TrainError> {
            let Self { config, description, streams, learner, state } = self;
            let scale = LossScale {
                loss: &config.loss,
                noise: &config.windows.noise,
                normalization: &description.normalization,
                ballistic: Ballistic::new(description),
                common: Vec::new(),
            };
            let device = DeviceKind::Flex;
            let task = GradientTask { config, description, scale: &scale, device };
            work(learner, &task, &Sampler::new(streams, &config.windows, 1)?, state)
        }
    }

    /// Particles that move uniformly, and stay in the domain.
    fn stream(particles: usize, frames: usize, dt: f32, random: &mut ChaCha8Rng) -> Trajectory {
        let fastest = 0.2 / (frames as f32 * dt);
        let mut pairs = |low: f32, high: f32| -> Vec<[f32; 2]> {
            (0..particles).map(|_| [(); 2].map(|()| random.random_range(low..high))).collect()
        };
        let (start, velocity) = (pairs(0.2, 0.8), pairs(-fastest, fastest));
        let state = |t: usize| {
            let moved = |(x, v): (&[f32; 2], &[f32; 2])| {
                [x[0] + v[0] * dt * t as f32, x[1] + v[1] * dt * t as f32]
            };
            let position = start.iter().zip(&velocity).map(moved).collect();
            State { position, velocity: velocity.clone() }
        };
        Trajectory::from(Stream {
            id: 0,
            source: "memory".into(),
            dt,
            domain: Domain::UNIT,
            material: vec![Material::Liquid; particles],
            first_sequence: 0,
            first_stamp: Stamp::default(),
            stiffness: None,
            tools: None,
            states: (0..frames).map(state).collect(),
        })
    }

    #[cfg(test)]
    mod tests {
        use std::sync::Arc;

        use super::*;
        use crate::model::Core;
        use eddy_cuda::{device::Device, frame::Place, kernels::Constants};
        use eddy_cuda_emulator::Emulator;

        #[test]
        fn timed_steps_train_the_network() {
            let mut config = super::super::config(Core::MinGru, 3, 2);
            config.network.encoder = 9;
            config.network.hidden = 12;
            let open = |description: &Description, streams: &[Trajectory]| {
                let device = Arc::new(Emulator::new(&Constants::of(description)?)?);
                Learner::on([(device as Arc<dyn Device>, Place::Device)], description, streams)
            };
            let mut steps = Steps::new(&config, 8, &open).unwrap();
            let mut mean = || {
                let steps = steps.run().unwrap();
                assert_eq!(steps.len(), TOGETHER);
                steps.iter().map(|step| step.loss).sum::<f32>() / TOGETHER as f32
            };
            let (first, second) = (mean(), mean());
            assert!(second < 0.9 * first, "loss {first}, later {second}");
        }
    }
}
