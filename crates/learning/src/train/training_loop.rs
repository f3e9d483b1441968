//! The training loop: for every epoch, for every batch, a step; then validate and save.

use std::{collections::BTreeMap, time::Duration};

use super::{
    Dependencies, Outcome, Setup, TrainError,
    monitor::Monitor,
    movement::Movement,
    saver::Saver,
    schedule,
    stage::Stage,
    state::{RunState, weights_at_start},
    steps::Learner,
    validate::{self, Score},
};
use eddy_inference::checkpoint::{Checkpoint, Weights};

/// Opens what the loop works with, trains from `state` on, and ends the run.
pub(super) fn train_from(
    setup: &Setup<'_>,
    mut state: RunState,
    dependencies: &Dependencies<'_>,
) -> Result<Outcome, TrainError> {
    let Setup { config, run, description, .. } = *setup;
    if state.is_over(config) {
        return Ok(state.outcome(false, Duration::ZERO));
    }
    let begun = (dependencies.clock)();
    let elapsed = || (dependencies.clock)().saturating_sub(begun);
    let mut monitor = Monitor::new(run.output, config, &state, run.progress, &elapsed)?;
    let mut learner = (dependencies.learner)(description)?;
    let mut saver = Saver::new(config, run, &state, learner.is_fast(), &elapsed);
    let initial = weights_at_start(config, description, run.start);
    let mut start = None;
    if run.start.is_some() {
        let checkpoint = Checkpoint::new(description.clone(), initial.clone());
        let published = checkpoint.with_weights(config.network.weights);
        let score = score(setup, &mut learner, &published, &monitor)?;
        monitor.starts_from(&score);
        start = Some(score.loss);
    }

    let ended = epochs(setup, &mut state, &mut learner, &mut monitor, &mut saver, &initial);
    let interrupted = match ended {
        Ok(interrupted) => interrupted,
        Err(error) => {
            if let Err(second) = saver.save_pending() {
                tracing::warn!("the last and the best epoch are not saved: {second}");
            }
            return Err(error);
        }
    };
    saver.finish(&mut state)?;
    monitor.finish();
    if let (Some(start), Some(best), false) = (start, state.best_loss(), interrupted)
        && best >= start
    {
        monitor.is_no_better(start, best);
    }
    Ok(state.outcome(interrupted, elapsed()))
}

/// The loop. Returns whether it was interrupted.
fn epochs(
    setup: &Setup<'_>,
    state: &mut RunState,
    learner: &mut Learner,
    monitor: &mut Monitor<'_>,
    saver: &mut Saver<'_>,
    initial: &BTreeMap<String, Weights>,
) -> Result<bool, TrainError> {
    let Setup { config, run, description, .. } = *setup;
    let unroll = schedule::unroll(config, state.epoch() + 1, 1);
    let mut stage = Stage::begin(setup, unroll, state, learner)?;
    while !state.is_over(config) {
        let epoch = state.epoch() + 1;
        let (mut losses, mut learning_rate) = (0.0, 0.0);
        // A batch at a time; on a GPU several, which it runs without waiting for the CPU.
        for batches in schedule::batches(config, epoch, learner.group()) {
            if run.progress.cancelled() {
                return Ok(true);
            }
            if batches.unroll != stage.unroll {
                stage = Stage::begin(setup, batches.unroll, state, learner)?;
            }
            let task = setup.task(&stage.scale);
            let steps = learner.steps(&task, &mut stage.sampler, &batches, state)?;
            for (step, batch) in steps.iter().zip(batches.first..) {
                step.check(epoch, batch)?;
                state.samples += step.windows.len() as u64;
                losses += f64::from(step.loss);
                learning_rate = step.learning_rate;
                monitor.batch(epoch, state.samples, step)?;
            }
        }
        learner.sync(state)?;

        let mut last = Checkpoint::new(description.clone(), state.tensors(description));
        let mut published = last.with_weights(config.network.weights);
        let score = score(setup, learner, &published, monitor)?;
        let movement = Movement::of(initial, &last.tensors, &state.optimizer, &config.optimizer);
        let loss = losses / config.batches() as f64;
        let epoch = state.end_epoch(loss, learning_rate, &score, &movement);
        epoch.summarize(&mut last.description.training);
        if epoch.best {
            epoch.summarize(&mut published.description.training);
            state.best = Some(published);
        }
        saver.epoch_done(state, last)?;
        (run.on_epoch)(&epoch);
        monitor.epoch(&epoch, movement.warning(&config.optimizer))?;
    }
    Ok(false)
}

/// Validates a checkpoint.
fn score(
    setup: &Setup<'_>,
    learner: &mut Learner,
    checkpoint: &Checkpoint,
    monitor: &Monitor<'_>,
) -> Result<Score, TrainError> {
    let begun = monitor.elapsed();
    let surrogate = learner.surrogate(checkpoint)?;
    let loaded = monitor.elapsed();
    let Setup { config, dataset, .. } = *setup;
    let score = validate::validate(&config.validation, &surrogate, &dataset.validation)?;
    tracing::debug!(
        "validation: {:.2} s to load the weights, {:.2} s of rollouts",
        (loaded - begun).as_secs_f64(),
        (monitor.elapsed() - loaded).as_secs_f64()
    );
    Ok(score)
}
