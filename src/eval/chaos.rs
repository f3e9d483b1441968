//! How well anyone could predict: the truth itself, from positions that are slightly off.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::Rollout;
use crate::{
    dataset::{State, Stream},
    frame::{Frame, decimal},
    mpm::{MpmError, Scene, Settings, Simulation},
};

/// Largest displacement of a particle along each axis (domain lengths).
pub const DISPLACEMENT: f32 = 1e-4;

/// Its name in reports.
pub const NAME: &str = "truth displaced by 1e-4";

/// The whole scene is simulated again, hidden state included; at each of the frames `starts` every
/// particle is displaced at random by up to [`DISPLACEMENT`] and followed for `reach` frames.
///
/// # Errors
/// [`MpmError`] for a scene that cannot be simulated.
pub fn roll_out(
    scene: &Scene,
    stream: &Stream,
    starts: &[usize],
    reach: usize,
    each: &mut dyn FnMut(usize, Rollout),
) -> Result<(), MpmError> {
    let mut simulation = simulation(scene, stream, reach)?;
    let mut rng = ChaCha8Rng::seed_from_u64(stream.id);
    let mut done = 0;
    for (number, &start) in starts.iter().enumerate() {
        let wanted = stream.first_sequence + start as u64 + 1;
        advance(&mut simulation, wanted - done)?;
        done = wanted;
        let mut other = simulation.clone();
        let range = -DISPLACEMENT..DISPLACEMENT;
        other.displace(|| [rng.random_range(range.clone()), rng.random_range(range.clone())])?;
        let next = || other.next_frame().ok().flatten().map(into_state);
        each(number, Rollout::collect(&stream.states[start], reach, next));
    }
    Ok(())
}

/// The scene's simulation at the frame `start` of a stream, for `reach` frames more.
///
/// # Errors
/// As [`roll_out`].
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

fn advance(simulation: &mut Simulation, frames: u64) -> Result<(), MpmError> {
    (0..frames).try_for_each(|_| simulation.next_frame().map(|_| ()))
}

/// Whether `scene` is what the first frame of a stream came from.
///
/// # Errors
/// As [`roll_out`].
pub fn is_scene_of(scene: &Scene, stream: &Stream) -> Result<bool, MpmError> {
    let mut simulation = simulation(scene, stream, 0)?;
    advance(&mut simulation, stream.first_sequence)?;
    Ok(simulation.next_frame()?.is_some_and(|frame| {
        frame.material == stream.material && into_state(frame) == stream.states[0]
    }))
}

/// The scene's simulation, long enough for `reach` frames after the stream.
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
    use crate::mpm::Preset;

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
            first_stamp: crate::frame::Stamp(0),
            states: states.chain((1..frames).map(|_| into_state(next()))).collect(),
        }
    }

    #[test]
    fn a_stream_belongs_to_its_scene_and_to_no_other() {
        let scene = |id| Scene::generate(Preset::Kinds, 5, id);
        let stream = stream(&scene(2), 1);
        assert!(is_scene_of(&scene(2), &stream).unwrap());
        assert!(!is_scene_of(&scene(7), &stream).unwrap());
    }

    #[test]
    fn a_displaced_truth_starts_at_most_a_displacement_beside_the_truth() {
        let scene = Scene::generate(Preset::Kinds, 5, 2);
        let (stream, start) = (stream(&scene, 5), 3);
        let mut rollouts = Vec::new();
        roll_out(&scene, &stream, &[start], 1, &mut |_, rollout| rollouts.push(rollout)).unwrap();
        let found = rollouts[0].states[0].position.iter().zip(&stream.states[start + 1].position);
        let apart = found.map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1])).fold(0.0, f32::max);
        // Within a frame the solver smooths differences between neighbours.
        assert!(apart > 0.1 * DISPLACEMENT && apart < 3.0 * DISPLACEMENT, "{apart}");
    }
}
