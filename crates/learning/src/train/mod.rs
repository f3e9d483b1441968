//! Fits a network to recorded trajectories.
//!
//! 1. `config`: everything that can be chosen, with defaults for each architecture.
//! 2. `window`: draws pieces of trajectories, some particles of each.
//! 3. `weigh`: how much each particle's error counts.
//! 4. `batch`: windows as tensors.
//! 5. `loss`, `density`: the network observes the warm-up, predicts the rest from its own output; what
//!    that costs.
//! 6. `gradients`: the loss of a batch and its gradients, windows side by side.
//! 7. `adam`: how weights follow from gradients.
//! 8. `schedule`: learning rate and length of unroll over the run.
//! 9. `validate`: free rollouts over streams that are not trained on.
//! 10. `monitor`, `events`: progress bar, lines, `metrics.csv`, TensorBoard's event file.
//! 11. `state`, `resume`, `record`, `moments`: what a run carries from batch to batch, and how it goes
//!     on after a stop.
//! 12. `footprint`: memory and disk that a run needs, known before it starts.
//!
//! [`train`] is the loop; [`step_benchmark`] takes its steps on made-up numbers, to be timed; [`dense`] is the
//! small network that the paper compares activations with.

mod adam;
mod batch;
mod config;
pub mod dense;
mod density;
mod error;
mod events;
mod footprint;
#[cfg(test)]
mod golden;
mod gradients;
mod loss;
mod moments;
mod monitor;
mod record;
mod resume;
mod schedule;
mod state;
pub mod step_benchmark;
mod validate;
mod weigh;
mod window;

pub use config::{
    LossConfig, LossKind, NetworkConfig, NoiseConfig, OptimizerConfig, Schedule, TrainConfig,
    UnrollStage, ValidationConfig, WindowConfig,
};
pub use error::TrainError;
pub use monitor::{Epoch, METRICS_FILE};
pub use resume::{LAST_FOLDER, check_output};

use std::{collections::BTreeSet, path::Path};

use crate::model::DeviceKind;
use config::setting;
use eddy_evaluation::dataset::Dataset;
use eddy_frames::Material;
use eddy_inference::{
    checkpoint::{Architecture, Checkpoint, Description, FORMAT_VERSION, Rules, TrainingSummary},
    engine::Ballistic,
};
use gradients::{Slope, Task};
use monitor::{BatchDone, Monitor};
use state::State;
use weigh::{Scale, TrivialErrors, TrivialSums};
use window::{Sampler, Window};

/// Windows over which trivial errors are averaged when a stage begins.
const COMMON_WINDOWS: usize = 512;
/// How many of them are in memory at once.
const COMMON_GROUP: usize = 32;

/// A run beside its settings and data.
pub struct Run<'a> {
    /// What computes.
    pub device: DeviceKind,
    /// Where the best checkpoint, `metrics.csv`, the event files and [`LAST_FOLDER`] go.
    pub output: &'a Path,
    /// Whether to go on with the run in `output`; where no epoch of one is there, a new one begins.
    pub resume: bool,
    /// What the machine has left for it.
    pub machine: Machine,
    /// The command line, for the checkpoint's summary.
    pub command: String,
    /// No progress bar, no lines.
    pub quiet: bool,
    /// Whether to stop before the next batch; the best and the last epoch are kept.
    pub interrupted: &'a dyn Fn() -> bool,
}

impl Run<'_> {
    /// Whether there is an epoch to go on from.
    fn goes_on(&self) -> bool {
        self.resume && self.output.join(LAST_FOLDER).exists()
    }
}

/// What a run may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Machine {
    /// Memory beside what the data takes (bytes).
    pub memory: u64,
    /// Disk for the output (bytes).
    pub disk: u64,
}

impl Machine {
    /// A machine on which nothing is too large.
    pub const UNLIMITED: Self = Self { memory: u64::MAX, disk: u64::MAX };

    /// So much memory (bytes), and the disk that is free where the output is, or will be.
    ///
    /// # Errors
    /// [`TrainError::File`] when the system does not say how much that is.
    pub fn with_free_disk(memory: u64, output: &Path) -> Result<Self, TrainError> {
        let there = output.ancestors().find(|folder| folder.exists()).unwrap_or(".".as_ref());
        let there = if there.as_os_str().is_empty() { ".".as_ref() } else { there };
        let disk = fs4::available_space(there)
            .map_err(|reason| TrainError::File { file: there.to_owned(), reason })?;
        Ok(Self { memory, disk })
    }
}

