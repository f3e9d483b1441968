//! Fits a network to recorded trajectories.
//!
//! 1. `config`: everything that can be chosen, with defaults for each architecture.
//! 2. `window`: draws pieces of trajectories, some particles of each.
//! 3. `weigh`: how much each particle's error counts.
//! 4. `batch`: windows as tensors.
//! 5. `loss`, `density`: the network observes the warm-up, predicts the rest from its own output; what
//!    that costs.
//! 6. `adam`: how weights follow from gradients.
//! 7. `schedule`: learning rate and length of unroll over the run.
//! 8. `validate`: free rollouts over streams that are not trained on.
//! 9. `monitor`: progress bar, lines, `metrics.csv`.
//!
//! [`train`] is the loop; [`exercise`] takes its steps on made-up numbers, to be timed.

mod adam;
mod batch;
mod config;
mod density;
mod error;
pub mod exercise;
#[cfg(test)]
mod golden;
mod loss;
mod monitor;
mod schedule;
mod validate;
mod weigh;
mod window;

pub use config::{
    LossConfig, LossKind, NetworkConfig, OptimizerConfig, Stage, TrainConfig, ValidationConfig,
    WindowConfig,
};
pub use error::TrainError;
pub use monitor::{Epoch, METRICS_FILE};

use std::{collections::BTreeSet, path::Path};

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use crate::{
    checkpoint::{Architecture, Checkpoint, Description, FORMAT_VERSION, TrainingSummary},
    dataset::Dataset,
    frame::Material,
    model::{
        Ballistic, DeviceKind, layers,
        network::{Dropout, Network},
    },
};
use adam::Adam;
use batch::Batch;
use monitor::Monitor;
use weigh::Scale;
use window::{Sampler, Window};

/// Windows over which trivial errors are averaged before training starts.
const COMMON_WINDOWS: usize = 512;

/// A run beside its settings and data.
pub struct Run<'a> {
    /// What computes.
    pub device: DeviceKind,
    /// Where the checkpoint and `metrics.csv` go.
    pub output: &'a Path,
    /// The command line, for the checkpoint's summary.
    pub command: String,
    /// No progress bar, no lines.
    pub quiet: bool,
    /// Whether to stop after the batch at hand; the best checkpoint so far is kept.
    pub interrupted: &'a dyn Fn() -> bool,
}

/// What a run came to.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// Every epoch done.
    pub epochs: Vec<Epoch>,
    /// The best checkpoint, as saved; none if not one epoch was finished.
    pub best: Option<Checkpoint>,
    /// Whether the run was interrupted.
    pub interrupted: bool,
}

