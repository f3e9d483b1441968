//! A part of the run with a constant length of unroll: the sampler of its windows, and the scale of its errors.

use super::{
    LossKind, Setup, TrainError,
    loss_weights::{CommonSums, LossScale, TrivialErrors},
    sampler,
    state::RunState,
    steps::Learner,
    window::Sampler,
};
use eddy_inference::engine::Ballistic;

/// Windows over which trivial errors are averaged at the start of a stage.
const COMMON_WINDOWS: usize = 512;
/// Number of these that are in memory at the same time.
const COMMON_GROUP: usize = 32;

/// What the batches of a stage are made with.
pub(super) struct Stage<'a> {
    /// Frames that are predicted freely.
    pub(super) unroll: usize,
    pub(super) sampler: Sampler<'a>,
    pub(super) scale: LossScale<'a>,
}

impl<'a> Stage<'a> {
    /// Begins a stage, and hands the weights of the state to what takes its steps. A run that resumes within a stage has its
    /// trivial errors already; a new stage draws windows for them.
    pub(super) fn begin(
        setup: &Setup<'a>,
        unroll: usize,
        state: &mut RunState,
        learner: &mut Learner,
    ) -> Result<Self, TrainError> {
        let Setup { config, dataset, description, .. } = *setup;
        let sampler = sampler(config, dataset, unroll)?;
        let ballistic = Ballistic::new(description);
        if unroll != state.unroll {
            learner.sync(state)?;
            state.unroll = unroll;
            state.common = trivial_errors(setup, &ballistic, state)?;
        }
        let scale = LossScale {
            loss: &config.loss,
            noise: &config.windows.noise,
            normalization: &description.normalization,
            ballistic,
            common: state.common.clone(),
        };
        learner.begin(&setup.task(&scale), state)?;
        Ok(Self { unroll, sampler, scale })
    }
}

/// Errors of the best trivial predictor over many windows; empty if the loss does not use them.
fn trivial_errors(
    setup: &Setup<'_>,
    ballistic: &Ballistic,
    state: &mut RunState,
) -> Result<TrivialErrors, TrainError> {
    let Setup { config, dataset, .. } = *setup;
    if config.loss.kind == LossKind::Mse {
        return Ok(Vec::new());
    }
    let mut sums = CommonSums::new(state.unroll, config.network.stiffness);
    // Of all stiffnesses, also if batches are not.
    let sampler = Sampler::new(&dataset.train, &config.windows, state.unroll)?;
    for _ in 0..COMMON_WINDOWS / COMMON_GROUP {
        for window in sampler.draw(COMMON_GROUP, &mut state.order)? {
            sums.add(&window, ballistic);
        }
    }
    Ok(sums.best())
}