/// What a run came to.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// Every epoch done, those before the run was resumed included.
    pub epochs: Vec<Epoch>,
    /// The best checkpoint, as saved; none if not one epoch was finished.
    pub best: Option<Checkpoint>,
    /// Whether the run was interrupted.
    pub interrupted: bool,
    /// Time spent on it, that before it was resumed included (s).
    pub seconds: f64,
    /// Windows seen.
    pub samples: u64,
}

/// Trains a network. The checkpoint with the best validation loss is kept in `run.output`, the last
/// epoch with everything that is needed to go on in the folder [`LAST_FOLDER`] there.
///
/// The same settings, data and device give the same weights, in one go or in several.
///
/// # Errors
/// [`TrainError`]: a setting out of range, streams too short or unlike each other, a machine too
/// small, an output that holds a run or another one than is to go on; a loss that is not finite, a
/// file that cannot be written (the best and the last checkpoint so far stay).
pub fn train(config: &TrainConfig, dataset: &Dataset, run: &Run) -> Result<Outcome, TrainError> {
    config.check()?;
    let mut description = describe(config, dataset, &run.command)?;
    check_streams(config, dataset)?;
    let particles = dataset.train.iter().map(|stream| stream.material.len()).min().unwrap_or(0);
    footprint::check(config, &description, particles, run)?;
    let mut state = resume::begin(config, &mut description, run)?;
    if state.is_over(config) {
        let State { epochs, best, seconds, samples, .. } = state;
        return Ok(Outcome { epochs, best, interrupted: false, seconds, samples });
    }

    let mut sampler = sampler_for(config, dataset, state.unroll.max(1))?;
    let mut scale = Scale {
        loss: &config.loss,
        normalization: &dataset.normalization,
        ballistic: Ballistic::new(&description),
        common: state.common.clone(),
    };
    let mut monitor = Monitor::new(run.output, config, &state, run.quiet)?;
    let mut interrupted = false;
    'run: while !state.is_over(config) {
        let epoch = state.epoch() + 1;
        let (mut losses, mut learning_rate) = (0.0, 0.0);
        for number in 1..=config.batches() {
            if (run.interrupted)() {
                interrupted = true;
                break 'run;
            }
            let progress = schedule::progress(config, epoch, number);
            let stage = config.unroll[schedule::stage(&config.unroll, progress)];
            if stage.frames != state.unroll {
                state.unroll = stage.frames;
                sampler = sampler_for(config, dataset, state.unroll)?;
                state.common = common(config, &sampler, &scale, &mut state)?;
                scale.common = state.common.clone();
            }

            let left = || schedule::batches_of_stage(config, epoch, number);
            let windows = sampler.batch(config.windows.batch, left, &mut state.order)?;
            let task =
                Task { config, description: &description, scale: &scale, device: run.device };
            let Slope { loss, gradients } =
                task.slope(&state.network, &windows, &mut state.dropout);
            if !loss.is_finite() {
                let windows = names(&windows);
                return Err(TrainError::NotFinite { epoch, batch: number, windows, found: loss });
            }
            learning_rate = schedule::learning_rate(&config.optimizer, progress);
            let mut step = state.adam.step(learning_rate, &config.optimizer).measured();
            state.network.layers_mut().exchange(|tensor, values| {
                if !gradients[tensor].is_empty() {
                    step.change(tensor, values, &gradients[tensor]); // clips it first
                }
            });
            let gradient_norm = step.gradient_norm();

            losses += f64::from(loss);
            state.samples += windows.len() as u64;
            let samples = state.samples;
            monitor.batch(&BatchDone { epoch, samples, loss, learning_rate, gradient_norm })?;
        }
        let mut checkpoint =
            Checkpoint { description: description.clone(), tensors: state.tensors(&description) };
        let score = validate::validate(&config.validation, &checkpoint, &dataset.validation)?;
        let best = state.best_loss().is_none_or(|best| score.loss < best);
        let done = Epoch {
            epoch,
            samples: state.samples,
            unroll: state.unroll,
            training_loss: losses / config.batches() as f64,
            validation_loss: score.loss,
            first_skill: score.first_skill,
            last_skill: score.last_skill,
            learning_rate,
            best,
        };
        summarize(&mut checkpoint.description.training, &done);
        state.epochs.push(done);
        state.since_best = if best { 0 } else { state.since_best + 1 };
        let seconds = state.seconds + monitor.elapsed().as_secs_f64();
        resume::save(run, config, &state, &checkpoint, seconds)?;
        if best {
            checkpoint.save(run.output)?;
            state.best = Some(checkpoint);
        }
        monitor.epoch(&done, config.validation.horizon)?;
    }
    monitor.finish();
    let seconds = state.seconds + monitor.elapsed().as_secs_f64();
    let epochs = state.epoch();
    let State { epochs: all, mut best, samples, .. } = state;
    if let Some(best) = &mut best
        && best.description.training.epochs != epochs
    {
        best.description.training.epochs = epochs;
        best.save(run.output)?;
    }
    Ok(Outcome { epochs: all, best, interrupted, seconds, samples })
}

