//! Setup of every scene before the first is simulated.

use std::{fs, ops::Range, path::Path};

use rayon::prelude::*;
use sha2::{Digest, Sha256};

use super::{
    SimulateError, SimulationRequest, UPLOADED_LAST, directory,
    manifest::{Finished, Manifest, Start},
};
use crate::{TRUTH_TOPIC, available_memory};
use eddy_bag::BagReader;
use eddy_frames::counted;
use eddy_messages::{Message, ParticleFrame};
use eddy_mpm::{MpmError, Scene, Settings, Simulation};
use eddy_storage::is_remote;

/// A scene to simulate.
#[derive(Clone, Debug)]
pub struct Planned {
    /// Its initial conditions.
    pub start: Start,
    /// Maximum number of frames.
    pub most_frames: u64,
}

impl Planned {
    /// Updates of particles in all substeps, which the time is proportional to; at most, since scenes may end early.
    pub fn particle_updates(&self) -> f64 {
        let scene = &self.start.scene;
        scene.estimate() * f64::from(self.start.substeps) * self.most_frames as f64
    }
}

/// The scenes of a range to simulate, without those already in the output. `at_once` scenes will be simulated in parallel.
pub(super) fn plan(
    request: &SimulationRequest,
    range: Range<u32>,
    manifest: Option<&Manifest>,
    at_once: usize,
) -> Result<Vec<Planned>, SimulateError> {
    let available = available_memory();
    let at_once = at_once.min(range.len());
    let planned: Vec<Option<Planned>> = range
        .into_par_iter()
        .map(|index| {
            let scene = request.scene(index.into());
            let id = scene.id;
            let planned = plan_scene(scene, at_once, available).map_err(|reason| {
                SimulateError::Scene { scene: request.scene_name(id), reason: Box::new(reason) }
            })?;
            let Some(manifest) = manifest else { return Ok(Some(planned)) };
            let directory = manifest.output().join(directory(id));
            if !is_there(&directory)? {
                return Ok(Some(planned));
            }
            match manifest.scene(id)? {
                Some(found) if found.start == planned.start => check_bag(&directory, &found)?,
                _ => return Err(SimulateError::OtherScene { directory }),
            }
            Ok(None)
        })
        .collect::<Result<_, SimulateError>>()?;
    Ok(planned.into_iter().flatten().collect())
}

/// Whether there is a bag, or anything else, at a path.
fn is_there(directory: &Path) -> Result<bool, SimulateError> {
    if !is_remote(directory) {
        return Ok(fs::symlink_metadata(directory).is_ok());
    }
    let file = directory.join(UPLOADED_LAST);
    eddy_storage::exists(&file).map_err(SimulateError::io("look for", &file))
}

/// Checks that the bag of a finished scene has the frames that were written. Those in a store are not read again.
fn check_bag(directory: &Path, finished: &Finished) -> Result<(), SimulateError> {
    if is_remote(directory) || finished.frames == 0 {
        return Ok(());
    }
    let damaged = |found: String| SimulateError::Damaged {
        directory: directory.to_owned(),
        found,
        expected: counted(finished.frames, "frame"),
    };
    let mut digest = Sha256::new();
    let mut frames = 0;
    let bag = BagReader::open(directory).map_err(|error| damaged(error.to_string()))?;
    let messages = bag.messages_of(TRUTH_TOPIC, ParticleFrame::TYPE);
    for message in messages.map_err(|error| damaged(error.to_string()))? {
        let message = message.map_err(|error| damaged(error.to_string()))?;
        digest.update(&message.data);
        frames += 1;
    }
    if frames != finished.frames {
        return Err(damaged(counted(frames, "frame")));
    }
    match format!("{:x}", digest.finalize()) == finished.sha256 {
        true => Ok(()),
        false => Err(damaged("other frames than the sha256 in manifest.json is of".to_owned())),
    }
}

fn plan_scene(scene: Scene, at_once: usize, available: u64) -> Result<Planned, SimulateError> {
    check_memory(&scene, at_once, available)?;
    let simulation = Simulation::new(scene, &Settings::default())?;
    let start = Start::of(&simulation);
    Ok(Planned { start, most_frames: simulation.most_frames() })
}

/// Checks that `at_once` scenes of this size fit into memory.
fn check_memory(scene: &Scene, at_once: usize, available: u64) -> Result<(), SimulateError> {
    let needed = memory(scene)?.saturating_mul(at_once as u64);
    if needed <= available {
        return Ok(());
    }
    let (particles, cells) = (scene.estimate(), scene.grid()?.cells);
    Err(SimulateError::Memory { needed, particles, cells, at_once, free: available })
}

fn memory(scene: &Scene) -> Result<u64, MpmError> {
    scene.check()?;
    scene.memory()
}

/// A size in the largest binary unit that gives at least 1.
pub(super) fn bytes(count: u64) -> String {
    const UNITS: [&str; 6] = ["KiB", "MiB", "GiB", "TiB", "PiB", "EiB"];
    if count < 1024 {
        return format!("{count} B");
    }
    let power = (count.ilog2() / 10) as usize;
    format!("{:.2} {}", count as f64 / 1024f64.powi(power as i32), UNITS[power - 1])
}
