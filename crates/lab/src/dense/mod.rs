//! The network of the paper's comparison of activations (supplement B, Fig. 5): dense layers that predict the next frame from
//! one frame. Each feature of each particle is a separate input and output: no pooling, no recurrence, no ballistic step.
//!
//! 1. [`pairs`]: draws pairs of consecutive frames, and scales them.
//! 2. [`trainer`]: takes steps, on an NVIDIA GPU ([`eddy_cuda::dense`]) or with [`network`] on the processor.

mod network;
mod pairs;
mod trainer;

#[cfg(feature = "cuda")]
use std::sync::Arc;

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

#[cfg(feature = "cuda")]
use eddy_cuda::kernels::Program;
use eddy_dataset::Dataset;
use eddy_inference::checkpoint::Activation;
use eddy_learning::{
    model::{DeviceKind, GpuOptions},
    train::TrainError,
};
use pairs::{FEATURES, Sampler, Scaling};
use trainer::Trainer;

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
        for (field, found) in [
            ("dense.layers", self.layers),
            ("dense.width", self.width),
            ("dense.epochs", self.epochs as usize),
            ("dense.per_epoch", self.per_epoch),
            ("dense.batch", self.batch),
        ] {
            if found == 0 {
                let (found, expected) = (found.to_string(), "at least 1");
                return Err(TrainError::Setting { field, found, expected });
            }
        }
        let rate = self.learning_rate;
        if !rate.is_finite() || rate <= 0.0 {
            let (field, expected) = ("dense.learning_rate", "a positive number");
            return Err(TrainError::Setting { field, found: rate.to_string(), expected });
        }
        Ok(())
    }
}

/// Trains the network with one activation, on an NVIDIA GPU if that is the device, otherwise on the processor. The same arguments
/// give the same curve. Returns none if `interrupted`, which is called before every batch, returns true.
///
/// # Errors
/// [`TrainError`]: settings out of range, streams that differ in the number of particles or are too short, a loss that is not
/// finite.
pub fn train(
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
        _ => Ok(Trainer::on_processor(activation, weights)),
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
    check(dataset, particles)?;
    let scale = Scaling::new(&dataset.normalization);
    let sampler = Sampler::new(&dataset.train, &scale)?;
    let mut fixed = ChaCha8Rng::seed_from_u64(VALIDATION_SEED);
    let validation =
        Sampler::new(&dataset.validation, &scale)?.draw(VALIDATION_PAIRS, &mut fixed)?;
    let validation = validation.frames;

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
            let pairs = sampler.draw(config.batch, &mut random)?;
            let loss = trainer.step(&pairs.frames, config.learning_rate)?;
            if !loss.is_finite() {
                let (windows, found) = (pairs.names(), loss as f32);
                return Err(TrainError::NotFinite { epoch, batch, windows, found });
            }
            losses += loss;
        }
        let validation_loss = trainer.loss(&validation)?;
        let training_loss = losses / batches as f64;
        curve.epochs.push(DenseEpoch { epoch, training_loss, validation_loss });
    }
    Ok(Some(curve))
}

/// Rejects streams with other numbers of particles, and constant features, which cannot be scaled.
fn check(dataset: &Dataset, particles: usize) -> Result<(), TrainError> {
    let mut streams = dataset.train.iter().chain(&dataset.validation);
    if let Some(other) = streams.find(|stream| stream.material.len() != particles) {
        return Err(TrainError::Particles {
            source_file: other.source.clone(),
            stream: other.id,
            found: other.material.len(),
            expected: particles,
        });
    }
    let scale = &dataset.normalization;
    let is_constant = |&feature: &usize| scale.minimum[feature] >= scale.maximum[feature];
    match (0..FEATURES).find(is_constant) {
        None => Ok(()),
        Some(feature) => {
            let found = scale.minimum[feature];
            Err(TrainError::Constant { feature: ["x", "y", "vx", "vy"][feature], found })
        }
    }
}

/// Mean squared difference, summed in the order of the numbers: the same with any number of threads.
fn error(predicted: &[f32], truth: &[f32]) -> f64 {
    let squares = predicted.iter().zip(truth).map(|(a, b)| f64::from(a - b).powi(2));
    squares.sum::<f64>() / truth.len() as f64
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

#[cfg(test)]
#[cfg(feature = "cuda")]
mod tests {
    use super::*;
    use eddy_cuda_emulator::Emulator;
    use eddy_dataset::{Stream, Trajectory};
    use eddy_frames::{Domain, Material, Stamp, State};
    use eddy_inference::checkpoint::Normalization;

    /// Two streams of particles that move at random.
    fn streams() -> Vec<Trajectory> {
        const PARTICLES: usize = 9;
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let mut pairs = |low: f32, high: f32| -> Vec<[f32; 2]> {
            (0..PARTICLES).map(|_| [(); 2].map(|()| random.random_range(low..high))).collect()
        };
        let mut stream = |id: u64| {
            let states = (0..9)
                .map(|_| State { position: pairs(0.1, 0.9), velocity: pairs(-1.0, 1.0) })
                .collect();
            Trajectory::from(Stream {
                id,
                source: "memory".into(),
                dt: 0.016,
                domain: Domain::UNIT,
                material: vec![Material::Liquid; PARTICLES],
                first_sequence: 0,
                first_stamp: Stamp::default(),
                stiffness: None,
                tools: None,
                states,
            })
        };
        vec![stream(0), stream(1)]
    }

    #[test]
    fn every_activation_has_the_same_curve_on_a_gpu() {
        let normalization = Normalization {
            minimum: [0.0, 0.0, -1.0, -1.0],
            maximum: [1.0, 1.0, 1.0, 1.0],
            mean: [0.5, 0.5, 0.0, 0.0],
            standard_deviation: [1.0; 4],
        };
        let dataset = Dataset {
            train: streams(),
            validation: streams(),
            test: Vec::new(),
            normalization,
            spacing: 0.1,
            digest: "streams of a test".to_owned(),
            skipped: Vec::new(),
        };
        let mut config = DenseConfig::paper(2, 12);
        (config.width, config.batch) = (13, 4);
        for activation in Activation::ALL {
            let processor = |weights| Ok(Trainer::on_processor(activation, weights));
            let cuda = |weights: Vec<[Vec<f32>; 2]>| {
                Trainer::on_device(&config, activation, &weights, &|program| {
                    Ok(Arc::new(Emulator::new(program)?))
                })
            };
            let expected =
                train_with(&config, 3, &dataset, &processor, &|| false).unwrap().unwrap();
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
