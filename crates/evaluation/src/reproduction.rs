//! Whether simulating a scene gives a recorded stream again: solvers may be restarted from its frames only if it is that scene's.

use super::chaos;
use eddy_dataset::Stream;
use eddy_frames::State;
use eddy_mpm::{MpmError, Scene};

/// How the frames that a scene gives here differ from those of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Reproduction {
    /// Not in one bit.
    Exact,
    /// By rounding: the stream was simulated on a GPU, or on another kind of processor.
    Rounded,
    /// By more: the stream is not of this scene.
    Different,
}

/// Number of frames that are compared. In the first one, particles may still be where the scene puts them.
pub(super) const FRAMES: usize = 2;

/// Largest distance between two positions of a particle that is taken for rounding (domain lengths). On a GPU,
/// they differ by up to 5e-4 cells after 200 substeps (`docs/src/background/gpu.md`); a stiff scene has up to 1,527 a frame.
const ROUNDING: f32 = 1e-3;

/// Simulates the first [`FRAMES`] frames of a stream again.
///
/// # Errors
/// [`MpmError`] when the scene cannot be simulated.
pub(super) fn reproduction(scene: &Scene, stream: &Stream) -> Result<Reproduction, MpmError> {
    let mut simulation = chaos::simulation(scene, stream, 0)?;
    chaos::advance(&mut simulation, stream.first_sequence)?;
    let mut outcome = Reproduction::Exact;
    for state in stream.states.iter().take(FRAMES) {
        let Some(frame) = simulation.next_frame()? else { return Ok(Reproduction::Different) };
        if frame.material != stream.material || !are_near(&frame.position, &state.position) {
            return Ok(Reproduction::Different);
        }
        if State::from(frame) != *state {
            outcome = Reproduction::Rounded;
        }
    }
    Ok(outcome)
}

fn are_near(found: &[[f32; 2]], expected: &[[f32; 2]]) -> bool {
    let mut pairs = found.iter().zip(expected);
    pairs.all(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1]) <= ROUNDING)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_streams::first_frames;
    use eddy_mpm::Preset;

    #[test]
    fn a_stream_belongs_to_its_own_scene_only_and_may_be_rounded_otherwise() {
        let scene = |id| Scene::generate(Preset::Kinds, 5, id);
        let exact = first_frames(&scene(2), 3);
        assert_eq!(reproduction(&scene(2), &exact).unwrap(), Reproduction::Exact);
        assert_eq!(reproduction(&scene(7), &exact).unwrap(), Reproduction::Different);
        let mut other = exact.clone();
        other.states[1].velocity[7][0] += 1e-5;
        assert_eq!(reproduction(&scene(2), &other).unwrap(), Reproduction::Rounded);
        for (shift, expected) in [(1e-5, Reproduction::Rounded), (1e-2, Reproduction::Different)] {
            let mut other = exact.clone();
            other.states[1].position[7][0] += shift;
            assert_eq!(reproduction(&scene(2), &other).unwrap(), expected);
        }
    }
}
