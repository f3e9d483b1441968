//! The rollouts that every predictor of a scene makes.

use super::{measure::Flights, steps::StepObserver};
use eddy_dataset::Stream;
use eddy_mpm::Scene;

/// Rollouts of one stream.
#[derive(Clone, Copy)]
pub(super) struct RolloutTask<'a> {
    pub(super) stream: &'a Stream,
    /// The scene that the stream was simulated from.
    pub(super) scene: Option<&'a Scene>,
    /// The frames that rollouts start from.
    pub(super) starts: &'a [usize],
    /// Bodies in free flight in the stream.
    pub(super) flights: &'a Flights,
    /// Frames ahead that are compared with the truth.
    pub(super) horizon: usize,
    /// Length of a rollout (frames).
    pub(super) reach: usize,
}

impl<'a> RolloutTask<'a> {
    /// Accumulates one-step predictions along the stream.
    pub(super) fn observer(&self) -> StepObserver<'a> {
        StepObserver::new(self.stream, self.starts, self.flights, self.horizon)
    }
}
