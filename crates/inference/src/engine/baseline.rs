//! Trivial predictors that a model must beat.

use super::Ballistic;
use eddy_frames::State;

/// A trivial predictor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Baseline {
    /// Repeats the last state.
    Persistence,
    /// Every particle keeps its velocity.
    ConstantVelocity,
    /// Every particle falls freely and stops at the walls.
    Ballistic,
}

impl Baseline {
    /// Every baseline.
    pub const ALL: [Self; 3] = [Self::Persistence, Self::ConstantVelocity, Self::Ballistic];

    /// Its name in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Persistence => "persistence",
            Self::ConstantVelocity => "constant velocity",
            Self::Ballistic => "ballistic with walls",
        }
    }

    /// Advances a state by one frame, with the interval, gravity and walls of `ballistic`.
    pub fn step(self, State { position, velocity }: &mut State, ballistic: &Ballistic) {
        match self {
            Self::Persistence => {}
            Self::ConstantVelocity => {
                for (x, v) in position.iter_mut().zip(velocity) {
                    *x = [x[0] + ballistic.dt * v[0], x[1] + ballistic.dt * v[1]];
                }
            }
            Self::Ballistic => ballistic.step_all(position, velocity),
        }
    }

    /// The states 1 to `horizon` frames after `state`.
    pub fn roll_out(self, state: &State, horizon: usize, ballistic: &Ballistic) -> Vec<State> {
        let mut state = state.clone();
        let next = |_| {
            self.step(&mut state, ballistic);
            state.clone()
        };
        (0..horizon).map(next).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(position: [f32; 2], velocity: [f32; 2]) -> State {
        State { position: vec![position], velocity: vec![velocity] }
    }

    fn last(baseline: Baseline, state: &State) -> State {
        let unit_square =
            Ballistic { gravity: [0.0, -1.0], dt: 0.25, lower: [0.0; 2], upper: [1.0; 2] };
        baseline.roll_out(state, 4, &unit_square).pop().unwrap()
    }

    #[test]
    fn persistence_repeats_the_last_state() {
        let state = one([0.5, 0.5], [0.25, 0.0]);
        assert_eq!(last(Baseline::Persistence, &state), state);
    }

    #[test]
    fn constant_velocity_keeps_its_velocity() {
        let state = one([0.5, 0.5], [0.25, 0.0]);
        assert_eq!(last(Baseline::ConstantVelocity, &state), one([0.75, 0.5], [0.25, 0.0]));
    }

    #[test]
    fn a_ballistic_particle_stops_at_the_floor() {
        let state = one([0.5, 0.25], [0.25, 0.0]);
        assert_eq!(last(Baseline::Ballistic, &state), one([0.75, 0.0], [0.25, 0.0]));
    }
}
