//! Rollouts that blew up, and those that ended far off.

use serde::{Deserialize, Serialize};

use super::bulk::kinetic_energy;
use crate::{
    Arena, Baseline, Rollout,
    dataset::{State, Stream},
    errors::mean_squared_distance,
};

/// The frame ahead at which positions are compared.
const COMPARED: usize = 100;
/// How many times the position error of the best trivial predictor is far off.
const FAR_OFF: f64 = 4.0;
/// A trivial predictor counts as wrong by at least so many spacings: it is exact where nothing moves.
const LEAST_ERROR: f64 = 0.5;
/// How many times the kinetic energy of the liveliest true frame of the stream is too much.
const TOO_LIVELY: f64 = 3.0;

/// Rollouts that blew up, and by which sign; one rollout may show both. Beside them those that kept their calm but ended far off.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct BlowUps {
    /// Rollouts that diverged or were too lively.
    pub any: usize,
    /// A prediction was not finite, or there was none. Such rollouts are not left out elsewhere: their
    /// last finite frame counts as the prediction.
    pub diverged: usize,
    /// In a frame the mean kinetic energy per mass is more than three times that of the liveliest true
    /// frame of the same stream, which counts as g times the spacing at least.
    pub too_lively: usize,
    /// The position error (RMSE) at frame 100, or at the last frame that is compared, is more than four
    /// times that of the best trivial predictor there, which counts as half a spacing at least.
    pub far_off: usize,
}

impl BlowUps {
    /// Adds those of other rollouts.
    pub fn merge(&mut self, other: &Self) {
        self.any += other.any;
        self.diverged += other.diverged;
        self.far_off += other.far_off;
        self.too_lively += other.too_lively;
    }
}

/// Mean kinetic energy per mass (domain lengths^2 per s^2) above which a rollout in a stream is too lively.
pub(crate) fn most_energy(arena: &Arena, stream: &Stream) -> f64 {
    let [x, y] = arena.ballistic.gravity.map(f64::from);
    let least = x.hypot(y) * f64::from(arena.spacing);
    let energies = stream.states.iter().map(|state| kinetic_energy(&state.velocity));
    TOO_LIVELY * energies.fold(least, f64::max)
}

/// What the rollouts of one window may come to.
pub(super) struct Tolerance {
    /// Frames ahead at which positions are compared.
    ahead: usize,
    /// Largest mean squared position error there (domain lengths^2).
    squared_error: f64,
    /// Largest mean kinetic energy per mass of any frame (domain lengths^2 per s^2).
    kinetic_energy: f64,
}

impl Tolerance {
    /// For rollouts from the state `observed`, whose true future is `truth`, one state or more.
    pub(super) fn new(arena: &Arena, observed: &State, truth: &[State], most_energy: f64) -> Self {
        let ahead = COMPARED.min(truth.len());
        let error = |baseline: Baseline| {
            let mut state = observed.clone();
            (0..ahead).for_each(|_| baseline.step(&mut state, &arena.ballistic));
            mean_squared_distance(&state.position, &truth[ahead - 1].position)
        };
        let best = Baseline::ALL.map(error).into_iter().fold(f64::INFINITY, f64::min);
        let least = LEAST_ERROR * f64::from(arena.spacing);
        let squared_error = FAR_OFF * FAR_OFF * best.max(least * least);
        Self { ahead, squared_error, kinetic_energy: most_energy }
    }

    /// Counts a rollout of at least as many frames as are compared; `truth` as in [`Tolerance::new`].
    pub(super) fn count(&self, rollout: &Rollout, truth: &[State], sums: &mut BlowUps) {
        let [found, expected] = [&rollout.states, truth].map(|states| &states[self.ahead - 1]);
        let error = mean_squared_distance(&found.position, &expected.position);
        let lively = |state: &State| kinetic_energy(&state.velocity) > self.kinetic_energy;
        let [diverged, far_off, too_lively] =
            [rollout.diverged, error > self.squared_error, rollout.states.iter().any(lively)];
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

    const TOLERANCE: Tolerance = Tolerance { ahead: 2, squared_error: 0.25, kinetic_energy: 3.0 };

    /// Four particles that are `distance` away from the origin and have a speed.
    fn state(distance: f32, speed: f32) -> State {
        State { position: vec![[distance, 0.0]; 4], velocity: vec![[0.0, speed]; 4] }
    }

    /// Blown up, diverged, far off, too lively.
    fn count(states: [State; 3], diverged: bool) -> [usize; 4] {
        let truth = [state(0.0, 0.0), state(0.0, 0.0)];
        let mut sums = BlowUps::default();
        let rollout = Rollout { states: states.to_vec(), diverged };
        TOLERANCE.count(&rollout, &truth, &mut sums);
        [sums.any, sums.diverged, sums.far_off, sums.too_lively]
    }

    #[test]
    fn positions_count_at_one_frame_and_energy_in_all() {
        let calm = |distance| state(distance, 0.0);
        assert_eq!(count([calm(9.0), calm(0.5), calm(9.0)], false), [0; 4]);
        assert_eq!(count([calm(0.0), calm(0.51), calm(0.0)], false), [0, 0, 1, 0]);
        assert_eq!(count([calm(0.0), calm(0.0), state(0.0, 2.4)], false), [0; 4]);
        assert_eq!(count([calm(0.0), calm(0.0), state(0.0, 2.5)], false), [1, 0, 0, 1]);
    }

    #[test]
    fn a_rollout_with_several_signs_blew_up_once() {
        assert_eq!(count([state(1.0, 3.0), state(1.0, 0.0), state(1.0, 0.0)], true), [1; 4]);
    }
}
