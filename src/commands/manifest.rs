//! `manifest.json` beside the bags of `eddy simulate`: what was asked for, and what came out.

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};

use eddy::{
    frame::Material,
    mpm::{Attractor, Body, Preset, Settings, Simulation},
};

/// The file's name.
const NAME: &str = "manifest.json";

/// What all scenes of a directory were asked to be.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Request {
    /// Version of the program.
    pub(super) eddy: String,
    /// The kind of scenes.
    pub(super) preset: Preset,
    /// Their seed.
    pub(super) seed: u64,
    /// Stiffness, substeps and duration.
    pub(super) settings: Settings,
}

/// What a scene starts from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Start {
    /// The scene's id.
    pub(super) id: u64,
    /// The materials that occur.
    pub(super) materials: Vec<Material>,
    /// The bodies.
    pub(super) bodies: Vec<Body>,
    /// What pulled before the recording started.
    pub(super) attractor: Option<Attractor>,
    /// Substeps a frame.
    pub(super) substeps: u32,
}

impl Start {
    /// What this simulation starts from.
    pub(super) fn of(simulation: &Simulation) -> Self {
        let scene = simulation.scene();
        Self {
            id: scene.id,
            materials: scene.materials(),
            bodies: scene.bodies.clone(),
            attractor: scene.attractor,
            substeps: simulation.substeps_per_frame(),
        }
    }
}

/// A finished scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Finished {
    /// What it started from.
    #[serde(flatten)]
    pub(super) start: Start,
    /// How many frames were recorded.
    pub(super) frames: u64,
    /// SHA-256 of the CDR bytes of all frames, one after the other.
    pub(super) sha256: String,
}

/// The manifest of a directory.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Manifest {
    #[serde(flatten)]
    request: Request,
    /// The finished scenes, by id.
    scenes: Vec<Finished>,
}

impl Manifest {
    /// The manifest of a directory, or an empty one where there is none yet. Refuses one that was
    /// made for another request.
    pub(super) fn open(directory: &Path, request: Request) -> anyhow::Result<Self> {
        let path = path(directory);
        if !path.exists() {
            return Ok(Self { request, scenes: Vec::new() });
        }
        let text = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        let found: Self = serde_json::from_slice(&text)
            .with_context(|| format!("{}: found no manifest of eddy simulate", path.display()))?;
        if found.request != request {
            bail!(
                "{}: found {}, expected {}; choose another directory",
                path.display(),
                serde_json::to_string(&found.request)?,
                serde_json::to_string(&request)?
            );
        }
        Ok(found)
    }

    /// The finished scene with this id.
    pub(super) fn scene(&self, id: u64) -> Option<&Finished> {
        self.scenes.iter().find(|scene| scene.start.id == id)
    }

    /// Adds a scene, or replaces the one with its id.
    pub(super) fn insert(&mut self, scene: Finished) {
        self.scenes.retain(|other| other.start.id != scene.start.id);
        self.scenes.push(scene);
        self.scenes.sort_by_key(|scene| scene.start.id);
    }

    /// Writes the manifest in one step: whoever reads it sees the old one or the new one.
    pub(super) fn save(&self, directory: &Path) -> anyhow::Result<()> {
        let path = path(directory);
        let unfinished = path.with_extension("json.tmp");
        let text = serde_json::to_string_pretty(self)? + "\n";
        fs::write(&unfinished, text)
            .and_then(|()| fs::rename(&unfinished, &path))
            .with_context(|| format!("cannot write {}", path.display()))
    }
}

fn path(directory: &Path) -> PathBuf {
    directory.join(NAME)
}
