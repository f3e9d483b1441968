//! Rollouts that blew up, and rollouts that ended far from the truth.

use serde::{Deserialize, Serialize};

use super::bulk::kinetic_energy;
use crate::{Context, Rollout};
use eddy_dataset::Stream;
use eddy_frames::{State, mean_squared_distance};
use eddy_inference::engine::Baseline;

/// The frame ahead at which positions are compared.
const COMPARED: usize = 100;
/// Multiple of the best trivial predictor's position error above which a rollout is far off.
const FAR_OFF: f64 = 4.0;
/// Lower bound of the trivial predictor's error (spacings): it is exact where nothing moves.
const MIN_ERROR: f64 = 0.5;
/// Multiple of the maximum true kinetic energy of the stream above which a rollout has blown up.
const MAX_ENERGY_RATIO: f64 = 3.0;

/// Rollouts that blew up, by criterion (a rollout may meet both), and rollouts that ended far from the truth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct BlowUps {
    /// Rollouts that diverged or had too much kinetic energy.
    pub any: usize,
    /// Rollouts with a prediction that is missing or not finite. In other metrics their last finite frame counts as
    /// the prediction.
    pub diverged: usize,
    /// Rollouts with a frame whose mean kinetic energy per mass is more than three times the maximum over the true
    /// frames of the stream (at least g times the spacing).
    pub too_lively: usize,
    /// Rollouts whose position RMSE at frame 100, or at the last compared frame, is more than four times that of the
    /// best trivial predictor there (at least half a spacing).
    pub far_off: usize,
}

impl BlowUps {
    /// Adds the counts of other rollouts.
    pub fn merge(&mut self, other: &Self) {
        self.any += other.any;
        self.diverged += other.diverged;
        self.far_off += other.far_off;
        self.too_lively += other.too_lively;
    }
}

/// Mean kinetic energy per mass (domain lengths^2 per s^2) above which a rollout in a stream has blown up.
pub(crate) fn energy_limit(context: &Context, stream: &Stream) -> f64 {
    let [x, y] = context.ballistic.gravity.map(f64::from);
    let least = x.hypot(y) * f64::from(context.spacing);
    let energies = stream.states.iter().map(|state| kinetic_energy(&state.velocity));
    MAX_ENERGY_RATIO * energies.fold(least, f64::max)
}

/// Limits for the rollouts of one window.
pub(super) struct Limits {
    /// Frames ahead at which positions are compared.
    ahead: usize,
    /// Maximum mean squared position error there (domain lengths^2).
    squared_error: f64,
    /// Maximum mean kinetic energy per mass of any frame (domain lengths^2 per s^2).
    kinetic_energy: f64,
}

impl Limits {
    /// For rollouts from frame `start` of a stream, with the true states `truth` (at least one) after it.
    pub(super) fn new(
        context: &Context,
        stream: &Stream,
        start: usize,
        truth: &[State],
        energy_limit: f64,
    ) -> Self {
        let ahead = COMPARED.min(truth.len());
        let error = |baseline: &Baseline| {
            let mut state = stream.states[start].clone();
            for frame in start..start + ahead {
                let sweep = stream.sweep(frame);
                baseline.step(&mut state, &context.ballistic, sweep.as_ref());
            }
            mean_squared_distance(&state.position, &truth[ahead - 1].position)
        };
        let best = context.baselines().iter().map(error).fold(f64::INFINITY, f64::min);
        let least = MIN_ERROR * f64::from(context.spacing);
        let squared_error = FAR_OFF * FAR_OFF * best.max(least * least);
        Self { ahead, squared_error, kinetic_energy: energy_limit }
    }

    /// Counts a rollout at least as long as the compared frames; `truth` as in [`Limits::new`].
    pub(super) fn count(&self, rollout: &Rollout, truth: &[State], sums: &mut BlowUps) {
        let [found, expected] = [&rollout.states, truth].map(|states| &states[self.ahead - 1]);
        let error = mean_squared_distance(&found.position, &expected.position);
        let too_much = |state: &State| kinetic_energy(&state.velocity) > self.kinetic_energy;
        let [diverged, far_off, too_lively] =
            [rollout.diverged, error > self.squared_error, rollout.states.iter().any(too_much)];
        sums.merge(&BlowUps {
            any: usize::from(diverged || too_lively),
            diverged: diverged.into(),
            far_off: far_off.into(),
            too_lively: too_lively.into(),
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: Limits = Limits { ahead: 2, squared_error: 0.25, kinetic_energy: 3.0 };

    /// Four particles at a `distance` from the origin, with the same speed.
    fn state(distance: f32, speed: f32) -> State {
        State { position: vec![[distance, 0.0]; 4], velocity: vec![[0.0, speed]; 4] }
    }

    /// Counts of `any`, `diverged`, `far_off`, `too_lively`.
    fn count(states: [State; 3], diverged: bool) -> [usize; 4] {
        let truth = [state(0.0, 0.0), state(0.0, 0.0)];
        let mut sums = BlowUps::default();
        let rollout = Rollout { states: states.to_vec(), diverged };
        LIMITS.count(&rollout, &truth, &mut sums);
        [sums.any, sums.diverged, sums.far_off, sums.too_lively]
    }

    #[test]
    fn positions_are_checked_at_one_frame_and_energy_in_all() {
        let calm = |distance| state(distance, 0.0);
        assert_eq!(count([calm(9.0), calm(0.5), calm(9.0)], false), [0; 4]);
        assert_eq!(count([calm(0.0), calm(0.51), calm(0.0)], false), [0, 0, 1, 0]);
        assert_eq!(count([calm(0.0), calm(0.0), state(0.0, 2.4)], false), [0; 4]);
        assert_eq!(count([calm(0.0), calm(0.0), state(0.0, 2.5)], false), [1, 0, 0, 1]);
    }

    #[test]
    fn a_rollout_that_meets_several_criteria_blew_up_once() {
        assert_eq!(count([state(1.0, 3.0), state(1.0, 0.0), state(1.0, 0.0)], true), [1; 4]);
    }
}
