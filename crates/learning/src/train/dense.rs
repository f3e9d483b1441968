//! The network of the paper's comparison of activations (supplement B, Fig. 5): dense layers that predict the next frame from
//! one frame. Each feature of each particle is a separate input and output: no pooling, no recurrence, no ballistic step.

use burn::tensor::{Device, Gradients, Tensor, TensorData};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::{
    NoiseConfig, OptimizerConfig, TrainConfig, TrainError, WindowConfig,
    adam::{Adam, AdamStep},
    config::{at_least_one, positive},
    description::{no_constant_feature, same_particles},
    window::{self, Sampler, Window},
};
use crate::model::{DeviceKind, linear::Linear, mlp::activate};
use eddy_evaluation::dataset::{Dataset, State};
use eddy_inference::checkpoint::{Activation, Architecture, Normalization};

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

/// Trains the network with one activation, on burn-flex. The same arguments give the same curve. Returns none if
/// `interrupted`, which is called before every batch, returns true.
///
/// # Errors
/// [`TrainError`]: settings out of range, streams that differ in the number of particles or are too short, a loss that is not
/// finite.
pub fn train_dense(
    config: &DenseConfig,
    activation: Activation,
    seed: u64,
    dataset: &Dataset,
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

    let plain = DeviceKind::Flex.device();
    let scale = Scaling::new(&dataset.normalization);
    let validation = scale.frames(&validation, &plain);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let features = FEATURES * particles;
    let mut network =
        Dense::new(config, activation, features, &mut random, &plain.clone().autodiff());
    let mut adam = Adam::default();
    let optimizer = OptimizerConfig {
        clip: f32::INFINITY,
        ..TrainConfig::defaults(Architecture::Frame).optimizer
    };
    let batches = config.per_epoch.div_ceil(config.batch);
    let mut curve = DenseCurve {
        persistence: f64::from(
            error(validation[0].clone(), validation[1].clone()).into_scalar::<f32>(),
        ),
        mean: f64::from(
            error(scale.mean(&validation[1]), validation[1].clone()).into_scalar::<f32>(),
        ),
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
            let [input, target] = scale.frames(&windows, &plain); // [B, 4 N]
            let loss =
                error(network.forward(Tensor::from_inner(input)), Tensor::from_inner(target));
            let found: f32 = loss.clone().inner().into_scalar();
            if !found.is_finite() {
                let origins: Vec<_> = windows.iter().map(Window::origin).collect();
                let windows = window::names(&origins);
                return Err(TrainError::NotFinite { epoch, batch, windows, found });
            }
            let mut step = adam.step(config.learning_rate, &optimizer);
            network.update(&mut loss.backward(), &mut step);
            losses += f64::from(found);
        }
        let predicted = network.forward(Tensor::from_inner(validation[0].clone())).inner();
        let validation_loss =
            f64::from(error(predicted, validation[1].clone()).into_scalar::<f32>());
        let training_loss = losses / batches as f64;
        curve.epochs.push(DenseEpoch { epoch, training_loss, validation_loss });
    }
    Ok(Some(curve))
}

/// Features of a particle: x, y, vx, vy.
const FEATURES: usize = 4;

/// Windows of two consecutive frames, without noise and mirroring.
fn pairs(config: &DenseConfig) -> WindowConfig {
    WindowConfig {
        warm_up: 1,
        batch: config.batch,
        per_epoch: config.per_epoch,
        noise: NoiseConfig { position: 0.0, velocity: 0.0, share: 0.0 },
        mirror: false,
    }
}

/// Mean squared difference.
fn error(predicted: Tensor<2>, truth: Tensor<2>) -> Tensor<1> {
    (predicted - truth).square().mean()
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
    fn frames(&self, windows: &[Window], device: &Device) -> [Tensor<2>; 2] {
        [0, 1].map(|frame| {
            let states = windows.iter().map(|window| &window.states[frame]);
            let values: Vec<f32> = states.flat_map(|state| self.scaled(state)).collect();
            let width = values.len() / windows.len().max(1);
            Tensor::from_data(TensorData::new(values, [windows.len(), width]), device)
        })
    }

    fn scaled<'a>(&'a self, state: &'a State) -> impl Iterator<Item = f32> + 'a {
        state.position.iter().zip(&state.velocity).flat_map(|(x, v)| {
            let features = [x[0], x[1], v[0], v[1]];
            [0, 1, 2, 3].map(|f| (features[f] - self.minimum[f]) * self.inverse_range[f])
        })
    }

    /// Frames with mean features for all particles, of the shape of `like`.
    fn mean(&self, like: &Tensor<2>) -> Tensor<2> {
        let [rows, width] = like.dims();
        let values: Vec<f32> = self.mean.iter().copied().cycle().take(rows * width).collect();
        Tensor::from_data(TensorData::new(values, [rows, width]), &like.device())
    }
}

/// The network.
struct Dense {
    layers: Vec<Linear>,
    activation: Activation,
}

impl Dense {
    /// Weights and biases uniform in +-1 / sqrt(in), as in PyTorch's layers.
    fn new(
        config: &DenseConfig,
        activation: Activation,
        features: usize,
        random: &mut ChaCha8Rng,
        device: &Device,
    ) -> Self {
        let hidden = std::iter::repeat_n(config.width, config.layers);
        let widths: Vec<usize> = [features].into_iter().chain(hidden).chain([features]).collect();
        let layers = widths.windows(2).map(|ends| {
            let [input, output] = [ends[0], ends[1]];
            let bound = 1.0 / (input as f32).sqrt();
            let mut drawn = |count: usize| -> Vec<f32> {
                (0..count).map(|_| bound * (2.0 * random.random::<f32>() - 1.0)).collect()
            };
            let weight = TensorData::new(drawn(input * output), [input, output]);
            let bias = TensorData::new(drawn(output), [output]);
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

    fn update(&mut self, gradients: &mut Gradients, step: &mut AdamStep<'_>) {
        for (index, layer) in self.layers.iter_mut().enumerate() {
            layer.update(index, gradients, &mut |tensor, values, by| {
                step.change(tensor, values, by);
            });
        }
    }
}
