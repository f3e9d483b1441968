//! What a run shows while it goes on: a progress bar or plain lines, and `metrics.csv`.

use std::{
    fs::File,
    io::{IsTerminal as _, Write as _},
    path::{Path, PathBuf},
};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use super::TrainError;

/// Name of the table of epochs within the output directory.
pub const METRICS_FILE: &str = "metrics.csv";

/// What one epoch came to.
#[derive(Clone, Copy, Debug, PartialEq)]
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

pub(super) struct Monitor {
    bar: ProgressBar,
    metrics: File,
    file: PathBuf,
    quiet: bool,
}

impl Monitor {
    /// A monitor for `batches` batches in all; the table goes into the directory `output`.
    pub(super) fn new(output: &Path, batches: u64, quiet: bool) -> Result<Self, TrainError> {
        let file = output.join(METRICS_FILE);
        let failed = |reason| TrainError::Metrics { file: file.clone(), reason };
        std::fs::create_dir_all(output).map_err(failed)?;
        let mut metrics = File::create(&file).map_err(failed)?;
        writeln!(
            metrics,
            "epoch,samples,unroll,training_loss,validation_loss,first_skill,last_skill,learning_rate"
        )
        .map_err(failed)?;
        let target =
            if quiet { ProgressDrawTarget::hidden() } else { ProgressDrawTarget::stderr() };
        let style = ProgressStyle::with_template("{bar:30} {percent:>3} % {eta:>5} left  {msg}")
            .unwrap_or_else(|_| ProgressStyle::default_bar());
        let bar = ProgressBar::with_draw_target(Some(batches), target).with_style(style);
        Ok(Self { bar, metrics, file, quiet })
    }

    /// One batch is done.
    pub(super) fn batch(&self, epoch: u32, loss: f32) {
        self.bar.set_message(format!("epoch {epoch}, loss {loss:.3e}"));
        self.bar.inc(1);
    }

    /// One epoch is done.
    pub(super) fn epoch(&mut self, epoch: &Epoch, horizon: usize) -> Result<(), TrainError> {
        let Epoch { epoch: number, samples, unroll, training_loss, validation_loss, .. } = epoch;
        let Epoch { first_skill, last_skill, learning_rate, best, .. } = epoch;
        writeln!(
            self.metrics,
            "{number},{samples},{unroll},{training_loss:.5e},{validation_loss:.6},{first_skill:.4},{last_skill:.4},{learning_rate:.3e}"
        )
        .and_then(|()| self.metrics.flush())
        .map_err(|reason| TrainError::Metrics { file: self.file.clone(), reason })?;
        if !self.quiet {
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
        if std::io::stderr().is_terminal() {
            self.bar.println(text);
        } else {
            // A closed standard error is no reason to stop training.
            let _ = writeln!(std::io::stderr(), "{text}");
        }
    }
}
