//! Reports a run: progress, `metrics.csv`, TensorBoard's event file.

use std::{
    fs::File,
    io::{self, Write as _},
    path::{Path, PathBuf},
    time::Duration,
};

use serde::{Deserialize, Serialize};

use super::{
    TrainConfig, TrainError, events::EventFile, state::RunState, steps::Step, validate::Score,
};
use eddy_evaluation::skill_text;
use eddy_frames::{clock, progress::Progress};
use eddy_inference::checkpoint::TrainingSummary;

/// Name of the table of epochs within the output directory.
pub const METRICS_FILE: &str = "metrics.csv";

/// Interval of batches that are written to the event file.
const BATCHES_PER_EVENT: u64 = 10;

/// The metrics of an epoch.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Epoch {
    /// Number of the epoch, from 1.
    pub epoch: u32,
    /// Training windows since the start.
    pub samples: u64,
    /// Freely predicted frames per window at the end of the epoch.
    pub unroll: usize,
    /// Mean training loss.
    pub training_loss: f64,
    /// Validation loss, 1 - mean skill: position errors of free rollouts relative to those of the best trivial predictor,
    /// averaged over frames ahead and kinds of scenes.
    pub validation_loss: f64,
    /// Skill one frame ahead, averaged over kinds of scenes.
    pub first_skill: f64,
    /// Skill at the last frame of the validation rollouts.
    pub last_skill: f64,
    /// Learning rate at the end of the epoch.
    pub learning_rate: f64,
    /// Distance of the weights from the initial ones, relative to the norm of these.
    #[serde(default)]
    pub weight_distance: f64,
    /// Share of Adam's steps that its epsilon takes away: the mean of epsilon / (root of the second moment + epsilon).
    #[serde(default)]
    pub epsilon_share: f64,
    /// Whether its weights are the best so far.
    pub best: bool,
}

impl Epoch {
    /// Enters the epoch in the summary of its checkpoint.
    pub(super) fn summarize(&self, summary: &mut TrainingSummary) {
        summary.epochs = self.epoch;
        summary.best_epoch = self.epoch;
        summary.training_loss = self.training_loss;
        summary.validation_loss = self.validation_loss;
        summary.samples = self.samples;
    }

    /// Its row of `metrics.csv`.
    fn row(&self) -> String {
        let Self { epoch, samples, unroll, training_loss, validation_loss, .. } = self;
        let Self { first_skill, last_skill, learning_rate, weight_distance, epsilon_share, .. } =
            self;
        format!(
            "{epoch},{samples},{unroll},{training_loss:.5e},{validation_loss:.6},{first_skill:.4},{last_skill:.4},{learning_rate:.3e},{weight_distance:.4e},{epsilon_share:.4}\n"
        )
    }
}

/// Reports a run.
pub(super) struct Monitor<'a> {
    progress: &'a dyn Progress,
    files: Files,
    /// The time since the run began.
    elapsed: &'a dyn Fn() -> Duration,
    /// Start of the epoch, and training windows up to then.
    epoch_start: (Duration, u64),
    batches: u64,
}

/// What a run writes beside its checkpoints.
struct Files {
    metrics: NamedFile<File>,
    events: NamedFile<EventFile>,
}

/// An open file with its path, for errors.
struct NamedFile<T> {
    file: T,
    path: PathBuf,
}

impl<T> NamedFile<T> {
    fn write(&mut self, write: impl FnOnce(&mut T) -> io::Result<()>) -> Result<(), TrainError> {
        let failed = |reason| TrainError::File { file: self.path.clone(), reason };
        write(&mut self.file).map_err(failed)
    }
}

impl Files {
    /// Creates them at `state`.
    fn create(output: &Path, state: &RunState) -> Result<Self, TrainError> {
        let failed = |file: &Path| {
            let file = file.to_owned();
            move |reason| TrainError::File { file, reason }
        };
        std::fs::create_dir_all(output).map_err(failed(output))?;
        let path = output.join(METRICS_FILE);
        let mut file = File::create(&path).map_err(failed(&path))?;
        let mut table = String::from(
            "epoch,samples,unroll,training_loss,validation_loss,first_skill,last_skill,learning_rate,weight_distance,epsilon_share\n",
        );
        table.extend(state.epochs.iter().map(Epoch::row));
        file.write_all(table.as_bytes()).map_err(failed(&path))?;
        let metrics = NamedFile { file, path };
        let file = EventFile::create(output, clock::wall()).map_err(failed(output))?;
        let mut events = NamedFile { file, path: output.to_owned() };
        // Also at 0: a run that ended before its first epoch may have left events.
        events.write(|events| events.resume_after(clock::wall(), state.samples))?;
        Ok(Self { metrics, events })
    }
}

