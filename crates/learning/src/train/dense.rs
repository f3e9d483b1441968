//! The network of the paper's comparison of activations (supplement B, Fig. 5): dense layers that predict the next frame from
//! one frame. Each feature of each particle is a separate input and output: no pooling, no recurrence, no ballistic step.

#[cfg(feature = "cuda")]
use std::sync::Arc;

use burn::tensor::{Device, Gradients, Tensor, TensorData};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

#[cfg(feature = "cuda")]
use super::optimizer::Correction;
use super::{
    NoiseConfig, TrainConfig, TrainError, WindowConfig,
    config::{at_least_one, positive},
    description::{no_constant_feature, same_particles},
    optimizer::{Optimizer, OptimizerStep},
    window::{self, Sampler, Window},
};
use crate::model::{DeviceKind, GpuOptions, linear::Linear, mlp::activate};
#[cfg(feature = "cuda")]
use eddy_cuda::{dense::Move, kernels::Program};
use eddy_evaluation::dataset::Dataset;
use eddy_frames::State;
use eddy_inference::checkpoint::{Activation, Normalization};

/// Pairs of frames for the validation loss.
const VALIDATION_PAIRS: usize = 512;
/// Seed that draws them.
const VALIDATION_SEED: u64 = 0;

/// Settings of the networks and their training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DenseConfig {
    /// Number of layers with activation, before the output layer.
    pub layers: usize,
    /// Width of each of them.
    pub width: usize,
    /// Number of epochs.
    pub epochs: u32,
    /// Pairs of frames per epoch.
    pub per_epoch: usize,
    /// Pairs of frames per batch.
    pub batch: usize,
    /// Constant learning rate of Adam.
    pub learning_rate: f64,
}

/// The losses of an epoch.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DenseEpoch {
    /// Number of the epoch, from 1.
    pub epoch: u32,
    /// Mean squared error of the MinMax-scaled features x, y, vx, vy over the epoch's batches.
    pub training_loss: f64,
    /// The same after the epoch, over pairs of frames of the validation streams.
    pub validation_loss: f64,
}

/// A learning curve.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DenseCurve {
    /// Validation loss of predicting the last frame again.
    pub persistence: f64,
    /// Validation loss of predicting the mean of each feature over the training split.
    pub mean: f64,
    /// All epochs.
    pub epochs: Vec<DenseEpoch>,
}

impl DenseConfig {
    /// The paper's network and learning rate.
    pub fn paper(epochs: u32, per_epoch: usize) -> Self {
        Self { layers: 3, width: 200, epochs, per_epoch, batch: 192, learning_rate: 1e-3 }
    }

    /// Checks the values.
    ///
    /// # Errors
    /// [`TrainError::Setting`] for the first value that is out of its range.
    pub fn check(&self) -> Result<(), TrainError> {
        at_least_one("dense.layers", self.layers)?;
        at_least_one("dense.width", self.width)?;
        at_least_one("dense.epochs", self.epochs as usize)?;
        at_least_one("dense.per_epoch", self.per_epoch)?;
        at_least_one("dense.batch", self.batch)?;
        positive("dense.learning_rate", self.learning_rate)
    }
}

/// Trains the network with one activation, on an NVIDIA GPU if that is the device, otherwise on burn-flex. The same arguments
/// give the same curve. Returns none if `interrupted`, which is called before every batch, returns true.
///
/// # Errors
/// [`TrainError`]: settings out of range, streams that differ in the number of particles or are too short, a loss that is not
/// finite.
pub fn train_dense(
    config: &DenseConfig,
    activation: Activation,
    seed: u64,
    dataset: &Dataset,
    device: DeviceKind,
    #[cfg_attr(not(feature = "cuda"), expect(unused_variables, reason = "for GPUs"))]
    gpu: GpuOptions,
    interrupted: &dyn Fn() -> bool,
) -> Result<Option<DenseCurve>, TrainError> {
    let open = |weights: Vec<[Vec<f32>; 2]>| match device {
        #[cfg(feature = "cuda")]
        DeviceKind::Cuda(number) => {
            let open = |constants: &dyn Program| {
                let gpu = eddy_cuda::open_gpu(number.into(), constants, gpu.precision)?;
                Ok(Arc::new(gpu) as Arc<dyn eddy_cuda::device::Device>)
            };
            Trainer::on_device(config, activation, &weights, &open)
        }
        _ => Ok(Trainer::through_burn(activation, weights)),
    };
    train_with(config, seed, dataset, &open, interrupted)
}

