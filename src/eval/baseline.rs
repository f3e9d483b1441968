//! Predictors that learn nothing: what a model must beat.

use crate::{dataset::State, frame::Domain, model::ballistic};

/// A trivial predictor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Baseline {
    /// Nothing moves.
    Persistence,
    /// Every particle keeps its velocity.
    ConstantVelocity,
    /// Every particle falls, and stops at the walls.
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

    /// The states 1 to `horizon` frames of `dt` seconds after `state`, under `gravity`
    /// (domain lengths per second squared), in a box.
    pub fn roll_out(
        self,
        state: &State,
        horizon: usize,
        dt: f32,
        gravity: [f32; 2],
        walls: Domain,
    ) -> Vec<State> {
        let mut state = state.clone();
        if self == Self::Persistence {
            state.velocity.fill([0.0; 2]);
        }
        (0..horizon)
            .map(|_| {
                match self {
                    Self::Persistence => {}
                    Self::ConstantVelocity => {
                        for (x, v) in state.position.iter_mut().zip(&state.velocity) {
                            *x = [x[0] + dt * v[0], x[1] + dt * v[1]];
                        }
                    }
                    Self::Ballistic => {
                        ballistic::step(&mut state.position, &mut state.velocity, gravity, walls, dt);
                    }
                }
                state.clone()
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(position: [f32; 2], velocity: [f32; 2]) -> State {
        State { position: vec![position], velocity: vec![velocity] }
    }

    fn last(baseline: Baseline, state: &State) -> State {
        baseline.roll_out(state, 4, 0.25, [0.0, -1.0], Domain::UNIT).pop().unwrap()
    }

    #[test]
    fn persistence_rests() {
        let state = one([0.5, 0.5], [0.25, 0.0]);
        assert_eq!(last(Baseline::Persistence, &state), one([0.5, 0.5], [0.0, 0.0]));
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
