//! Validation: free rollouts over streams that are not trained on, compared with trivial predictors.

use std::num::NonZeroUsize;

use rayon::{ThreadPoolBuilder, prelude::*};

use super::{Observed, TrainError, ValidationConfig};
use eddy_dataset::{Bounds, Dataset, Trajectory};
use eddy_evaluation::{
    Context, DEFAULT_STARTS, EvalError, LinearFit, Predictor, SceneResult, Settings, Skills,
    evaluate_scene, rollout_threads, starts,
};
use eddy_inference::engine::Baseline;
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

/// The validation loss of a model on any streams, seen in training or not: 1 - skill, averaged over kinds of scenes and
/// frames ahead.
///
/// # Errors
/// [`TrainError`] when a stream cannot be read or predicted, or all are too short.
pub fn rollout_loss(
    surrogate: &Surrogate,
    config: &ValidationConfig,
    streams: &[Trajectory],
) -> Result<f64, TrainError> {
    Ok(validate(config, surrogate, streams)?.loss)
}

/// The validation loss of the linear fit to a checkpoint's training data; `None` if it has none.
///
/// # Errors
/// As [`rollout_loss`].
pub fn linear_fit_loss(
    description: &Description,
    config: &ValidationConfig,
    streams: &[Trajectory],
) -> Result<Option<f64>, TrainError> {
    let Some(fit) = description.training.linear_fit else { return Ok(None) };
    let settings = Settings::errors_only(config.horizon, config.starts);
    let context = context(settings, description, streams);
    let fit = Predictor::LinearFit(LinearFit { rows: fit });
    let scenes = roll_out(&context, fit, None, streams)?;
    Ok(Some(loss(&scenes, &mean_skill(&scenes, config.horizon))))
}

/// Rolls out over every stream; each thread has one stream in memory at a time.
pub(super) fn validate(
    config: &ValidationConfig,
    surrogate: &Surrogate,
    streams: &[Trajectory],
) -> Result<Score, TrainError> {
    let settings = Settings::errors_only(config.horizon, config.starts);
    let context = context(settings, surrogate.description(), streams);
    let predictor = match config.observed {
        Observed::Stream => Predictor::Model(surrogate),
        Observed::Window => Predictor::JoinedLate(surrogate),
    };
    let scenes = roll_out(&context, predictor, Some(surrogate), streams)?;
    let skill = mean_skill(&scenes, config.horizon);
    let end = |skill: Option<&f64>| skill.copied().unwrap_or(f64::NAN);
    let (first_skill, last_skill) = (end(skill.first()), end(skill.last()));
    Ok(Score { loss: loss(&scenes, &skill), first_skill, last_skill })
}

/// 1 - the mean of the skills; infinite where a rollout diverged, since it repeats its last finite frame and must lose against
/// any finite one.
fn loss(scenes: &[SceneResult], skill: &[f64]) -> f64 {
    let diverged = scenes.iter().any(|scene| scene.accumulators[0].blow_ups.diverged > 0);
    let mean = skill.iter().sum::<f64>() / skill.len() as f64;
    if mean.is_finite() && !diverged { 1.0 - mean } else { f64::INFINITY }
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
    let context = context(settings, &checkpoint.description, &all);
    let model = Predictor::Model(&surrogate);
    let scenes = roll_out(&context, model, Some(&surrogate), &dataset.test)?;
    Ok(Some(mean_skill(&scenes, horizon)))
}

/// The results of a predictor, number 0, and of every baseline.
fn roll_out(
    context: &Context,
    predictor: Predictor<'_>,
    model: Option<&Surrogate>,
    streams: &[Trajectory],
) -> Result<Vec<SceneResult>, TrainError> {
    context.check(longest(streams)).map_err(TrainError::Validation)?;
    // Without tools, none is carried.
    let baselines = Baseline::WITH_TOOLS.map(Predictor::Baseline);
    let predictors: Vec<_> = std::iter::once(predictor).chain(baselines).collect();
    let evaluate = |stream: &Trajectory| {
        let whole = stream.cut(0..stream.frames)?;
        evaluate_scene(context, &predictors, &whole, None).map_err(TrainError::Validation)
    };
    let all = || streams.par_iter().with_max_len(1).map(evaluate).collect();
    let threads = rollout_threads(model, streams);
    if threads <= rayon::current_num_threads() {
        return all();
    }
    let pool = ThreadPoolBuilder::new().num_threads(threads).build();
    pool.map_err(TrainError::Threads)?.install(all)
}

/// A model for rollouts of streams side by side: one thread for each stream is more efficient than several for each frame.
pub(super) fn one_thread(checkpoint: &Checkpoint) -> Result<Surrogate, TrainError> {
    Ok(Surrogate::load(checkpoint, NonZeroUsize::new(1))?)
}

/// Skill of predictor 0, averaged over kinds of scenes.
fn mean_skill(scenes: &[SceneResult], horizon: usize) -> Vec<f64> {
    Skills::of(scenes, 1..1 + Baseline::WITH_TOOLS.len(), horizon).mean(0)
}

/// The context of the comparison, without measures that use the spacing of particles. The walls of baselines are those of
/// `streams`.
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
