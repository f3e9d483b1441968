//! Simulated streams for unit tests.

use tempfile::TempDir;

use crate::dataset::{
    Trajectory, load_trajectories,
    simulate::{SimulationRequest, Source, simulate},
};
use eddy_frames::progress::Silent;
use eddy_mpm::{Extent, Settings};

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
    let streams = load_trajectories(&bags, u64::MAX, &mut |_, _| ()).unwrap();
    (folder, streams)
}