/// Trains a network and keeps the checkpoint with the best validation loss in `run.output`.
///
/// The same settings, data and device give the same weights.
///
/// # Errors
/// [`TrainError`]: a setting out of range, streams too short or unlike each other, a loss that is
/// not finite (the best checkpoint so far stays), a file that cannot be written.
pub fn train(config: &TrainConfig, dataset: &Dataset, run: &Run) -> Result<Outcome, TrainError> {
    config.check()?;
    let mut seeds = ChaCha8Rng::seed_from_u64(config.seed);
    let mut order = ChaCha8Rng::seed_from_u64(seeds.next_u64());
    let mut dropout =
        Dropout::new(config.network.dropout, ChaCha8Rng::seed_from_u64(seeds.next_u64()));

    let description = describe(config, dataset, &run.command)?;
    let plain = run.device.device();
    let initial = layers::initial(&description, seeds.next_u64());
    let mut network = Network::new(&description, &initial, &plain.clone().autodiff());
    let mut adam = Adam::default();
    let mut scale = Scale {
        loss: &config.loss,
        normalization: &dataset.normalization,
        ballistic: Ballistic::of(&description),
        common: Vec::new(),
    };

    for stage in &config.unroll {
        // Streams too short for a later stage are better refused now than in an hour.
        sampler_for(config, dataset, stage.frames)?;
    }
    let per_epoch = config.batches();
    let batches = (per_epoch * config.epochs as usize) as u64;
    let mut monitor = Monitor::new(run.output, batches, run.quiet)?;
    let mut outcome = Outcome { epochs: Vec::new(), best: None, interrupted: false };
    let (mut unroll, mut samples, mut since_best) = (0, 0, 0);
    let mut sampler = None;
    'run: for epoch in 1..=config.epochs {
        let mut losses = 0.0;
        let mut progress = 0.0;
        for number in 1..=per_epoch {
            if (run.interrupted)() {
                outcome.interrupted = true;
                break 'run;
            }
            progress = ((epoch as usize - 1) * per_epoch + number - 1) as f64 / batches as f64;
            let stage = config.unroll[schedule::stage(&config.unroll, progress)];
            if stage.frames != unroll {
                unroll = stage.frames;
                let new = sampler_for(config, dataset, unroll)?;
                scale.common = scale.trivial(&new.draw(COMMON_WINDOWS, &mut order), unroll);
                sampler = Some(new);
            }
            let sampler = sampler.as_ref().expect("made when the first stage began");

            let windows = sampler.draw(config.windows.batch, &mut order);
            let batch = Batch::new(&windows, config.windows.warm_up, &scale, &plain);
            let (predicted, steps) = loss::unroll(&network, &batch, &mut dropout);
            let loss = loss::loss(&config.loss, &batch, &predicted, &steps, description.domain);
            let value: f32 = loss.clone().inner().into_scalar();
            if !value.is_finite() {
                let windows = names(&windows);
                return Err(TrainError::NotFinite { epoch, batch: number, windows, found: value });
            }
            let mut gradients = loss.backward();
            let rate = schedule::learning_rate(&config.optimizer, progress);
            let mut step = adam.step(rate, &config.optimizer);
            network.layers_mut().update(&mut gradients, |tensor, values, gradient| {
                step.change(tensor, values, gradient);
            });

            losses += f64::from(value);
            samples += windows.len() as u64;
            monitor.batch(epoch, value);
        }
        let tensors = network.layers().tensors(&description);
        let mut checkpoint = Checkpoint { description: description.clone(), tensors };
        let score = validate::validate(&config.validation, &checkpoint, &dataset.validation)?;
        let training_loss = losses / per_epoch as f64;
        let best = outcome
            .best
            .as_ref()
            .is_none_or(|best| score.loss < best.description.training.validation_loss);
        let done = Epoch {
            epoch,
            samples,
            unroll,
            training_loss,
            validation_loss: score.loss,
            first_skill: score.first_skill,
            last_skill: score.last_skill,
            learning_rate: schedule::learning_rate(&config.optimizer, progress),
            best,
        };
        outcome.epochs.push(done);
        since_best = if best { 0 } else { since_best + 1 };
        if best {
            let summary = &mut checkpoint.description.training;
            summary.epochs = epoch;
            summary.best_epoch = epoch;
            summary.training_loss = training_loss;
            summary.validation_loss = score.loss;
            summary.samples = samples;
            checkpoint.save(run.output)?;
            outcome.best = Some(checkpoint);
        }
        monitor.epoch(&done, config.validation.horizon)?;
        let last_stage = schedule::stage(&config.unroll, progress) + 1 == config.unroll.len();
        if last_stage && since_best >= config.patience {
            break;
        }
    }
    monitor.finish();
    if let Some(best) = &mut outcome.best {
        best.description.training.epochs = outcome.epochs.len() as u32;
        best.save(run.output)?;
    }
    Ok(outcome)
}

/// What the network will be.
fn describe(
    config: &TrainConfig,
    dataset: &Dataset,
    command: &str,
) -> Result<Description, TrainError> {
    let Some(first) = dataset.train.first() else {
        let (warm_up, unroll) = (config.windows.warm_up, 1);
        return Err(TrainError::TooShort { found: 0, expected: warm_up + 1, warm_up, unroll });
    };
    let particles = first.material.len();
    if config.architecture == Architecture::Frame {
        let streams = dataset.train.iter().chain(&dataset.validation);
        if let Some(other) = streams.clone().find(|stream| stream.material.len() != particles) {
            return Err(TrainError::Particles {
                source_file: other.source.clone(),
                stream: other.id,
                found: other.material.len(),
                expected: particles,
            });
        }
    }
    // Of every part: in a small set, a material may be in the validation part only.
    let parts = [&dataset.train, &dataset.validation, &dataset.test];
    let streams = parts.into_iter().flatten();
    let materials: BTreeSet<Material> =
        streams.flat_map(|stream| stream.material.iter().copied()).collect();
    Ok(Description {
        format_version: FORMAT_VERSION,
        architecture: config.architecture,
        core: config.core,
        form: config.network.form,
        normalize_gates: config.network.normalize_gates,
        dt: first.dt,
        warm_up: config.windows.warm_up as u32,
        gravity: config.gravity,
        materials: materials.into_iter().collect(),
        data: dataset.digest.clone(),
        sizes: config.sizes(particles),
        frame: config.network.frame,
        domain: first.domain,
        normalization: dataset.normalization.clone(),
        training: TrainingSummary {
            command: command.to_owned(),
            seed: config.seed,
            epochs: 0,
            best_epoch: 0,
            training_loss: 0.0,
            validation_loss: f64::MAX,
            samples: 0,
        },
    })
}

fn sampler_for<'a>(
    config: &TrainConfig,
    dataset: &'a Dataset,
    unroll: usize,
) -> Result<Sampler<'a>, TrainError> {
    let particles = match config.architecture {
        Architecture::Frame => 0,
        Architecture::Particle => config.windows.particles,
    };
    let WindowConfig { warm_up, mirror, .. } = config.windows;
    Sampler::new(&dataset.train, warm_up, unroll, particles, mirror)
}

/// Stream and first frame of each window, to find a batch again.
fn names(windows: &[Window]) -> String {
    let names: Vec<_> =
        windows.iter().map(|window| format!("{}:{}", window.stream, window.start)).collect();
    names.join(" ")
}
