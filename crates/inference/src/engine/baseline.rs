//! Trivial predictors that a model must beat.

use super::Ballistic;
use eddy_frames::{State, tool::Sweep};

/// A trivial predictor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Baseline {
    /// Repeats the last state.
    Persistence,
    /// Every particle keeps its velocity.
    ConstantVelocity,
    /// Every particle falls freely and stops at walls and tools.
    Ballistic,
    /// Particles whose velocity is nearer to that of a tool than to zero move rigidly with the tool; all others persist.
    CarriedByTool,
}

impl Baseline {
    /// Every baseline of streams without tools.
    pub const ALL: [Self; 3] = [Self::Persistence, Self::ConstantVelocity, Self::Ballistic];
    /// Every baseline of streams with tools.
    pub const WITH_TOOLS: [Self; 4] =
        [Self::Persistence, Self::ConstantVelocity, Self::Ballistic, Self::CarriedByTool];

    /// Its name in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Persistence => "persistence",
            Self::ConstantVelocity => "constant velocity",
            Self::Ballistic => "ballistic with walls",
            Self::CarriedByTool => "carried by the tool",
        }
    }

    /// Advances a state by one frame, with the interval, gravity and walls of `ballistic`, and the tools of `sweep`, if there are any.
    pub fn step(
        self,
        State { position, velocity }: &mut State,
        ballistic: &Ballistic,
        sweep: Option<&Sweep>,
    ) {
        match self {
            Self::Persistence => {}
            Self::ConstantVelocity => {
                for (x, v) in position.iter_mut().zip(velocity) {
                    *x = [x[0] + ballistic.dt * v[0], x[1] + ballistic.dt * v[1]];
                }
            }
            Self::Ballistic => match sweep {
                None => ballistic.step_all(position, velocity),
                Some(sweep) => {
                    let before = position.clone();
                    ballistic.step_all(position, velocity);
                    for ((from, to), velocity) in before.into_iter().zip(position).zip(velocity) {
                        sweep.stop(from, to, velocity);
                    }
                }
            },
            Self::CarriedByTool => {
                if let Some(sweep) = sweep {
                    for (position, velocity) in position.iter_mut().zip(velocity) {
                        sweep.carry(position, velocity);
                    }
                }
            }
        }
    }

    /// The frames after `state`, for each of which `sweeps` has the tools before it, if there are any.
    pub fn roll_out(
        self,
        state: &State,
        ballistic: &Ballistic,
        sweeps: &[Option<Sweep>],
    ) -> Vec<State> {
        let mut state = state.clone();
        let next = |sweep: &Option<Sweep>| {
            self.step(&mut state, ballistic, sweep.as_ref());
            state.clone()
        };
        sweeps.iter().map(next).collect()
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
        baseline.roll_out(state, &unit_square, &[const { None }; 4]).pop().unwrap()
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
