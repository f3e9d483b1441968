//! Fits a network to recorded trajectories.
//!
//! `training_loop` is the loop on one screen. What it calls, in this order:
//!
//! 1. `schedule`: learning rate and length of unroll of every batch.
//! 2. `stage`: begins a stage of the unroll.
//! 3. `steps`: the step of a batch, through burn or on a GPU (`cuda`).
//!    - `window`: draws pieces of trajectories. `batch`: windows as tensors. `loss_weights`: the weight of each particle's error.
//!    - `loss`, `density`: the network observes the warm-up and predicts the rest from its own output; the loss of that.
//!    - `gradients`: the loss of a batch and its gradients, windows in parallel.
//!    - `optimizer`: Adam and the average of the weights, with `muon`: Muon; `knots`: weights for several stiffnesses.
//! 4. `validate`: free rollouts over streams that are not trained on. `movement`: whether the weights move.
//! 5. `saver`: when a run is saved. `resume`, `record`, `moments`: how it is saved and resumed. `state`: what there is to save.
//! 6. `monitor`, `events`: progress, `metrics.csv`, TensorBoard's event file.
//!
//! Before the loop: `config` has all settings, `recipes` their defaults, `description` the network they describe. `data_warnings`
//! finds data that does not fit them, `footprint` estimates the memory and disk space that a run needs.
//!
//! [`train`] runs them. [`step_benchmark`] takes its steps on synthetic data, to be timed.

mod batch;
mod config;
#[cfg(feature = "cuda")]
mod cuda;
#[cfg(test)]
#[cfg(feature = "cuda")]
mod cuda_particle_tests;
#[cfg(test)]
#[cfg(feature = "cuda")]
mod cuda_run_tests;
#[cfg(test)]
#[cfg(feature = "cuda")]
mod cuda_tests;
mod data_warnings;
mod density;
mod description;
mod error;
mod events;
mod footprint;
#[cfg(test)]
mod golden;
mod gradients;
mod knots;
mod loss;
mod loss_weights;
mod moments;
mod monitor;
mod movement;
mod muon;
mod optimizer;
mod recipes;
mod record;
mod resume;
mod saver;
mod schedule;
mod stage;
mod state;
pub mod step_benchmark;
mod steps;
mod training_loop;
mod validate;
mod window;

pub use config::{
    LossConfig, LossKind, NetworkConfig, NoiseConfig, Observed, OptimizerConfig, OptimizerKind,
    Schedule, TrainConfig, UnrollStage, ValidationConfig, WindowConfig,
};
pub use data_warnings::data_warnings;
pub use error::TrainError;
pub use monitor::{Epoch, METRICS_FILE};
pub use recipes::Recipe;
pub use resume::{LAST_FOLDER, check_output};
pub use validate::{linear_fit_loss, rollout_loss, test_skill};

use std::{path::Path, time::Duration};

use crate::model::{DeviceKind, GpuOptions};
use eddy_dataset::Dataset;
use eddy_frames::{clock::Clock, progress::Progress};
use eddy_inference::{
    checkpoint::{Checkpoint, Description},
    engine::fits,
};
use gradients::GradientTask;
use loss_weights::LossScale;
use steps::Learner;
use window::Sampler;

/// A training run, apart from its settings and data.
pub struct Run<'a> {
    /// Compute device.
    pub device: DeviceKind,
    /// Options of an NVIDIA GPU, if that is the device.
    pub gpu: GpuOptions,
    /// Directory for the best checkpoint, `metrics.csv`, the event files and [`LAST_FOLDER`].
    pub output: &'a Path,
    /// The checkpoint whose weights the run starts from, instead of random ones.
    pub start: Option<&'a Checkpoint>,
    /// Whether to resume the run in `output`; if it has no epoch yet, a new run begins.
    pub resume: bool,
    /// Available resources.
    pub machine: Machine,
    /// The command line, for the checkpoint's summary.
    pub command: String,
    /// Receives batches, and a line per epoch. It is asked before every batch, on a GPU before every few, whether to stop; the
    /// best and the last epoch are then kept.
    pub progress: &'a dyn Progress,
    /// Called after every epoch. It is saved then, but on a GPU at most every ten seconds.
    pub on_epoch: &'a (dyn Fn(&Epoch) + Sync),
}

impl Run<'_> {
    /// The device as it is recorded: of NVIDIA GPUs with the precision and their number, since results depend on both.
    fn device_name(&self) -> String {
        let name = self.device.name();
        if !self.device.is_cuda() {
            name.to_owned()
        } else {
            let precision = self.gpu.precision.name();
            match self.gpu.count.get() {
                1 => format!("{name} {precision}"),
                count => format!("{name} {precision} x{count}"),
            }
        }
    }

    /// Whether there is an epoch to resume from.
    fn resumes(&self) -> bool {
        self.resume && self.output.join(LAST_FOLDER).exists()
    }
}

