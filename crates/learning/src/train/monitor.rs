//! What a run shows while it goes on: a progress bar or plain lines, `metrics.csv`, TensorBoard's
//! event file.

use std::{
    fs::File,
    io::{self, IsTerminal as _, Write as _},
    path::{Path, PathBuf},
    time::Duration,
};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::{Deserialize, Serialize};

use super::{TrainConfig, TrainError, events::EventFile, state::State};
use eddy_frames::clock::{self, Clock};

/// Name of the table of epochs within the output directory.
pub const METRICS_FILE: &str = "metrics.csv";

/// Every so many batches, one is written to the event file.
const BATCHES_A_RECORD: u64 = 10;

/// What one epoch came to.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Epoch {
    /// The epoch, from 1.
    pub epoch: u32,
    /// Windows seen since the start.
    pub samples: u64,
    /// Free frames a window at the epoch's end.
    pub unroll: usize,
    /// Mean training loss of the epoch.
    pub training_loss: f64,
    /// Validation: position errors of free rollouts divided by the best trivial predictor's, averaged
    /// over frames ahead and materials (1 - mean skill).
    pub validation_loss: f64,
    /// Skill one frame ahead, averaged over materials.
    pub first_skill: f64,
    /// Skill at the last frame of the validation rollouts.
    pub last_skill: f64,
    /// Learning rate at the epoch's end.
    pub learning_rate: f64,
    /// Whether its weights are the best so far.
    pub best: bool,
}

impl Epoch {
    /// Its row of `metrics.csv`.
    fn row(&self) -> String {
        let Self { epoch, samples, unroll, training_loss, validation_loss, .. } = self;
        let Self { first_skill, last_skill, learning_rate, .. } = self;
        format!(
            "{epoch},{samples},{unroll},{training_loss:.5e},{validation_loss:.6},{first_skill:.4},{last_skill:.4},{learning_rate:.3e}\n"
        )
    }
}

/// What one batch came to.
#[derive(Clone, Copy, Debug)]
pub(super) struct BatchDone {
    /// The epoch it is in, from 1.
    pub(super) epoch: u32,
    /// Windows seen since the start.
    pub(super) samples: u64,
    pub(super) loss: f32,
    pub(super) learning_rate: f64,
    /// Of the gradient by all tensors, before any was shortened.
    pub(super) gradient_norm: f64,
}

pub(super) struct Monitor {
    bar: ProgressBar,
    metrics: Output<File>,
    events: Output<EventFile>,
    quiet: bool,
    clock: Clock,
    /// When the epoch began, and how many windows were seen by then.
    epoch_began: (Duration, u64),
    batches: u64,
}

/// A file that is written to, and its name for errors.
struct Output<T> {
    file: T,
    path: PathBuf,
}

impl<T> Output<T> {
    fn write(&mut self, write: impl FnOnce(&mut T) -> io::Result<()>) -> Result<(), TrainError> {
        let failed = |reason| TrainError::File { file: self.path.clone(), reason };
        write(&mut self.file).map_err(failed)
    }
}

impl Monitor {
    /// A monitor for a run that is at `state`; its files go into the directory `output`.
    pub(super) fn new(
        output: &Path,
        config: &TrainConfig,
        state: &State,
        quiet: bool,
    ) -> Result<Self, TrainError> {
        let failed = |file: &Path| {
            let file = file.to_owned();
            move |reason| TrainError::File { file, reason }
        };
        std::fs::create_dir_all(output).map_err(failed(output))?;
        let path = output.join(METRICS_FILE);
        let mut file = File::create(&path).map_err(failed(&path))?;
        let mut table = String::from(
            "epoch,samples,unroll,training_loss,validation_loss,first_skill,last_skill,learning_rate\n",
        );
        table.extend(state.epochs.iter().map(Epoch::row));
        file.write_all(table.as_bytes()).map_err(failed(&path))?;
        let metrics = Output { file, path };
        let file = EventFile::create(output, clock::wall()).map_err(failed(output))?;
        let mut events = Output { file, path: output.to_owned() };
        // Also at 0: a run that ended before its first epoch was done may have left events.
        events.write(|events| events.goes_on_after(clock::wall(), state.samples))?;

        let target =
            if quiet { ProgressDrawTarget::hidden() } else { ProgressDrawTarget::stderr() };
        let style = ProgressStyle::with_template("{bar:30} {percent:>3} % {eta:>5} left  {msg}")
            .unwrap_or_else(|_| ProgressStyle::default_bar());
        let batches = config.batches() as u64 * u64::from(config.epochs);
        let bar = ProgressBar::with_draw_target(Some(batches), target).with_style(style);
        bar.set_position(state.samples / config.windows.batch as u64);
        bar.reset_eta();
        let epoch_began = (Duration::ZERO, state.samples);
        Ok(Self { bar, metrics, events, quiet, clock: Clock::start(), epoch_began, batches: 0 })
    }

    /// Time since the monitor was made.
    pub(super) fn elapsed(&self) -> Duration {
        self.clock.now()
    }

    /// Windows a second in the epoch at hand.
    fn speed(&self, samples: u64) -> f64 {
        let (began, before) = self.epoch_began;
        (samples - before) as f64 / (self.elapsed() - began).as_secs_f64().max(1e-9)
    }

    /// One batch is done.
    pub(super) fn batch(&mut self, batch: &BatchDone) -> Result<(), TrainError> {
        let BatchDone { epoch, samples, loss, learning_rate, gradient_norm } = *batch;
        let speed = self.speed(samples);
        self.bar.set_message(format!("epoch {epoch}, loss {loss:.3e}, {speed:.0} samples/s"));
        self.bar.inc(1);
        if self.batches.is_multiple_of(BATCHES_A_RECORD) {
            let scalars = [
                ("loss/batch", f64::from(loss)),
                ("learning_rate", learning_rate),
                ("gradient_norm", gradient_norm),
                ("samples_per_second", speed),
            ];
            self.events.write(|events| events.scalars(clock::wall(), samples, &scalars))?;
        }
        self.batches += 1;
        Ok(())
    }

    /// One epoch is done.
    pub(super) fn epoch(&mut self, epoch: &Epoch, horizon: usize) -> Result<(), TrainError> {
        self.metrics.write(|file| file.write_all(epoch.row().as_bytes()))?;
        let scalars = [
            ("loss/training", epoch.training_loss),
            ("loss/validation", epoch.validation_loss),
            ("skill/first_frame", epoch.first_skill),
            ("skill/last_frame", epoch.last_skill),
        ];
        self.events.write(|events| events.scalars(clock::wall(), epoch.samples, &scalars))?;
        self.epoch_began = (self.elapsed(), epoch.samples);
        if !self.quiet {
            let Epoch { epoch: number, unroll, training_loss, validation_loss, .. } = epoch;
            let Epoch { first_skill, last_skill, best, .. } = epoch;
            let star = if *best { "  best" } else { "" };
            self.line(&format!(
                "epoch {number:>3}  unroll {unroll:>2}  loss {training_loss:.3e}  validation {validation_loss:.4}  skill {first_skill:.2} at 1, {last_skill:.2} at {horizon}{star}"
            ));
        }
        Ok(())
    }

    /// Removes the bar.
    pub(super) fn finish(&self) {
        self.bar.finish_and_clear();
    }

    /// A line above the bar, or on its own where there is no terminal.
    fn line(&self, text: &str) {
        if io::stderr().is_terminal() {
            self.bar.println(text);
        } else {
            // A closed standard error is no reason to stop training.
            let _ = writeln!(io::stderr(), "{text}");
        }
    }
}
