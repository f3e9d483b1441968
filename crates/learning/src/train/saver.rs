//! When a run is saved: after every epoch, on a GPU at most every [`INTERVAL`], and when it ends or fails.

use std::time::Duration;

use super::{Run, TrainConfig, TrainError, resume, state::RunState};
use eddy_inference::checkpoint::Checkpoint;

/// Shortest time between two saves of a run on a GPU, whose epochs may take less time than a save.
const INTERVAL: Duration = Duration::from_secs(10);

/// Saves the last epoch with all that is needed to resume, and the best checkpoint.
pub(super) struct Saver<'a> {
    config: &'a TrainConfig,
    run: &'a Run<'a>,
    /// The time since the run began.
    elapsed: &'a dyn Fn() -> Duration,
    /// Shortest time between two saves.
    interval: Duration,
    /// When the last save ended; none before the first.
    saved: Option<Duration>,
    /// The epoch of the best checkpoint on disk.
    best_on_disk: Option<u32>,
    /// The last epoch, if it is not saved. A copy: the next epoch changes the state, and may not come to its end.
    pending: Option<EndOfEpoch>,
}

struct EndOfEpoch {
    state: RunState,
    /// With the weights of the epoch.
    last: Checkpoint,
    /// Training time (s).
    seconds: f64,
}

impl<'a> Saver<'a> {
    /// For a run that goes on from `state`, which is on disk unless the run is new. `is_fast`: an epoch may take less time than a save.
    pub(super) fn new(
        config: &'a TrainConfig,
        run: &'a Run<'a>,
        state: &RunState,
        is_fast: bool,
        elapsed: &'a dyn Fn() -> Duration,
    ) -> Self {
        let interval = if is_fast { INTERVAL } else { Duration::ZERO };
        let best_on_disk = state.best.as_ref().map(epoch_of);
        Self { config, run, elapsed, interval, saved: None, best_on_disk, pending: None }
    }

    /// Saves the epoch that has just ended, whose checkpoint is `last`, or keeps a copy for later.
    pub(super) fn epoch_done(
        &mut self,
        state: &RunState,
        last: Checkpoint,
    ) -> Result<(), TrainError> {
        let now = (self.elapsed)();
        let seconds = state.seconds + now.as_secs_f64();
        if self.saved.is_some_and(|saved| now < saved + self.interval) {
            self.pending = Some(EndOfEpoch { state: state.clone(), last, seconds });
            return Ok(());
        }
        self.pending = None;
        self.save(state, &last, seconds)
    }

    /// Saves the last epoch, if it is not saved.
    pub(super) fn save_pending(&mut self) -> Result<(), TrainError> {
        let Some(EndOfEpoch { state, last, seconds }) = self.pending.take() else { return Ok(()) };
        self.save(&state, &last, seconds)
    }

    /// Saves what is not saved at the end of a run, and enters the number of epochs in the best checkpoint.
    pub(super) fn finish(mut self, state: &mut RunState) -> Result<(), TrainError> {
        self.save_pending()?;
        let done = state.epoch();
        if let Some(best) = &mut state.best
            && best.description.training.epochs != done
        {
            best.description.training.epochs = done;
            best.save(self.run.output)?;
        }
        Ok(())
    }

    fn save(
        &mut self,
        state: &RunState,
        last: &Checkpoint,
        seconds: f64,
    ) -> Result<(), TrainError> {
        let begun = (self.elapsed)();
        // The record names the best epoch: an earlier one must be there before it; this one is in it.
        if !state.epochs.last().is_some_and(|epoch| epoch.best) {
            self.save_best(state)?;
        }
        resume::save(self.run, self.config, state, last, seconds)?;
        self.save_best(state)?;
        let ended = (self.elapsed)();
        self.saved = Some(ended);
        tracing::debug!("epoch {}: {:.2} s to save", state.epoch(), (ended - begun).as_secs_f64());
        Ok(())
    }

    /// Saves the best checkpoint, unless it is on disk.
    fn save_best(&mut self, state: &RunState) -> Result<(), TrainError> {
        let Some(best) = &state.best else { return Ok(()) };
        if self.best_on_disk != Some(epoch_of(best)) {
            best.save(self.run.output)?;
            self.best_on_disk = Some(epoch_of(best));
        }
        Ok(())
    }
}

/// The epoch of a checkpoint.
fn epoch_of(checkpoint: &Checkpoint) -> u32 {
    checkpoint.description.training.best_epoch
}