fn train_with(
    config: &DenseConfig,
    seed: u64,
    dataset: &Dataset,
    open: &dyn Fn(Vec<[Vec<f32>; 2]>) -> Result<Trainer, TrainError>,
    interrupted: &dyn Fn() -> bool,
) -> Result<Option<DenseCurve>, TrainError> {
    config.check()?;
    let particles = dataset.train.first().map_or(0, |stream| stream.material.len());
    same_particles(dataset, particles)?;
    no_constant_feature(dataset)?;
    let windows = pairs(config);
    let mut sampler = Sampler::new(&dataset.train, &windows, 1)?;
    let validation = Sampler::new(&dataset.validation, &windows, 1)?
        .draw(VALIDATION_PAIRS, &mut ChaCha8Rng::seed_from_u64(VALIDATION_SEED))?;

    let scale = Scaling::new(&dataset.normalization);
    let validation = scale.frames(&validation);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let features = FEATURES * particles;
    let mut trainer = open(initial_weights(config, features, &mut random))?;
    let batches = config.per_epoch.div_ceil(config.batch);
    let mut curve = DenseCurve {
        persistence: error(&validation[0], &validation[1]),
        mean: error(&scale.mean(validation[1].len()), &validation[1]),
        epochs: Vec::new(),
    };
    for epoch in 1..=config.epochs {
        let mut losses = 0.0;
        for batch in 1..=batches {
            if interrupted() {
                return Ok(None);
            }
            let left = || (config.epochs - epoch) as usize * batches + batches - batch + 1;
            let windows = sampler.batch(config.batch, left, &mut random)?;
            let loss = trainer.step(scale.frames(&windows), features, config.learning_rate)?;
            if !loss.is_finite() {
                let origins: Vec<_> = windows.iter().map(Window::origin).collect();
                let (windows, found) = (window::names(&origins), loss as f32);
                return Err(TrainError::NotFinite { epoch, batch, windows, found });
            }
            losses += loss;
        }
        let validation_loss = trainer.loss(&validation, features)?;
        let training_loss = losses / batches as f64;
        curve.epochs.push(DenseEpoch { epoch, training_loss, validation_loss });
    }
    Ok(Some(curve))
}

/// What takes the steps.
enum Trainer {
    /// burn-flex.
    Burn { network: Dense, optimizer: Optimizer },
    /// An NVIDIA GPU.
    #[cfg(feature = "cuda")]
    Cuda { network: Box<eddy_cuda::dense::Dense>, steps: u32 },
}

/// Frames and the ones that follow, `[B, 4 N]` each.
type Pairs = [Vec<f32>; 2];

/// Opens a device with the kernels of a program.
#[cfg(feature = "cuda")]
type OpenDevice<'a> =
    dyn Fn(&dyn Program) -> Result<Arc<dyn eddy_cuda::device::Device>, TrainError> + 'a;

impl Trainer {
    fn through_burn(activation: Activation, weights: Vec<[Vec<f32>; 2]>) -> Self {
        let device = DeviceKind::Flex.device().autodiff();
        Self::Burn {
            network: Dense::new(activation, weights, &device),
            optimizer: Optimizer::default(),
        }
    }

    #[cfg(feature = "cuda")]
    fn on_device(
        config: &DenseConfig,
        activation: Activation,
        weights: &[[Vec<f32>; 2]],
        open: &OpenDevice<'_>,
    ) -> Result<Self, TrainError> {
        let constants = eddy_cuda::dense::Constants { width: config.width, activation };
        let rows = config.batch.max(VALIDATION_PAIRS);
        let features = weights.last().map_or(0, |[_, bias]| bias.len());
        let device = open(&constants)?;
        let network = eddy_cuda::dense::Dense::new(device, constants, features, weights, rows)?;
        Ok(Self::Cuda { network: Box::new(network), steps: 0 })
    }

