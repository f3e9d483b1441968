//! Validation: free rollouts over streams that are not trained on, compared with trivial predictors.

use std::num::NonZeroUsize;

use rayon::prelude::*;

use super::{TrainError, ValidationConfig};
use eddy_evaluation::{
    Baseline, Context, EvalError, Predictor, Settings, Skills,
    dataset::{Bounds, Trajectory},
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

/// Rolls out over every stream; each thread has one stream in memory at a time.
pub(super) fn validate(
    config: &ValidationConfig,
    checkpoint: &Checkpoint,
    streams: &[Trajectory],
) -> Result<Score, TrainError> {
    // One thread per stream, which is more efficient than several threads per frame.
    let surrogate = Surrogate::load(checkpoint, NonZeroUsize::new(1))?;
    let context = context(config, &checkpoint.description, streams);
    context.check(longest(streams)).map_err(TrainError::Validation)?;
    let baselines = Baseline::ALL.map(Predictor::Baseline);
    let predictors = 1 + baselines.len();
    let scenes = streams.par_iter().map(|stream| {
        let model = Predictor::Model(&surrogate);
        let predictors: Vec<_> = std::iter::once(model).chain(baselines).collect();
        let whole = stream.cut(0..stream.frames)?;
        evaluate_scene(&context, &predictors, &whole, None).map_err(TrainError::Validation)
    });
    let scenes = scenes.collect::<Result<Vec<_>, TrainError>>()?;
    let skill = Skills::of(&scenes, 1..predictors, config.horizon).mean(0);
    let end = |skill: Option<&f64>| skill.copied().unwrap_or(f64::NAN);
    let (first_skill, last_skill) = (end(skill.first()), end(skill.last()));
    // A diverged rollout repeats its last finite frame; it must lose against any finite one.
    let diverged = scenes.iter().any(|scene| scene.accumulators[0].blow_ups.diverged > 0);
    let mean = skill.iter().sum::<f64>() / skill.len() as f64;
    let loss = if mean.is_finite() && !diverged { 1.0 - mean } else { f64::INFINITY };
    Ok(Score { loss, first_skill, last_skill })
}

/// The context of the comparison, without measures that use the spacing of particles.
fn context(
    config: &ValidationConfig,
    description: &Description,
    streams: &[Trajectory],
) -> Context {
    let settings = Settings::errors_only(config.horizon, config.starts);
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
