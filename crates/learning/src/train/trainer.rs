//! The training loop: epochs of steps, validation, and when a run is saved.

use std::{collections::BTreeMap, mem::swap, time::Duration};

use rand_chacha::ChaCha8Rng;

use super::{
    Dependencies, Epoch, LossKind, Outcome, Run, TrainConfig, TrainError,
    gradients::GradientTask,
    loss_weights::{CommonSums, LossScale, TrivialErrors},
    monitor::{BatchMetrics, Monitor},
    movement::Movement,
    resume, sampler, schedule,
    state::{RunState, weights_at_start},
    steps::{Learner, Step},
    validate::{self, Score},
    window::{self, Sampler},
};
use crate::model::dropout::Dropout;
use eddy_evaluation::dataset::Dataset;
use eddy_inference::{
    checkpoint::{Checkpoint, Description, Weights},
    engine::Ballistic,
};

/// Windows over which trivial errors are averaged at the start of an unroll stage.
const COMMON_WINDOWS: usize = 512;
/// Number of these that are in memory at the same time.
const COMMON_GROUP: usize = 32;

/// Trains from `state` on.
pub(super) fn take_epochs(
    config: &TrainConfig,
    dataset: &Dataset,
    run: &Run,
    description: &Description,
    state: RunState,
    dependencies: &Dependencies<'_>,
) -> Result<Outcome, TrainError> {
    if state.is_over(config) {
        let RunState { epochs, best, seconds, samples, .. } = state;
        return Ok(Outcome { epochs, best, interrupted: false, seconds, samples });
    }
    let sampler = sampler(config, dataset, state.unroll.max(1))?;
    let scale = LossScale {
        loss: &config.loss,
        normalization: &description.normalization,
        ballistic: Ballistic::new(description),
        common: state.common.clone(),
    };
    let mut monitor = Monitor::new(run.output, config, &state, run.progress, dependencies.clock)?;
    let mut learner = (dependencies.learner)(description)?;
    let initial = weights_at_start(config, description, run.start);
    let mut start = None;
    if run.start.is_some() {
        let checkpoint = Checkpoint::new(description.clone(), initial.clone());
        let published = checkpoint.with_weights(config.network.weights);
        let score = score(&mut learner, config, dataset, &published)?;
        monitor.starts_from(&score);
        start = Some(score.loss);
    }
    let mut trainer = Trainer {
        config,
        dataset,
        run,
        description,
        state,
        sampler,
        scale,
        monitor,
        learner,
        initial,
        start,
        saved: None,
        has_unsaved_best: false,
        unsaved: None,
    };
    if trainer.state.unroll > 0 {
        trainer.begin_stage()?;
    }
    let mut interrupted = false;
    while !interrupted && !trainer.state.is_over(config) {
        let outcome = match trainer.epoch() {
            Ok(Some(means)) => trainer.validate_and_save(&means),
            Ok(None) => {
                interrupted = true;
                Ok(())
            }
            Err(error) => Err(error),
        };
        if let Err(error) = outcome {
            if let Err(second) = trainer.save_last_epoch().and_then(|()| trainer.save_best()) {
                tracing::warn!("the last and the best epoch are not saved: {second}");
            }
            return Err(error);
        }
    }
    trainer.finish(interrupted)
}

/// Validates a checkpoint.
fn score(
    learner: &mut Learner,
    config: &TrainConfig,
    dataset: &Dataset,
    checkpoint: &Checkpoint,
) -> Result<Score, TrainError> {
    let surrogate = learner.surrogate(checkpoint)?;
    validate::validate(&config.validation, &surrogate, &dataset.validation)
}

/// Shortest time between two saves of a run on a GPU, whose epochs may take less time than a save.
const SAVE_INTERVAL: Duration = Duration::from_secs(10);

/// The training loop.
struct Trainer<'a> {
    config: &'a TrainConfig,
    dataset: &'a Dataset,
    run: &'a Run<'a>,
    description: &'a Description,
    state: RunState,
    sampler: Sampler<'a>,
    scale: LossScale<'a>,
    monitor: Monitor<'a>,
    learner: Learner,
    /// The weights before the first step.
    initial: BTreeMap<String, Weights>,
    /// Validation loss of the checkpoint that the run starts from, if any.
    start: Option<f64>,
    /// When the run was saved last, since its start.
    saved: Option<Duration>,
    /// Whether the best checkpoint is yet to be saved.
    has_unsaved_best: bool,
    /// Of the last epoch, if it is yet to be saved.
    unsaved: Option<Boundary>,
}

/// What changes in the state of a run on a GPU between the end of an epoch and that of the next one.
struct Boundary {
    order: ChaCha8Rng,
    dropout: Dropout,
    steps: u32,
    samples: u64,
}