    /// A step of Adam without clipping; the loss before it.
    fn step(
        &mut self,
        [input, truth]: Pairs,
        features: usize,
        rate: f64,
    ) -> Result<f64, TrainError> {
        let config = TrainConfig::paper().optimizer;
        Ok(match self {
            Self::Burn { network, optimizer } => {
                let [input, target] = [&input, &truth].map(|frames| tensor(frames, features));
                let predicted = network.forward(Tensor::from_inner(input));
                let loss = error(&numbers(predicted.clone().inner()), &truth);
                if loss.is_finite() {
                    let mean = (predicted - Tensor::from_inner(target)).square().mean();
                    let mut step = optimizer.step(rate, &config);
                    network.update(&mut mean.backward(), &mut step);
                }
                loss
            }
            #[cfg(feature = "cuda")]
            Self::Cuda { network, steps } => {
                *steps += 1;
                let Correction { rate, root, .. } = Correction::new(*steps, rate, &config);
                let (correction, epsilon) = (1.0 / root, config.epsilon);
                network.step(&input, &truth, Move { rate, correction, epsilon })?
            }
        })
    }

    /// The mean squared error of predictions.
    #[cfg_attr(not(feature = "cuda"), expect(clippy::unnecessary_wraps, reason = "a GPU can fail"))]
    fn loss(&mut self, [input, truth]: &Pairs, features: usize) -> Result<f64, TrainError> {
        Ok(match self {
            Self::Burn { network, .. } => {
                let predicted = network.forward(Tensor::from_inner(tensor(input, features)));
                error(&numbers(predicted.inner()), truth)
            }
            #[cfg(feature = "cuda")]
            Self::Cuda { network, .. } => network.loss(input, truth)?,
        })
    }
}

/// `[B, 4 N]` on burn-flex.
fn tensor(frames: &[f32], features: usize) -> Tensor<2> {
    let shape = [frames.len() / features, features];
    Tensor::from_data(TensorData::new(frames.to_vec(), shape), &DeviceKind::Flex.device())
}

fn numbers(tensor: Tensor<2>) -> Vec<f32> {
    tensor.into_data().try_into_vec().expect("networks compute in f32")
}

/// Features of a particle: x, y, vx, vy.
const FEATURES: usize = 4;

/// Windows of two consecutive frames, without noise and mirroring.
fn pairs(config: &DenseConfig) -> WindowConfig {
    WindowConfig {
        warm_up: 1,
        batch: config.batch,
        per_epoch: config.per_epoch,
        noise: NoiseConfig::NONE,
        mirror: false,
    }
}

/// Mean squared difference, summed in the order of the numbers: the same with any number of threads.
fn error(predicted: &[f32], truth: &[f32]) -> f64 {
    let squares = predicted.iter().zip(truth).map(|(a, b)| f64::from(a - b).powi(2));
    squares.sum::<f64>() / truth.len() as f64
}

/// Normalisation of features to 0..1 by their range in the training split.
struct Scaling {
    minimum: [f32; FEATURES],
    inverse_range: [f32; FEATURES],
    mean: [f32; FEATURES],
}

impl Scaling {
    fn new(normalization: &Normalization) -> Self {
        let Normalization { minimum, maximum, mean, .. } = *normalization;
        let each = [0, 1, 2, 3];
        let inverse_range = each.map(|feature| 1.0 / (maximum[feature] - minimum[feature]));
        let mean = each.map(|feature| (mean[feature] - minimum[feature]) * inverse_range[feature]);
        Self { minimum, inverse_range, mean }
    }

    /// First and second frames of windows, each `[B, 4 N]`.
    fn frames(&self, windows: &[Window]) -> Pairs {
        [0, 1].map(|frame| {
            let states = windows.iter().map(|window| &window.states[frame]);
            states.flat_map(|state| self.scaled(state)).collect()
        })
    }

    fn scaled<'a>(&'a self, state: &'a State) -> impl Iterator<Item = f32> + 'a {
        state.position.iter().zip(&state.velocity).flat_map(|(x, v)| {
            let features = [x[0], x[1], v[0], v[1]];
            [0, 1, 2, 3].map(|f| (features[f] - self.minimum[f]) * self.inverse_range[f])
        })
    }

    /// Frames with mean features for all particles, so many numbers.
    fn mean(&self, numbers: usize) -> Vec<f32> {
        self.mean.iter().copied().cycle().take(numbers).collect()
    }
}

