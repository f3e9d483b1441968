//! Validation: free rollouts over streams that are not trained on, compared with trivial predictors.

use std::num::NonZeroUsize;

use rayon::prelude::*;

use super::{TrainError, ValidationConfig};
use eddy_evaluation::{
    Baseline, Context, DEFAULT_STARTS, EvalError, Predictor, SceneResult, Settings, Skills,
    dataset::{Bounds, Dataset, Trajectory},
    evaluate_scene, starts,
};
use eddy_inference::{
    checkpoint::{Checkpoint, Description},
    engine::Surrogate,
};

/// The result of a validation.
#[derive(Clone, Copy, Debug)]
pub(super) struct Score {
    /// 1 - skill, averaged over kinds of scenes and frames ahead; it selects the best epoch.
    pub(super) loss: f64,
    /// Skill one frame ahead, averaged over kinds of scenes.
    pub(super) first_skill: f64,
    /// Skill at the last frame.
    pub(super) last_skill: f64,
}

/// 1 - skill, averaged over kinds of scenes and frames ahead.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RolloutLoss {
    /// Of a checkpoint.
    pub model: f64,
    /// Of the linear fit to its training data, if the checkpoint has one.
    pub linear_fit: Option<f64>,
}

/// The validation loss of a checkpoint on any streams, seen in training or not, beside that of the linear fit.
///
/// # Errors
/// [`TrainError`] when a stream cannot be read or predicted, or all are too short.
pub fn rollout_loss(
    checkpoint: &Checkpoint,
    config: &ValidationConfig,
    streams: &[Trajectory],
) -> Result<RolloutLoss, TrainError> {
    let settings = Settings::errors_only(config.horizon, config.starts);
    let surrogate = one_thread(checkpoint)?;
    let scenes = roll_out(settings, &surrogate, streams, streams)?;
    let loss = |predictor: usize| {
        let skill = mean_skill(&scenes, predictor, config.horizon);
        1.0 - skill.iter().sum::<f64>() / skill.len() as f64
    };
    let fit = checkpoint.description.training.linear_fit;
    Ok(RolloutLoss { model: loss(0), linear_fit: fit.map(|_| loss(1 + Baseline::ALL.len())) })
}

/// Rolls out over every stream; each thread has one stream in memory at a time.
pub(super) fn validate(
    config: &ValidationConfig,
    surrogate: &Surrogate,
    streams: &[Trajectory],
) -> Result<Score, TrainError> {
    let settings = Settings::errors_only(config.horizon, config.starts);
    let scenes = roll_out(settings, surrogate, streams, streams)?;
    let skill = mean_skill(&scenes, 0, config.horizon);
    let end = |skill: Option<&f64>| skill.copied().unwrap_or(f64::NAN);
    let (first_skill, last_skill) = (end(skill.first()), end(skill.last()));
    // A diverged rollout repeats its last finite frame; it must lose against any finite one.
    let diverged = scenes.iter().any(|scene| scene.accumulators[0].blow_ups.diverged > 0);
    let mean = skill.iter().sum::<f64>() / skill.len() as f64;
    let loss = if mean.is_finite() && !diverged { 1.0 - mean } else { f64::INFINITY };
    Ok(Score { loss, first_skill, last_skill })
}

/// Skill of a checkpoint on the test part of the data set that it was trained on, one number per frame ahead: the same
/// number as `eddy eval` reports for this checkpoint and data. `None` without a test stream that is long enough.
///
/// # Errors
/// [`TrainError`] when a stream cannot be read or predicted.
pub fn test_skill(
    checkpoint: &Checkpoint,
    dataset: &Dataset,
    horizon: usize,
) -> Result<Option<Vec<f64>>, TrainError> {
    let settings = Settings::errors_only(horizon, DEFAULT_STARTS);
    let warm_up = checkpoint.description.warm_up as usize;
    if dataset.test.iter().all(|stream| starts(stream.frames, warm_up, settings).is_empty()) {
        return Ok(None);
    }
    let all: Vec<Trajectory> = [&dataset.train, &dataset.validation, &dataset.test]
        .into_iter()
        .flatten()
        .cloned()
        .collect();
    let surrogate = one_thread(checkpoint)?;
    let scenes = roll_out(settings, &surrogate, &dataset.test, &all)?;
    Ok(Some(mean_skill(&scenes, 0, horizon)))
}

/// The results of the model, of every baseline, and of the linear fit, if there is one, over `streams`. The walls of baselines are those of `all` streams.
fn roll_out(
    settings: Settings,
    surrogate: &Surrogate,
    streams: &[Trajectory],
    all: &[Trajectory],
) -> Result<Vec<SceneResult>, TrainError> {
    let context = context(settings, surrogate.description(), all);
    context.check(longest(streams)).map_err(TrainError::Validation)?;
    let fit = context.linear_fit.map(Predictor::LinearFit);
    let simple: Vec<_> = Baseline::ALL.map(Predictor::Baseline).into_iter().chain(fit).collect();
    let scenes = streams.par_iter().map(|stream| {
        let model = Predictor::Model(surrogate);
        let predictors: Vec<_> = std::iter::once(model).chain(simple.iter().copied()).collect();
        let whole = stream.cut(0..stream.frames)?;
        evaluate_scene(&context, &predictors, &whole, None).map_err(TrainError::Validation)
    });
    scenes.collect()
}

/// A model for rollouts of streams side by side: one thread for each stream is more efficient than several for each frame.
pub(super) fn one_thread(checkpoint: &Checkpoint) -> Result<Surrogate, TrainError> {
    Ok(Surrogate::load(checkpoint, NonZeroUsize::new(1))?)
}

/// Skill of a predictor, averaged over kinds of scenes. The model is number 0.
fn mean_skill(scenes: &[SceneResult], predictor: usize, horizon: usize) -> Vec<f64> {
    Skills::of(scenes, 1..1 + Baseline::ALL.len(), horizon).mean(predictor)
}

/// The context of the comparison, without measures that use the spacing of particles.
fn context(settings: Settings, description: &Description, streams: &[Trajectory]) -> Context {
    let mut walls = Bounds::default();
    streams.iter().for_each(|stream| walls.join(&stream.bounds));
    let warm_up = description.warm_up as usize;
    Context::new(settings, description, warm_up, description.domain, walls, f32::INFINITY)
}

/// Rejects streams that are all too short for a rollout, before training starts.
pub(super) fn check(
    config: &ValidationConfig,
    warm_up: usize,
    streams: &[Trajectory],
) -> Result<(), TrainError> {
    let settings = Settings::errors_only(config.horizon, config.starts);
    if streams.iter().any(|stream| !starts(stream.frames, warm_up, settings).is_empty()) {
        return Ok(());
    }
    let (found, horizon) = (longest(streams), config.horizon);
    let expected = warm_up + horizon;
    Err(TrainError::Validation(EvalError::TooShort { found, expected, warm_up, horizon }))
}

fn longest(streams: &[Trajectory]) -> usize {
    streams.iter().map(|stream| stream.frames).max().unwrap_or(0)
}
