//! How good a network is on streams it is not fitted to: free rollouts against trivial predictors.

use super::{TrainError, ValidationConfig};
use crate::{
    checkpoint::Checkpoint,
    dataset::Stream,
    engine::Surrogate,
    eval::{EvalError, Report, Settings, judge},
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
    streams: &[Stream],
) -> Result<Score, TrainError> {
    let surrogate = Surrogate::load(checkpoint, None)?;
    let settings = Settings { horizon: config.horizon, starts: config.starts };
    let judgement = judge(&surrogate, streams, settings, || {}).map_err(TrainError::Validation)?;
    let name = String::new();
    let dt = checkpoint.description.dt;
    let report = Report::new(name.clone(), name.clone(), name, streams.len(), dt, &judgement);
    let skill: Vec<f64> =
        (1..=config.horizon).filter_map(|ahead| report.mean_skill(ahead)).collect();
    let (Some(&first_skill), Some(&last_skill)) = (skill.first(), skill.last()) else {
        let warm_up = checkpoint.description.warm_up as usize;
        let expected = warm_up + config.horizon;
        let horizon = config.horizon;
        let short = EvalError::TooShort { found: 0, expected, warm_up, horizon };
        return Err(TrainError::Validation(short));
    };
    // A rollout that diverged has no finite error; it must lose against any that has.
    let mean = skill.iter().sum::<f64>() / skill.len() as f64;
    let loss = if mean.is_finite() { 1.0 - mean } else { f64::INFINITY };
    Ok(Score { loss, first_skill, last_skill })
}
