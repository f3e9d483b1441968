//! Simulated streams for unit tests.

use std::path::Path;

use crate::{Context, Settings};
use eddy_dataset::{Bounds, Stream};
use eddy_frames::State;
use eddy_inference::{checkpoint::Checkpoint, kernels::spacing::spacing};
use eddy_mpm::{Scene, Settings as SolverSettings, Simulation};

/// The first frames of a scene, not from a bag.
pub(crate) fn first_frames(scene: &Scene, frames: usize) -> Stream {
    let mut simulation = Simulation::new(scene.clone(), &SolverSettings::default()).unwrap();
    let mut next = || simulation.next_frame().unwrap().unwrap();
    let mut stream = Stream::begin(Path::new("test"), next());
    stream.states.extend((1..frames).map(|_| State::from(next())));
    stream
}

/// The context of an evaluation of the shipped model on a stream.
pub(crate) fn context(stream: &Stream, settings: Settings) -> Context {
    let description = Checkpoint::shipped().unwrap().description;
    let mut walls = Bounds::default();
    for x in stream.states.iter().flat_map(|state| &state.position) {
        walls.join(&Bounds { lower: *x, upper: *x });
    }
    let spacing = spacing(&stream.states[0].position);
    Context::new(settings, &description, 1, stream.domain, walls, spacing)
}