/// The resources available to a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Machine {
    /// Memory, apart from that of the data (bytes).
    pub memory: u64,
    /// Disk space for the output (bytes).
    pub disk: u64,
}

impl Machine {
    /// Unlimited resources.
    pub const UNLIMITED: Self = Self { memory: u64::MAX, disk: u64::MAX };

    /// This amount of memory (bytes), and the free disk space at the output directory, which need not exist yet.
    ///
    /// # Errors
    /// [`TrainError::File`] if the system does not report the free disk space.
    pub fn with_free_disk(memory: u64, output: &Path) -> Result<Self, TrainError> {
        let existing = output.ancestors().find(|folder| folder.exists()).unwrap_or(".".as_ref());
        let existing = if existing.as_os_str().is_empty() { ".".as_ref() } else { existing };
        let disk = fs4::available_space(existing)
            .map_err(|reason| TrainError::File { file: existing.to_owned(), reason })?;
        Ok(Self { memory, disk })
    }
}

/// The result of a run.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// All epochs, including those before the run was resumed.
    pub epochs: Vec<Epoch>,
    /// The best checkpoint, as saved; none if no epoch was completed.
    pub best: Option<Checkpoint>,
    /// Whether the run was interrupted.
    pub interrupted: bool,
    /// Training time, including that before the run was resumed (s).
    pub seconds: f64,
    /// Number of training windows.
    pub samples: u64,
}

/// Trains a network. The checkpoint with the best validation loss is kept in `run.output`; the last epoch, with everything
/// needed to resume, in its folder [`LAST_FOLDER`].
///
/// The same settings, data and device give the same weights, in one run or resumed.
///
/// # Errors
/// [`TrainError`]: a setting out of range, a checkpoint to start from that has another network, streams that are too short or inconsistent, insufficient resources, an output that
/// contains a run or does not match the run to resume, a loss that is not finite, or a file that cannot be written (the best
/// and the last checkpoint so far are kept).
pub fn train(config: &TrainConfig, dataset: &Dataset, run: &Run) -> Result<Outcome, TrainError> {
    let clock = Clock::start();
    let learner = |description: &Description| Learner::new(run, config, description, dataset);
    train_with(config, dataset, run, &Dependencies { learner: &learner, clock: &|| clock.now() })
}

/// Opens what takes the steps of a network.
type Open<'a> = dyn Fn(&Description) -> Result<Learner, TrainError> + 'a;

/// What a run gets from outside: in tests, another device and another time.
struct Dependencies<'a> {
    /// What takes the steps.
    learner: &'a Open<'a>,
    /// The time since any instant.
    clock: &'a dyn Fn() -> Duration,
}

fn train_with(
    config: &TrainConfig,
    dataset: &Dataset,
    run: &Run,
    dependencies: &Dependencies<'_>,
) -> Result<Outcome, TrainError> {
    config.check()?;
    let mut description = description::describe(config, dataset, &run.command)?;
    if let Some(start) = run.start {
        description::start_from(&mut description, config, start)?;
    }
    check_streams(config, dataset, &description)?;
    let particles = dataset.train.iter().map(|stream| stream.material.len()).min().unwrap_or(0);
    footprint::check(config, &description, particles, run)?;
    let state = resume::begin(config, &mut description, run)?;
    let setup = Setup { config, dataset, run, description: &description };
    training_loop::train_from(&setup, state, dependencies)
}

/// What does not change during a run.
#[derive(Clone, Copy)]
struct Setup<'a> {
    config: &'a TrainConfig,
    dataset: &'a Dataset,
    run: &'a Run<'a>,
    description: &'a Description,
}

impl<'a> Setup<'a> {
    /// The gradients of batches with errors on this scale.
    fn task(&self, scale: &'a LossScale<'a>) -> GradientTask<'a> {
        let Self { config, description, run, .. } = *self;
        GradientTask { config, description, scale, device: run.device }
    }
}

/// Rejects streams that are too short for any stage of the run, or that its network could not predict, before it starts.
fn check_streams(
    config: &TrainConfig,
    dataset: &Dataset,
    description: &Description,
) -> Result<(), TrainError> {
    for stream in dataset.train.iter().chain(&dataset.validation).chain(&dataset.test) {
        let first = stream.cut(0..1)?.frame(0);
        fits(description, &first).map_err(|reason| TrainError::Stream {
            source_file: stream.source.clone(),
            stream: stream.id,
            reason: Box::new(reason),
        })?;
    }
    for stage in &config.unroll {
        sampler(config, dataset, stage.frames)?;
    }
    validate::check(&config.validation, config.windows.warm_up, &dataset.validation)
}

fn sampler<'a>(
    config: &'a TrainConfig,
    dataset: &'a Dataset,
    unroll: usize,
) -> Result<Sampler<'a>, TrainError> {
    let sampler = Sampler::new(&dataset.train, &config.windows, unroll)?;
    let knots = &config.network.stiffness_knots;
    Ok(if knots.is_empty() { sampler } else { sampler.by_stiffness() })
}
