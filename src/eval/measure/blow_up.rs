//! Rollouts that blew up.

use super::bulk::kinetic_energy;
use crate::{dataset::State, frame::Domain};

/// How much faster than the fastest true particle is too fast, and how much more kinetic energy than
/// any true frame has is too much.
const TOO_MUCH: f64 = 3.0;
/// Share of the particles that may be too fast, at the model's limit or outside.
const TOLERATED: f64 = 0.01;
/// A velocity this close to a limit is at it, as a share of the limits' range.
const AT_LIMIT: f32 = 1e-3;

/// What the truth of a data set never exceeds.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Extremes {
    /// Largest speed of a particle (domain lengths per second).
    pub speed: f64,
    /// Largest mean kinetic energy per mass of a frame (domain lengths^2 per s^2).
    pub kinetic_energy: f64,
}

impl Extremes {
    /// Makes room for a true state.
    pub fn widen(&mut self, state: &State) {
        let speed = |v: &[f32; 2]| f64::from(v[0]).hypot(f64::from(v[1]));
        self.speed = state.velocity.iter().map(speed).fold(self.speed, f64::max);
        self.kinetic_energy = self.kinetic_energy.max(kinetic_energy(&state.velocity));
    }
}

/// Smallest and largest velocities that a model can predict, by axis (domain lengths per second).
pub(in crate::eval) type VelocityLimits = ([f32; 2], [f32; 2]);

/// Whether a predicted state is none that the truth could come near: more than 1 % of the particles
/// are faster than three times the fastest true one, or at the limit of what the model can predict,
/// or outside the domain; or the kinetic energy is more than three times the largest of any true frame.
pub(in crate::eval) fn is_blown_up(
    state: &State,
    extremes: &Extremes,
    limits: Option<VelocityLimits>,
    domain: Domain,
) -> bool {
    let too_fast =
        |v: &[f32; 2]| f64::from(v[0]).hypot(f64::from(v[1])) > TOO_MUCH * extremes.speed;
    let at_limit = |v: &[f32; 2]| {
        limits.is_some_and(|(least, most)| {
            (0..2).any(|axis| {
                let close = AT_LIMIT * (most[axis] - least[axis]);
                v[axis] <= least[axis] + close || v[axis] >= most[axis] - close
            })
        })
    };
    let outside = |x: &[f32; 2]| {
        (0..2).any(|axis| x[axis] < domain.lower[axis] || x[axis] > domain.upper[axis])
    };
    let most = TOLERATED * state.position.len() as f64;
    let too_many = |count: usize| count as f64 > most;
    too_many(state.velocity.iter().filter(|v| too_fast(v)).count())
        || too_many(state.velocity.iter().filter(|v| at_limit(v)).count())
        || too_many(state.position.iter().filter(|x| outside(x)).count())
        || kinetic_energy(&state.velocity) > TOO_MUCH * extremes.kinetic_energy
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXTREMES: Extremes = Extremes { speed: 2.0, kinetic_energy: 1.0 };
    const LIMITS: VelocityLimits = ([-5.0; 2], [5.0; 2]);

    /// A hundred particles that rest in the middle, but some that are elsewhere and fly.
    fn state(some: usize, position: [f32; 2], velocity: [f32; 2]) -> State {
        let mut state = State { position: vec![[0.5; 2]; 100], velocity: vec![[0.0; 2]; 100] };
        state.position[..some].fill(position);
        state.velocity[..some].fill(velocity);
        state
    }

    fn blown_up(state: &State) -> bool {
        is_blown_up(state, &EXTREMES, Some(LIMITS), Domain::UNIT)
    }

    #[test]
    fn one_in_a_hundred_may_be_wild_two_may_not() {
        let middle = [0.5; 2];
        for (position, velocity) in
            [(middle, [0.0, 6.1]), (middle, [-4.999, 0.0]), ([0.5, -0.01], [0.0; 2])]
        {
            assert!(!blown_up(&state(1, position, velocity)), "{position:?} {velocity:?}");
            assert!(blown_up(&state(2, position, velocity)), "{position:?} {velocity:?}");
        }
    }

    #[test]
    fn three_times_the_energy_of_the_liveliest_frame_is_a_blow_up() {
        assert!(!blown_up(&state(100, [0.5; 2], [1.7, 1.7])));
        assert!(blown_up(&state(100, [0.5; 2], [1.8, 1.8])));
    }

    #[test]
    fn extremes_are_those_of_all_states() {
        let mut extremes = Extremes::default();
        extremes.widen(&state(100, [0.5; 2], [3.0, 4.0]));
        extremes.widen(&state(1, [0.5; 2], [0.0, 6.0]));
        assert_eq!(extremes, Extremes { speed: 6.0, kinetic_energy: 12.5 });
    }
}
