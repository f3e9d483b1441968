//! Every scene set up once before the first is simulated.

use std::{fs, path::PathBuf};

use anyhow::{Context, ensure};
use rayon::prelude::*;

use super::{
    Job, directory,
    manifest::{Manifest, Start},
    memory,
};
use eddy::mpm::{Scene, Settings, Simulation};

/// A scene that has to be made.
pub(super) struct Planned {
    /// What it starts from.
    pub(super) start: Start,
    /// The most frames that it can have.
    pub(super) most_frames: u64,
}

impl Job {
    /// The scenes to be made, without those that are there already. `at_once` of them will be
    /// simulated at a time.
    pub(super) fn plan(
        &self,
        manifest: Option<&(&PathBuf, Manifest)>,
        at_once: usize,
    ) -> anyhow::Result<Vec<Planned>> {
        let available = memory::available();
        let at_once = at_once.min(self.scenes as usize);
        let planned: Vec<Option<Planned>> = (0..u64::from(self.scenes))
            .into_par_iter()
            .map(|index| {
                let scene = self.scene(index);
                let id = scene.id;
                let planned = plan(scene, at_once, available).with_context(|| self.name(id))?;
                let Some((output, manifest)) = manifest else { return Ok(Some(planned)) };
                let directory = output.join(directory(id));
                if fs::symlink_metadata(&directory).is_err() {
                    return Ok(Some(planned));
                }
                let known = manifest.scene(id).is_some_and(|found| found.start == planned.start);
                ensure!(
                    known,
                    "{}: found a directory that is not this scene by the manifest, expected none; \
                     choose another --output",
                    directory.display()
                );
                Ok(None)
            })
            .collect::<anyhow::Result<_>>()?;
        Ok(planned.into_iter().flatten().collect())
    }
}

fn plan(scene: Scene, at_once: usize, available: u64) -> anyhow::Result<Planned> {
    memory::check(&scene, at_once, available)?;
    let simulation = Simulation::new(scene, &Settings::default())?;
    let start = Start::of(&simulation);
    Ok(Planned { start, most_frames: simulation.most_frames() })
}
