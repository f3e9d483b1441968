//! Simulated streams for unit tests.

use std::path::Path;

use tempfile::TempDir;

use crate::{
    Context, Settings,
    dataset::{
        Bounds, LoadOptions, Stream, Trajectory, load_trajectories,
        simulate::{SimulationRequest, Source, simulate},
    },
};
use eddy_frames::{State, progress::Silent};
use eddy_inference::{checkpoint::Checkpoint, kernels::spacing::spacing};
use eddy_mpm::{Extent, Scene, Settings as SolverSettings, Simulation};

/// Random scenes of 13 frames, and the folder with their bags.
pub(crate) fn simulated(extent: Extent, scenes: u32) -> (TempDir, Vec<Trajectory>) {
    let folder = tempfile::tempdir().unwrap();
    let request = SimulationRequest {
        source: Source::Random(extent),
        name: "kinds".to_owned(),
        scene_name: None,
        scenes,
        seed: 5,
        settings: SolverSettings { duration: Some(0.2), ..SolverSettings::default() },
        fields: false,
        device: None,
        threads: None,
    };
    simulate(&request, folder.path(), &Silent, None).unwrap().complete().unwrap();
    let bags = [folder.path().to_owned()];
    let streams = load_trajectories(&bags, LoadOptions::within(u64::MAX), &mut |_, _| ());
    (folder, streams.unwrap().streams)
}

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