/// Weights `[in, out]` and bias of each layer, uniform in +-1 / sqrt(in), as in PyTorch's layers.
fn initial_weights(
    config: &DenseConfig,
    features: usize,
    random: &mut ChaCha8Rng,
) -> Vec<[Vec<f32>; 2]> {
    let hidden = std::iter::repeat_n(config.width, config.layers);
    let widths: Vec<usize> = [features].into_iter().chain(hidden).chain([features]).collect();
    let layers = widths.windows(2).map(|ends| {
        let [input, output] = [ends[0], ends[1]];
        let bound = 1.0 / (input as f32).sqrt();
        let mut drawn = |count: usize| -> Vec<f32> {
            (0..count).map(|_| bound * (2.0 * random.random::<f32>() - 1.0)).collect()
        };
        [drawn(input * output), drawn(output)]
    });
    layers.collect()
}

/// The network.
struct Dense {
    layers: Vec<Linear>,
    activation: Activation,
}

impl Dense {
    fn new(activation: Activation, weights: Vec<[Vec<f32>; 2]>, device: &Device) -> Self {
        let layers = weights.into_iter().map(|[weight, bias]| {
            let (input, output) = (weight.len() / bias.len(), bias.len());
            let weight = TensorData::new(weight, [input, output]);
            let bias = TensorData::new(bias, [output]);
            Linear {
                weight: Tensor::from_data(weight, device).require_grad(),
                bias: Tensor::from_data(bias, device).require_grad(),
            }
        });
        Self { layers: layers.collect(), activation }
    }

    /// `[B, 4 N]` to `[B, 4 N]`.
    fn forward(&self, mut signal: Tensor<2>) -> Tensor<2> {
        let last = self.layers.len() - 1;
        for (number, layer) in self.layers.iter().enumerate() {
            signal = layer.forward(signal);
            if number < last {
                signal = activate(self.activation, signal);
            }
        }
        signal
    }

    fn update(&mut self, gradients: &mut Gradients, step: &mut OptimizerStep<'_>) {
        for (index, layer) in self.layers.iter_mut().enumerate() {
            layer.update(index, gradients, &mut |tensor, values, by| {
                step.change(tensor, values, by);
            });
        }
    }
}

#[cfg(test)]
#[cfg(feature = "cuda")]
mod tests {
    use super::*;
    use crate::train::cuda_tests;
    use eddy_cuda_emulator::Emulator;
    use eddy_inference::checkpoint::Normalization;

    #[test]
    fn every_activation_has_the_same_curve_on_a_gpu() {
        let normalization = Normalization {
            minimum: [0.0, 0.0, -1.0, -1.0],
            maximum: [1.0, 1.0, 1.0, 1.0],
            mean: [0.5, 0.5, 0.0, 0.0],
            standard_deviation: [1.0; 4],
        };
        let dataset = Dataset {
            train: cuda_tests::streams(),
            validation: cuda_tests::streams(),
            test: Vec::new(),
            normalization,
            spacing: 0.1,
            digest: "streams of a test".to_owned(),
            skipped: Vec::new(),
        };
        let mut config = DenseConfig::paper(2, 12);
        (config.width, config.batch) = (13, 4);
        for activation in Activation::ALL {
            let burn = |weights| Ok(Trainer::through_burn(activation, weights));
            let cuda = |weights: Vec<[Vec<f32>; 2]>| {
                Trainer::on_device(&config, activation, &weights, &|program| {
                    Ok(Arc::new(Emulator::new(program)?))
                })
            };
            let expected = train_with(&config, 3, &dataset, &burn, &|| false).unwrap().unwrap();
            let found = train_with(&config, 3, &dataset, &cuda, &|| false).unwrap().unwrap();
            assert_eq!((found.mean, found.persistence), (expected.mean, expected.persistence));
            let first = expected.epochs[0].validation_loss;
            assert!(expected.epochs[1].validation_loss < first, "it learns");
            for (found, expected) in found.epochs.iter().zip(&expected.epochs) {
                let apart = |a: f64, b: f64| (a / b - 1.0).abs();
                let training = apart(found.training_loss, expected.training_loss);
                let validation = apart(found.validation_loss, expected.validation_loss);
                assert!(training.max(validation) < 2e-5, "{found:?}, expected {expected:?}");
            }
        }
    }
}
