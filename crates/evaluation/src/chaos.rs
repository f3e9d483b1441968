//! An upper bound on predictability: the true simulation continued from slightly displaced positions.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{EvalError, Rollout};
use eddy_dataset::Stream;
use eddy_frames::{Frame, State, decimal};
use eddy_mpm::{MpmError, Scene, Settings, Simulation};

/// Largest displacement of a particle along each axis (domain lengths).
pub const DISPLACEMENT: f32 = 1e-4;

/// Its name in reports.
pub const NAME: &str = "truth displaced by 1e-4";

/// Simulates the whole scene again, hidden state included. At each of the frames `starts`, displaces every particle
/// at random by up to [`DISPLACEMENT`] and continues for `reach` frames.
///
/// # Errors
/// [`EvalError`] when the scene cannot be simulated, or its state at a start differs from the recorded one. The
/// remaining starts then get failed rollouts.
pub fn roll_out(
    scene: &Scene,
    stream: &Stream,
    starts: &[usize],
    reach: usize,
    each: &mut dyn FnMut(usize, Rollout),
) -> Result<(), EvalError> {
    let mut completed = 0;
    let mut count = |number: usize, rollout: Rollout| {
        completed = number + 1;
        each(number, rollout);
    };
    let outcome = simulate(scene, stream, starts, reach, &mut count);
    for (number, &start) in starts.iter().enumerate().skip(completed) {
        each(number, Rollout::lost(&stream.states[start], reach));
    }
    outcome
}

fn simulate(
    scene: &Scene,
    stream: &Stream,
    starts: &[usize],
    reach: usize,
    each: &mut dyn FnMut(usize, Rollout),
) -> Result<(), EvalError> {
    let of_solver = |reason| EvalError::Solver { stream: stream.id, reason };
    let mut simulation = simulation(scene, stream, reach).map_err(of_solver)?;
    let mut rng = ChaCha8Rng::seed_from_u64(stream.id);
    let mut done = 0;
    for (number, &start) in starts.iter().enumerate() {
        let wanted = stream.first_sequence + start as u64 + 1;
        let frame = advance(&mut simulation, wanted - done).map_err(of_solver)?;
        done = wanted;
        let observed = &stream.states[start];
        if frame.map(State::from).as_ref() != Some(observed) {
            return Err(EvalError::OtherTruth { stream: stream.id, frame: start });
        }
        let mut other = simulation.clone();
        let range = -DISPLACEMENT..DISPLACEMENT;
        let displacement = || [rng.random_range(range.clone()), rng.random_range(range.clone())];
        other.displace(displacement).map_err(of_solver)?;
        let next = || other.next_frame().ok().flatten().map(State::from);
        each(number, Rollout::collect(observed, reach, next));
    }
    Ok(())
}

/// The scene's simulation at frame `start` of a stream, with room for `reach` more frames.
///
/// # Errors
/// [`MpmError`] when the scene cannot be simulated.
pub(super) fn at(
    scene: &Scene,
    stream: &Stream,
    start: usize,
    reach: usize,
) -> Result<Simulation, MpmError> {
    let mut simulation = simulation(scene, stream, reach)?;
    advance(&mut simulation, stream.first_sequence + start as u64 + 1)?;
    Ok(simulation)
}

/// Advances by `frames` frames and returns the last of them.
pub(super) fn advance(simulation: &mut Simulation, frames: u64) -> Result<Option<Frame>, MpmError> {
    let mut last = None;
    for _ in 0..frames {
        last = simulation.next_frame()?;
    }
    Ok(last)
}

/// The scene's simulation, long enough for `reach` frames after the end of the stream.
pub(super) fn simulation(
    scene: &Scene,
    stream: &Stream,
    reach: usize,
) -> Result<Simulation, MpmError> {
    let frames = stream.first_sequence as usize + stream.states.len() + reach + 1;
    let duration = frames as f64 * decimal(scene.frames.interval);
    Simulation::new(scene.clone(), &Settings { duration: Some(duration), ..Settings::default() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_streams::first_frames;
    use eddy_mpm::Preset;

    #[test]
    fn a_displaced_simulation_starts_within_a_displacement_of_the_truth() {
        let scene = Scene::generate(Preset::Kinds, 5, 2);
        let (stream, start) = (first_frames(&scene, 5), 3);
        let mut rollouts = Vec::new();
        roll_out(&scene, &stream, &[start], 1, &mut |_, rollout| rollouts.push(rollout)).unwrap();
        let found = rollouts[0].states[0].position.iter().zip(&stream.states[start + 1].position);
        let apart = found.map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1])).fold(0.0, f32::max);
        // Within a frame the solver smooths differences between neighbours.
        assert!(apart > 0.1 * DISPLACEMENT && apart < 3.0 * DISPLACEMENT, "{apart}");
    }

    #[test]
    fn rollouts_fail_from_the_first_frame_that_the_scene_does_not_reproduce() {
        let scene = Scene::generate(Preset::Kinds, 5, 2);
        let mut stream = first_frames(&scene, 6);
        stream.states[3].position[7][0] += 1e-3;
        let mut diverged = Vec::new();
        let mut keep = |_: usize, rollout: Rollout| diverged.push(rollout.diverged);
        let error = roll_out(&scene, &stream, &[1, 3, 4], 1, &mut keep).unwrap_err();
        assert!(error.to_string().contains("stream 2: frame 3"), "{error}");
        assert_eq!(diverged, [false, true, true]);
    }
}
