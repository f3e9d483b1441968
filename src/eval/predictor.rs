//! Whatever predicts: models, baselines, rivals, and the truth itself.

use super::{
    Arena, Baseline, EvalError, Restart, Rollout, chaos,
    measure::VelocityLimits,
    rollout::{roll_out_from_first, roll_out_joined_late},
    steps::{Follower, StepSums},
};
use crate::{
    checkpoint::Architecture,
    dataset::{State, Stream},
    engine::{ModelError, Surrogate},
    model::particle_model::velocity_limits,
    mpm::{MpmError, Scene},
};

/// Whatever predicts.
#[derive(Clone, Copy)]
pub enum Predictor<'a> {
    /// A model that has observed the stream from its first frame on.
    Model(&'a Surrogate),
    /// A model that joined the stream in the middle: it has seen its warm-up.
    JoinedLate(&'a Surrogate),
    /// What learns nothing.
    Baseline(Baseline),
    /// The solver, restarted.
    Restart(Restart),
    /// The truth, slightly displaced.
    Chaos,
    /// The truth: what measures give for it is what they are to be compared with.
    Truth,
}

/// What a predictor does.
pub(super) struct Predicting<'a> {
    pub(super) arena: &'a Arena,
    pub(super) stream: &'a Stream,
    /// What the stream was simulated from.
    pub(super) scene: Option<&'a Scene>,
    /// The frames that rollouts start from.
    pub(super) starts: &'a [usize],
}

impl Predictor<'_> {
    /// Rolls out from every start. `each` gets the number of the start and its rollout; what is
    /// returned are the errors of next frames, where they are predicted on the way.
    pub(super) fn roll_out(
        &self,
        what: &Predicting<'_>,
        each: &mut dyn FnMut(usize, Rollout),
    ) -> Result<Option<StepSums>, EvalError> {
        let Predicting { arena, stream, starts, .. } = *what;
        let (horizon, reach) = (arena.settings.horizon, arena.settings.reach);
        let of_model = |reason: ModelError| EvalError::Model { stream: stream.id, reason };
        let of_rival = |reason: MpmError| EvalError::Rival { stream: stream.id, reason };
        let scene = || what.scene.ok_or(EvalError::NoScene { stream: stream.id });
        match *self {
            Self::Model(surrogate) => {
                roll_out_from_first(surrogate, stream, starts, (horizon, reach), each)
                    .map(Some)
                    .map_err(of_model)
            }
            Self::JoinedLate(surrogate) => {
                roll_out_joined_late(surrogate, stream, starts, reach, each).map_err(of_model)?;
                Ok(None)
            }
            Self::Baseline(baseline) => Ok(Some(roll_out_baseline(baseline, what, each))),
            Self::Restart(restart) => {
                restart.roll_out(scene()?, stream, starts, reach, each).map_err(of_rival)?;
                Ok(None)
            }
            Self::Chaos => {
                chaos::roll_out(scene()?, stream, starts, reach, each).map_err(of_rival)?;
                Ok(None)
            }
            Self::Truth => {
                for (number, &start) in starts.iter().enumerate() {
                    let mut after = stream.states[start + 1..].iter();
                    let mut last = &stream.states[start];
                    let next = || {
                        last = after.next().unwrap_or(last);
                        Some(last.clone())
                    };
                    each(number, Rollout::collect(&stream.states[start], reach, next));
                }
                Ok(None)
            }
        }
    }

    /// The velocities beyond which it cannot predict.
    pub(super) fn velocity_limits(&self) -> Option<VelocityLimits> {
        match self {
            Self::Model(surrogate) | Self::JoinedLate(surrogate) => {
                let description = surrogate.description();
                (description.architecture == Architecture::Particle)
                    .then(|| velocity_limits(&description.normalization))
            }
            _ => None,
        }
    }
}

fn roll_out_baseline(
    baseline: Baseline,
    what: &Predicting<'_>,
    each: &mut dyn FnMut(usize, Rollout),
) -> StepSums {
    let Predicting { arena, stream, starts, .. } = *what;
    let (horizon, reach) = (arena.settings.horizon, arena.settings.reach);
    let ahead = |state: &State, frames| baseline.roll_out(state, frames, &arena.ballistic);
    for (number, &start) in starts.iter().enumerate() {
        let states = ahead(&stream.states[start], reach);
        each(number, Rollout { states, diverged: false });
    }
    let mut follower = Follower::new(starts, horizon);
    for (index, pair) in stream.states.windows(2).enumerate() {
        if let [last, truth] = pair {
            let predicted = ahead(last, 1);
            follower.add(index + 1, &predicted[0].position, last, truth);
        }
    }
    follower.finish()
}