impl<'a> Monitor<'a> {
    /// Starts to report a run at `state`; its files go to the directory `output`.
    pub(super) fn new(
        output: &Path,
        config: &TrainConfig,
        state: &RunState,
        progress: &'a dyn Progress,
        elapsed: &'a dyn Fn() -> Duration,
    ) -> Result<Self, TrainError> {
        let files = Files::create(output, state)?;
        let batches = config.batches() as u64 * u64::from(config.epochs);
        let done = state.samples / config.windows.batch as u64;
        progress.begin(batches.saturating_sub(done), "batches");
        let epoch_start = (Duration::ZERO, state.samples);
        Ok(Self { progress, files, elapsed, epoch_start, batches: 0 })
    }

    /// Time since the run began.
    pub(super) fn elapsed(&self) -> Duration {
        (self.elapsed)()
    }

    /// Writes scalars to the event file.
    fn scalars(&mut self, samples: u64, scalars: &[(&str, f64)]) -> Result<(), TrainError> {
        self.files.events.write(|events| events.scalars(clock::wall(), samples, scalars))
    }

    /// Training windows per second in the current epoch.
    fn speed(&self, samples: u64) -> f64 {
        let (start, before) = self.epoch_start;
        (samples - before) as f64 / (self.elapsed() - start).as_secs_f64().max(1e-9)
    }

    /// Reports the step of a batch of an epoch, counted from 1, and the training windows up to then.
    pub(super) fn batch(
        &mut self,
        epoch: u32,
        samples: u64,
        step: &Step,
    ) -> Result<(), TrainError> {
        let Step { loss, learning_rate, gradient_norm, .. } = *step;
        let speed = self.speed(samples);
        self.progress.status(&format!("epoch {epoch}, loss {loss:.3e}, {speed:.0} samples/s"));
        self.progress.advance(1);
        if self.batches.is_multiple_of(BATCHES_PER_EVENT) {
            let scalars = [
                ("loss/batch", f64::from(loss)),
                ("learning_rate", learning_rate),
                ("gradient_norm", gradient_norm),
                ("samples_per_second", speed),
            ];
            self.scalars(samples, &scalars)?;
        }
        self.batches += 1;
        Ok(())
    }

    /// Reports an epoch, and after the first one a warning, if there is one.
    pub(super) fn epoch(
        &mut self,
        epoch: &Epoch,
        warning: Option<String>,
    ) -> Result<(), TrainError> {
        self.files.metrics.write(|file| file.write_all(epoch.row().as_bytes()))?;
        let scalars = [
            ("loss/training", epoch.training_loss),
            ("loss/validation", epoch.validation_loss),
            ("skill/first_frame", epoch.first_skill),
            ("skill/last_frame", epoch.last_skill),
            ("weights/distance", epoch.weight_distance),
            ("weights/epsilon_share", epoch.epsilon_share),
        ];
        self.scalars(epoch.samples, &scalars)?;
        self.epoch_start = (self.elapsed(), epoch.samples);
        let Epoch { epoch: number, unroll, training_loss, validation_loss, .. } = epoch;
        let [first, last] = [epoch.first_skill, epoch.last_skill].map(skill_text);
        let star = if epoch.best { "  best" } else { "" };
        self.progress.message(&format!(
            "epoch {number:>3}  unroll {unroll:>2}  loss {training_loss:.3e}  validation {validation_loss:.4}  skill {first} {last}{star}"
        ));
        if let (1, Some(warning)) = (number, warning) {
            self.progress.message(&warning);
        }
        Ok(())
    }

    /// Reports how good the checkpoint is that the run starts from; the first epoch begins now.
    pub(super) fn starts_from(&mut self, score: &Score) {
        let Score { loss, first_skill, last_skill } = score;
        let [first, last] = [*first_skill, *last_skill].map(skill_text);
        let text =
            format!("the checkpoint to start from: validation {loss:.4}  skill {first} {last}");
        self.progress.message(&text);
        self.epoch_start.0 = self.elapsed();
    }

    /// Reports that the best epoch of a run is no better than the checkpoint that it started from, by their validation losses.
    pub(super) fn is_no_better(&self, start: f64, best: f64) {
        self.progress.message(&format!(
            "no epoch is better than the checkpoint to start from: lowest validation loss {best:.6}, of the checkpoint \
             {start:.6}; train longer, or with a smaller optimizer.learning_rate"
        ));
    }

    /// Ends the report.
    pub(super) fn finish(&self) {
        self.progress.finish();
    }
}