/// Errors of the best trivial predictor over many windows; none where the loss does not ask for them.
fn common(
    config: &TrainConfig,
    sampler: &Sampler,
    scale: &Scale,
    state: &mut State,
) -> Result<TrivialErrors, TrainError> {
    if config.loss.kind == LossKind::Mse {
        return Ok(Vec::new());
    }
    let mut sums = TrivialSums::new(state.unroll);
    for _ in 0..COMMON_WINDOWS / COMMON_GROUP {
        for window in sampler.draw(COMMON_GROUP, &mut state.order)? {
            sums.add(&window, &scale.ballistic);
        }
    }
    Ok(sums.best())
}

/// Enters an epoch in its checkpoint.
fn summarize(summary: &mut TrainingSummary, epoch: &Epoch) {
    summary.epochs = epoch.epoch;
    summary.best_epoch = epoch.epoch;
    summary.training_loss = epoch.training_loss;
    summary.validation_loss = epoch.validation_loss;
    summary.samples = epoch.samples;
}

/// Refuses streams that are too short, for a later stage as well: better now than in an hour.
fn check_streams(config: &TrainConfig, dataset: &Dataset) -> Result<(), TrainError> {
    for stage in &config.unroll {
        sampler_for(config, dataset, stage.frames)?;
    }
    validate::check(&config.validation, config.windows.warm_up, &dataset.validation)
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
        same_particles(dataset, particles)?;
    }
    no_constant_feature(dataset)?;
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
        grid: config.grid(dataset.spacing),
        rules: Rules::standard(config.architecture),
        domain: first.domain,
        normalization: dataset.normalization.clone(),
        training: TrainingSummary {
            command: command.to_owned(),
            seed: config.seed,
            validation_loss: f64::MAX,
            seen: dataset.seen()?,
            ..TrainingSummary::default()
        },
    })
}

/// Refuses streams that have another number of particles.
fn same_particles(dataset: &Dataset, particles: usize) -> Result<(), TrainError> {
    let mut streams = dataset.train.iter().chain(&dataset.validation).chain(&dataset.test);
    match streams.find(|stream| stream.material.len() != particles) {
        None => Ok(()),
        Some(other) => Err(TrainError::Particles {
            source_file: other.source.clone(),
            stream: other.id,
            found: other.material.len(),
            expected: particles,
        }),
    }
}

/// Refuses features without a range to be divided by.
fn no_constant_feature(dataset: &Dataset) -> Result<(), TrainError> {
    let scale = &dataset.normalization;
    let constant = |&feature: &usize| scale.minimum[feature] >= scale.maximum[feature];
    match (0..4).find(constant) {
        None => Ok(()),
        Some(feature) => {
            let found = scale.minimum[feature];
            Err(TrainError::Constant { feature: ["x", "y", "vx", "vy"][feature], found })
        }
    }
}

fn sampler_for<'a>(
    config: &'a TrainConfig,
    dataset: &'a Dataset,
    unroll: usize,
) -> Result<Sampler<'a>, TrainError> {
    Sampler::new(&dataset.train, &config.windows, unroll)
}

/// Stream and first frame of each window, to find a batch again.
fn names(windows: &[Window]) -> String {
    let names: Vec<_> =
        windows.iter().map(|window| format!("{}:{}", window.stream, window.start)).collect();
    names.join(" ")
}
