//! Simulated streams for the tests of this crate and of those that use it.

use std::error::Error;

use tempfile::TempDir;

use crate::{
    LoadOptions, Trajectory, load_trajectories,
    simulate::{SimulationRequest, Source, simulate},
};
use eddy_frames::progress::Silent;
use eddy_mpm::{Extent, Settings as SolverSettings};

/// Random scenes of 13 frames, and the folder with their bags.
///
/// # Errors
/// As [`simulate()`] and [`load_trajectories`].
pub fn simulated(
    extent: Extent,
    scenes: u32,
) -> Result<(TempDir, Vec<Trajectory>), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
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
    simulate(&request, folder.path(), &Silent, None)?.complete()?;
    let bags = [folder.path().to_owned()];
    let streams = load_trajectories(&bags, LoadOptions::within(u64::MAX), &mut |_, _| ())?;
    Ok((folder, streams.streams))
}
