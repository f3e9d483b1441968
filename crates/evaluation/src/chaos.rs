//! An upper bound on predictability: the true simulation continued from slightly displaced positions.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{EvalError, Rollout};
use crate::dataset::{State, Stream};
use eddy_frames::{Frame, decimal};
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
        if frame.map(into_state).as_ref() != Some(observed) {
            return Err(EvalError::OtherTruth { stream: stream.id, frame: start });
        }
        let mut other = simulation.clone();
        let range = -DISPLACEMENT..DISPLACEMENT;
        let displacement = || [rng.random_range(range.clone()), rng.random_range(range.clone())];
        other.displace(displacement).map_err(of_solver)?;
        let next = || other.next_frame().ok().flatten().map(into_state);
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
fn advance(simulation: &mut Simulation, frames: u64) -> Result<Option<Frame>, MpmError> {
    let mut last = None;
    for _ in 0..frames {
        last = simulation.next_frame()?;
    }
    Ok(last)
}

/// What simulating a scene says about a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Origin {
    /// The simulation gives the same bits.
    Here,
    /// It gives the same frames but for rounding: they were simulated on a GPU, or on another kind of processor.
    Elsewhere,
    /// It gives other frames.
    OtherScene,
}

/// Largest distance between two positions of a particle that rounding explains in the first two frames (domain lengths).
const ROUNDING: f32 = 1e-3;

/// Where a stream comes from, by simulating all of its states: the first two of a stream are enough.
///
/// # Errors
/// [`MpmError`] when the scene cannot be simulated.
pub(super) fn origin(scene: &Scene, stream: &Stream) -> Result<Origin, MpmError> {
    let mut simulation = simulation(scene, stream, 0)?;
    advance(&mut simulation, stream.first_sequence)?;
    let mut origin = Origin::Here;
    for state in &stream.states {
        match simulation.next_frame()? {
            Some(frame) if frame.material == stream.material => {
                if !is_near(&frame.position, &state.position) {
                    return Ok(Origin::OtherScene);
                }
                if into_state(frame) != *state {
                    origin = Origin::Elsewhere;
                }
            }
            _ => return Ok(Origin::OtherScene),
        }
    }
    Ok(origin)
}

fn is_near(found: &[[f32; 2]], expected: &[[f32; 2]]) -> bool {
    let mut pairs = found.iter().zip(expected);
    pairs.all(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1]) <= ROUNDING)
}

/// The scene's simulation, long enough for `reach` frames after the end of the stream.
fn simulation(scene: &Scene, stream: &Stream, reach: usize) -> Result<Simulation, MpmError> {
    let frames = stream.first_sequence as usize + stream.states.len() + reach + 1;
    let duration = frames as f64 * decimal(scene.frames.interval);
    Simulation::new(scene.clone(), &Settings { duration: Some(duration), ..Settings::default() })
}

fn into_state(frame: Frame) -> State {
    State { position: frame.position, velocity: frame.velocity }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_mpm::Preset;

    /// The first frames of a scene.
    fn stream(scene: &Scene, frames: usize) -> Stream {
        let mut simulation = Simulation::new(scene.clone(), &Settings::default()).unwrap();
        let mut next = || simulation.next_frame().unwrap().unwrap();
        let first = next();
        let (domain, material) = (first.domain, first.material.clone());
        let states = std::iter::once(into_state(first));
        Stream {
            id: scene.id,
            source: "test".into(),
            dt: scene.frames.interval,
            domain,
            material,
            first_sequence: 0,
            first_stamp: eddy_frames::Stamp(0),
            stiffness: None,
            states: states.chain((1..frames).map(|_| into_state(next()))).collect(),
        }
    }

    #[test]
    fn a_stream_belongs_to_its_own_scene_only_and_may_be_rounded_otherwise() {
        let scene = |id| Scene::generate(Preset::Kinds, 5, id);
        let mut stream = stream(&scene(2), 2);
        assert_eq!(origin(&scene(2), &stream).unwrap(), Origin::Here);
        assert_eq!(origin(&scene(7), &stream).unwrap(), Origin::OtherScene);
        for (shift, expected) in [(1e-5, Origin::Elsewhere), (1e-2, Origin::OtherScene)] {
            stream.states[1].position[7][0] += shift;
            assert_eq!(origin(&scene(2), &stream).unwrap(), expected);
        }
    }

    #[test]
    fn a_displaced_simulation_starts_within_a_displacement_of_the_truth() {
        let scene = Scene::generate(Preset::Kinds, 5, 2);
        let (stream, start) = (stream(&scene, 5), 3);
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
        let mut stream = stream(&scene, 6);
        stream.states[3].position[7][0] += 1e-3;
        let mut diverged = Vec::new();
        let mut keep = |_: usize, rollout: Rollout| diverged.push(rollout.diverged);
        let error = roll_out(&scene, &stream, &[1, 3, 4], 1, &mut keep).unwrap_err();
        assert!(error.to_string().contains("stream 2: frame 3"), "{error}");
        assert_eq!(diverged, [false, true, true]);
    }
}
