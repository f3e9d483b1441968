//! Ten numbers fitted by least squares: the simplest predictor that learns from data.

use crate::normal_equations::solve;
use eddy_dataset::{DatasetError, Trajectory};
use eddy_frames::State;

/// Pairs of consecutive frames that a fit uses, at most; they are spread evenly over all streams.
const PAIRS: usize = 2048;
/// Numbers of a row: a constant, and the factors of x, y, vx, vy.
const NUMBERS: usize = 5;

/// dv = a + A (x, y, vx, vy): the change of a particle's velocity within a frame by its own state, a row for each axis
/// (domain lengths, domain lengths per second). It knows of gravity and of drag, and of no neighbour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinearFit {
    /// a, then A.
    pub rows: [[f32; NUMBERS]; 2],
}

impl LinearFit {
    /// The fit to all particles of streams; `None` if their states do not determine it.
    ///
    /// # Errors
    /// [`DatasetError`] when a stream cannot be read.
    pub fn of(streams: &[Trajectory]) -> Result<Option<Self>, DatasetError> {
        let all: usize = streams.iter().map(|stream| stream.frames.saturating_sub(1)).sum();
        let stride = all.div_ceil(PAIRS).max(1);
        let mut sums = Sums::default();
        let mut skipped = 0;
        for stream in streams {
            let pairs = stream.frames.saturating_sub(1);
            for first in (skipped..pairs).step_by(stride) {
                let mut before: Option<State> = None;
                stream.visit(first..first + 2, |state| match &before {
                    None => before = Some(state.clone()),
                    Some(before) => sums.add(before, state),
                })?;
            }
            // The next stream goes on in the same rhythm.
            skipped = (skipped + stride - pairs % stride) % stride;
        }
        Ok(sums.solve())
    }

    /// Advances a state by one frame of `dt` (s): v' = v + dv, x' = x + v' dt.
    pub fn step(&self, State { position, velocity }: &mut State, dt: f32) {
        for (x, v) in position.iter_mut().zip(velocity) {
            let state = [1.0, x[0], x[1], v[0], v[1]];
            for (axis, row) in self.rows.iter().enumerate() {
                v[axis] += row.iter().zip(state).map(|(a, b)| a * b).sum::<f32>();
            }
            *x = [x[0] + dt * v[0], x[1] + dt * v[1]];
        }
    }
}

/// The normal equations.
#[derive(Default)]
struct Sums {
    /// Products of the inputs, 1, x, y, vx, vy.
    inputs: [[f64; NUMBERS]; NUMBERS],
    /// Products of inputs and dv, by axis.
    changes: [[f64; NUMBERS]; 2],
}

impl Sums {
    fn add(&mut self, before: &State, after: &State) {
        let states = before.position.iter().zip(&before.velocity).zip(&after.velocity);
        for ((x, v), next) in states {
            let inputs = [1.0, x[0], x[1], v[0], v[1]].map(f64::from);
            for (row, a) in self.inputs.iter_mut().zip(inputs) {
                row.iter_mut().zip(inputs).for_each(|(sum, b)| *sum += a * b);
            }
            for (axis, row) in self.changes.iter_mut().enumerate() {
                let change = f64::from(next[axis] - v[axis]);
                row.iter_mut().zip(inputs).for_each(|(sum, a)| *sum += a * change);
            }
        }
    }

    fn solve(self) -> Option<LinearFit> {
        let rows = solve(self.inputs, self.changes)?;
        Some(LinearFit { rows: rows.map(|row| row.map(|number| number as f32)) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_dataset::Stream;
    use eddy_frames::{Domain, Material, Stamp};

    /// A stream whose particles move by `fit`, from places that differ.
    fn stream(fit: &LinearFit, id: u64, frames: usize) -> Trajectory {
        const DT: f32 = 0.25;
        let place = |k: usize| ((k * 7 + id as usize * 3) % 11) as f32 / 11.0;
        let start = State {
            position: (0..9).map(|k| [place(k), place(k + 4)]).collect(),
            velocity: (0..9).map(|k| [place(2 * k) - 0.5, place(3 * k + 1)]).collect(),
        };
        let after = |state: &State| {
            let mut state = state.clone();
            fit.step(&mut state, DT);
            Some(state)
        };
        let states = std::iter::successors(Some(start), after).take(frames).collect();
        Trajectory::from(Stream {
            id,
            source: "memory".into(),
            dt: DT,
            domain: Domain::UNIT,
            material: vec![Material::Liquid; 9],
            first_sequence: 0,
            first_stamp: Stamp::default(),
            stiffness: None,
            tools: None,
            states,
        })
    }

    #[test]
    fn the_numbers_that_moved_the_particles_are_found() {
        let any = [[0.1, 0.0, -0.2, 0.05, 0.0], [-0.4, 0.3, 0.1, 0.0, -0.25]];
        // Bounded, however many frames there are.
        let swinging = [[0.1, -0.2, 0.0, 0.0, 0.0], [-0.4, 0.0, -0.3, 0.0, 0.0]];
        // With more pairs of frames than are used, too.
        for (rows, frames) in [(any, 6), (swinging, PAIRS)] {
            let fit = LinearFit { rows };
            let streams = [stream(&fit, 0, frames), stream(&fit, 1, frames)];
            let found = LinearFit::of(&streams).unwrap().unwrap();
            for (found, expected) in found.rows.as_flattened().iter().zip(rows.as_flattened()) {
                assert!((found - expected).abs() < 1e-5, "{frames}: {found} for {expected}");
            }
        }
    }

    #[test]
    fn particles_that_stand_still_determine_nothing() {
        let fit = LinearFit { rows: [[0.0; 5]; 2] };
        let Ok(states) = stream(&fit, 0, 1).cut(0..1) else { panic!("a stream in memory") };
        let mut still = states;
        still.states[0].velocity.fill([0.0; 2]);
        still.states = vec![still.states[0].clone(); 4];
        assert_eq!(LinearFit::of(&[Trajectory::from(still)]).unwrap(), None);
    }
}
