//! `manifest.json` beside the bags of `eddy simulate`: what was asked for, and what came out.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};

use eddy::{
    frame::Material,
    mpm::{Energy, Scene, Settings, Simulation},
};

/// The file's name.
const NAME: &str = "manifest.json";
/// The most points of an energy curve.
const CURVE_POINTS: usize = 33;

/// What all scenes of a directory were asked to be.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Request {
    /// Version of the program.
    pub(super) eddy: String,
    /// The preset, or the name of the scene's file.
    pub(super) scene: String,
    /// The seed of random scenes.
    pub(super) seed: u64,
    /// Particles of random scenes, where they are not 2,500.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) particles: Option<usize>,
    /// What took the place of the scenes' own numbers.
    pub(super) settings: Settings,
}

/// What a scene starts from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Start {
    /// The scene's id.
    pub(super) id: u64,
    /// The materials that occur.
    pub(super) materials: Vec<Material>,
    /// Substeps a frame.
    pub(super) substeps: u32,
    /// The scene itself, as a file of a scene would have it.
    pub(super) scene: Scene,
}

impl Start {
    /// What this simulation starts from.
    pub(super) fn of(simulation: &Simulation) -> Self {
        let scene = simulation.scene();
        Self {
            id: scene.id,
            materials: scene.materials(),
            substeps: simulation.substeps_per_frame(),
            scene: scene.clone(),
        }
    }
}

/// How much energy the particles had, at times spread evenly over a scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct EnergyCurve {
    /// When (s of simulated time).
    time: Vec<f64>,
    /// Kinetic energy (density x domain lengths^4 per s^2, like the others).
    kinetic: Vec<f32>,
    /// Elastic energy.
    elastic: Vec<f32>,
    /// Potential energy, that of height above the floor of the domain.
    potential: Vec<f32>,
}

impl EnergyCurve {
    /// Adds the energy of the next frame.
    pub(super) fn push(&mut self, time: f64, energy: Energy) {
        self.time.push(time);
        self.kinetic.push(energy.kinetic as f32);
        self.elastic.push(energy.elastic as f32);
        self.potential.push(energy.potential as f32);
    }

    /// The curve with at most [`CURVE_POINTS`] points, the first and the last among them.
    pub(super) fn thinned(&self) -> Self {
        let last = self.time.len().saturating_sub(1);
        let points = self.time.len().min(CURVE_POINTS);
        let chosen: Vec<usize> = (0..points).map(|k| k * last / (points - 1).max(1)).collect();
        let thin = |curve: &[f32]| chosen.iter().map(|&k| curve[k]).collect();
        Self {
            time: chosen.iter().map(|&k| self.time[k]).collect(),
            kinetic: thin(&self.kinetic),
            elastic: thin(&self.elastic),
            potential: thin(&self.potential),
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
    /// The energy over time.
    pub(super) energy: EnergyCurve,
    /// SHA-256 of the CDR bytes of all frames, one after the other.
    pub(super) sha256: String,
}

/// The manifest of a directory.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Manifest {
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
        let found: Self = serde_json::from_slice(&text).with_context(|| {
            format!("{}: found no manifest of this eddy; choose another --output", path.display())
        })?;
        if found.request != request {
            bail!(
                "{}: found {}, expected {}; choose another --output",
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
        let written = fs::write(&unfinished, self.text()?)
            .and_then(|()| fs::rename(&unfinished, &path))
            .with_context(|| format!("cannot write {}", path.display()));
        if written.is_err() {
            // What could not be written whole is of no use, and may be what fills the disk.
            let _ = fs::remove_file(&unfinished);
        }
        written
    }

    /// JSON with one line a scene, to be read by people too.
    fn text(&self) -> serde_json::Result<String> {
        let scenes: Vec<String> =
            self.scenes.iter().map(serde_json::to_string).collect::<serde_json::Result<_>>()?;
        Ok(format!(
            "{{\n\"request\": {},\n\"scenes\": [\n{}\n]\n}}\n",
            serde_json::to_string(&self.request)?,
            scenes.join(",\n")
        ))
    }
}

/// The scenes in the manifest of a directory, by id; `None` where there is none.
pub(in crate::commands) fn scenes(
    directory: &Path,
) -> anyhow::Result<Option<BTreeMap<u64, Scene>>> {
    let path = path(directory);
    if !path.exists() {
        return Ok(None);
    }
    let text = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let Manifest { scenes, .. } = serde_json::from_slice(&text)
        .with_context(|| format!("{}: found no manifest of this eddy", path.display()))?;
    let scenes = scenes.into_iter().map(|Finished { start, .. }| (start.id, start.scene));
    Ok(Some(scenes.collect()))
}

fn path(directory: &Path) -> PathBuf {
    directory.join(NAME)
}