impl Boundary {
    fn of(state: &RunState) -> Self {
        let RunState { order, dropout, optimizer, samples, .. } = state;
        Self {
            order: order.clone(),
            dropout: dropout.clone(),
            steps: optimizer.steps,
            samples: *samples,
        }
    }

    /// Puts it into the state, and takes what was there.
    fn swap(&mut self, state: &mut RunState) {
        swap(&mut self.order, &mut state.order);
        swap(&mut self.dropout, &mut state.dropout);
        swap(&mut self.steps, &mut state.optimizer.steps);
        swap(&mut self.samples, &mut state.samples);
    }
}

/// Training loss and learning rate of an epoch.
struct EpochMeans {
    loss: f64,
    /// Learning rate of the last batch.
    learning_rate: f64,
}

impl Trainer<'_> {
    /// Whether to stop before the next batches.
    fn stops(&self) -> bool {
        // Epochs that are not yet saved take less time than saving: the one at hand is finished, and saved.
        self.run.progress.cancelled() && self.unsaved.is_none()
    }

    /// Trains for an epoch; none if it was interrupted.
    fn epoch(&mut self) -> Result<Option<EpochMeans>, TrainError> {
        let (config, epoch) = (self.config, self.state.epoch() + 1);
        let (mut losses, mut learning_rate, mut number) = (0.0, 0.0, 1);
        while number <= config.batches() {
            if self.stops() {
                return Ok(None);
            }
            let progress = |number| schedule::progress(config, epoch, number);
            let stage = schedule::stage(&config.unroll, progress(number));
            self.set_unroll(config.unroll[stage].frames)?;

            let left = schedule::batches_of_stage(config, epoch, number);
            let count = self.learner.group().min(left);
            let rate = |number| schedule::learning_rate(&config.optimizer, progress(number));
            let rates: Vec<f64> = (number..number + count).map(rate).collect();
            let task = GradientTask {
                config,
                description: self.description,
                scale: &self.scale,
                device: self.run.device,
            };
            let steps =
                self.learner.steps(&task, &mut self.sampler, left, &rates, &mut self.state)?;
            for (step, rate) in steps.into_iter().zip(rates) {
                let Step { loss, gradient_norm, finite, windows } = step;
                let batch = number;
                if !loss.is_finite() {
                    let windows = window::names(&windows);
                    return Err(TrainError::NotFinite { epoch, batch, windows, found: loss });
                }
                if !finite {
                    let windows = window::names(&windows);
                    return Err(TrainError::GradientNotFinite { epoch, batch, windows });
                }
                learning_rate = rate;
                losses += f64::from(loss);
                self.state.samples += windows.len() as u64;
                let samples = self.state.samples;
                let metrics = BatchMetrics { epoch, samples, loss, learning_rate, gradient_norm };
                self.monitor.batch(&metrics)?;
                number += 1;
            }
        }
        // The weights of the epoch before are no longer there.
        self.unsaved = None;
        self.learner.sync(&mut self.state)?;
        Ok(Some(EpochMeans { loss: losses / config.batches() as f64, learning_rate }))
    }

    /// Changes the number of frames that are predicted freely.
    fn set_unroll(&mut self, frames: usize) -> Result<(), TrainError> {
        if frames == self.state.unroll {
            return Ok(());
        }
        self.save_last_epoch()?;
        self.learner.sync(&mut self.state)?;
        self.state.unroll = frames;
        self.sampler = sampler(self.config, self.dataset, frames)?;
        self.state.common = self.trivial_errors()?;
        self.scale.common = self.state.common.clone();
        self.begin_stage()
    }

    /// Copies the weights to the device that computes the steps of a stage.
    fn begin_stage(&mut self) -> Result<(), TrainError> {
        let Self { config, description, scale, run, learner, state, .. } = self;
        let task = GradientTask { config, description, scale, device: run.device };
        learner.begin(&task, state)
    }

    /// Errors of the best trivial predictor over many windows; empty if the loss does not use them.
    fn trivial_errors(&mut self) -> Result<TrivialErrors, TrainError> {
        if self.config.loss.kind == LossKind::Mse {
            return Ok(Vec::new());
        }
        let mut sums = CommonSums::new(self.state.unroll, self.config.network.stiffness);
        // Of all stiffnesses, also if batches are not.
        let (streams, windows) = (&self.dataset.train, &self.config.windows);
        let sampler = Sampler::new(streams, windows, self.state.unroll)?;
        for _ in 0..COMMON_WINDOWS / COMMON_GROUP {
            for window in sampler.draw(COMMON_GROUP, &mut self.state.order)? {
                sums.add(&window, &self.scale.ballistic);
            }
        }
        Ok(sums.best())
    }

    /// Validates the weights after an epoch, and saves the run and, if it is the best so far, the checkpoint.
    #[expect(clippy::too_many_lines, reason = "what follows an epoch, in order")]
    fn validate_and_save(&mut self, means: &EpochMeans) -> Result<(), TrainError> {
        let Self { config, dataset, run, state, monitor, learner, initial, .. } = self;
        let begun = monitor.elapsed();
        let tensors = state.tensors(self.description);
        let movement = Movement::of(initial, &tensors, &state.optimizer, &config.optimizer);
        let mut checkpoint = Checkpoint::new(self.description.clone(), tensors);
        let mut published = checkpoint.with_weights(config.network.weights);
        let surrogate = learner.surrogate(&published)?;
        let loaded = monitor.elapsed();
        let score = validate::validate(&config.validation, &surrogate, &dataset.validation)?;
        let validated = monitor.elapsed();
        let best = state.best_loss().is_none_or(|best| score.loss < best);
        let epoch = Epoch {
            epoch: state.epoch() + 1,
            samples: state.samples,
            unroll: state.unroll,
            training_loss: means.loss,
            validation_loss: score.loss,
            first_skill: score.first_skill,
            last_skill: score.last_skill,
            learning_rate: means.learning_rate,
            weight_distance: movement.distance,
            epsilon_share: movement.epsilon_share,
            best,
        };
        epoch.summarize(&mut checkpoint.description.training);
        epoch.summarize(&mut published.description.training);
        state.epochs.push(epoch);
        state.since_best = if best { 0 } else { state.since_best + 1 };
        let elapsed = monitor.elapsed();
        let saves = !learner.is_fast()
            || self.saved.is_none_or(|saved| elapsed >= saved + SAVE_INTERVAL)
            || run.progress.cancelled()
            || state.is_over(config);
        if saves {
            // The record names the best epoch: an earlier one must be there before it; this one is in it.
            if !best {
                self.save_best()?;
            }
            let seconds = self.state.seconds + elapsed.as_secs_f64();
            resume::save(self.run, self.config, &self.state, &checkpoint, seconds)?;
        }
        if best {
            self.state.best = Some(published);
            self.has_unsaved_best = true;
        }
        self.unsaved = (!saves).then(|| Boundary::of(&self.state));
        (self.run.on_epoch)(&epoch);
        self.monitor.epoch(&epoch)?;
        if epoch.epoch == 1
            && let Some(warning) = movement.warning(&self.config.optimizer)
        {
            self.run.progress.message(&warning);
        }
        if saves {
            self.save_best()?;
            self.saved = Some(self.monitor.elapsed());
        }
        tracing::debug!(
            "epoch {}: {:.2} s to read the weights, {:.2} s of rollouts, {:.2} s to save",
            epoch.epoch,
            (loaded - begun).as_secs_f64(),
            (validated - loaded).as_secs_f64(),
            (self.monitor.elapsed() - validated).as_secs_f64()
        );
        Ok(())
    }

    /// Saves the last epoch, if it is not yet saved, as long as its weights are those of the state.
    fn save_last_epoch(&mut self) -> Result<(), TrainError> {
        let Some(mut boundary) = self.unsaved.take() else { return Ok(()) };
        let Some(epoch) = self.state.epochs.last().copied() else { return Ok(()) };
        if !epoch.best {
            self.save_best()?;
        }
        let tensors = self.state.tensors(self.description);
        let mut checkpoint = Checkpoint::new(self.description.clone(), tensors);
        epoch.summarize(&mut checkpoint.description.training);
        let now = self.monitor.elapsed();
        let seconds = self.state.seconds + now.as_secs_f64();
        boundary.swap(&mut self.state);
        let outcome = resume::save(self.run, self.config, &self.state, &checkpoint, seconds);
        boundary.swap(&mut self.state);
        outcome?;
        self.saved = Some(now);
        self.save_best()
    }

    /// Saves the best checkpoint, if it is not yet saved.
    fn save_best(&mut self) -> Result<(), TrainError> {
        if self.has_unsaved_best
            && let Some(best) = &self.state.best
        {
            best.save(self.run.output)?;
            self.has_unsaved_best = false;
        }
        Ok(())
    }

    /// Enters the number of epochs in the best checkpoint.
    fn finish(self, interrupted: bool) -> Result<Outcome, TrainError> {
        self.monitor.finish();
        if let (Some(start), Some(best), false) = (self.start, self.state.best_loss(), interrupted)
            && best >= start
        {
            self.monitor.is_no_better(start, best);
        }
        let seconds = self.state.seconds + self.monitor.elapsed().as_secs_f64();
        let done = self.state.epoch();
        let RunState { epochs, mut best, samples, .. } = self.state;
        if let Some(best) = &mut best
            && best.description.training.epochs != done
        {
            best.description.training.epochs = done;
            best.save(self.run.output)?;
        }
        Ok(Outcome { epochs, best, interrupted, seconds, samples })
    }
}
