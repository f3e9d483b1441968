//! Simulated streams for unit tests.

use std::path::Path;

use tempfile::TempDir;

use crate::dataset::{
    LoadOptions, State, Stream, Trajectory, load_trajectories,
    simulate::{SimulationRequest, Source, simulate},
};
use eddy_frames::progress::Silent;
use eddy_mpm::{Extent, Scene, Settings, Simulation};

/// Random scenes of 13 frames, and the folder with their bags.
pub(crate) fn simulated(extent: Extent, scenes: u32) -> (TempDir, Vec<Trajectory>) {
    let folder = tempfile::tempdir().unwrap();
    let request = SimulationRequest {
        source: Source::Random(extent),
        name: "kinds".to_owned(),
        scene_name: None,
        scenes,
        seed: 5,
        settings: Settings { duration: Some(0.2), ..Settings::default() },
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
    let mut simulation = Simulation::new(scene.clone(), &Settings::default()).unwrap();
    let mut next = || simulation.next_frame().unwrap().unwrap();
    let mut stream = Stream::begin(Path::new("test"), next());
    stream.states.extend((1..frames).map(|_| State::from(next())));
    stream
}
