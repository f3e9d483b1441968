//! How good a network is on streams it is not fitted to: free rollouts against trivial predictors.

use super::{TrainError, ValidationConfig};
use crate::{
    checkpoint::Checkpoint,
    dataset::{Bounds, Trajectory},
    engine::Surrogate,
    eval::{EvalError, Judge, Report, Settings, starts},
};

/// What free rollouts came to.
#[derive(Clone, Copy, Debug)]
pub(super) struct Score {
    /// 1 - skill, averaged over materials and frames ahead; what the best epoch is chosen by.
    pub(super) loss: f64,
    /// Skill one frame ahead, averaged over materials.
    pub(super) first_skill: f64,
    /// Skill at the last frame.
    pub(super) last_skill: f64,
}

/// Rolls out over every stream.
pub(super) fn validate(
    config: &ValidationConfig,
    checkpoint: &Checkpoint,
    streams: &[Trajectory],
) -> Result<Score, TrainError> {
    let surrogate = Surrogate::load(checkpoint, None)?;
    let settings = Settings { horizon: config.horizon, starts: config.starts };
    let mut walls = Bounds::default();
    streams.iter().for_each(|stream| walls.join(&stream.bounds));
    let mut judge = Judge::new(&surrogate, settings, walls);
    let warm_up = judge.warm_up();
    for stream in streams {
        for start in judge.starts(stream.frames) {
            let window = stream.cut(start + 1 - warm_up..start + 1 + config.horizon)?;
            judge.window(&window, warm_up - 1).map_err(TrainError::Validation)?;
        }
    }
    let judgement = judge.finish(longest(streams)).map_err(TrainError::Validation)?;
    let name = String::new();
    let dt = checkpoint.description.dt;
    let report = Report::new(name.clone(), name.clone(), name, streams.len(), dt, &judgement);
    let skill: Vec<f64> =
        (1..=config.horizon).filter_map(|ahead| report.mean_skill(ahead)).collect();
    let end = |skill: Option<&f64>| skill.copied().unwrap_or(f64::NAN);
    let (first_skill, last_skill) = (end(skill.first()), end(skill.last()));
    // A rollout that diverged has no finite error; it must lose against any that has.
    let mean = skill.iter().sum::<f64>() / skill.len() as f64;
    let loss = if mean.is_finite() { 1.0 - mean } else { f64::INFINITY };
    Ok(Score { loss, first_skill, last_skill })
}

/// Refuses streams that are all too short for one rollout, before a network is fitted for nothing.
pub(super) fn check(
    config: &ValidationConfig,
    warm_up: usize,
    streams: &[Trajectory],
) -> Result<(), TrainError> {
    let settings = Settings { horizon: config.horizon, starts: config.starts };
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
