//! `manifest.json` beside the bags: the request and the finished scenes. Scenes of processes that share the directory have a file
//! of the same form each in `.incomplete`, until [`Manifest::collect`] enters them.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    fs,
    io::ErrorKind,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{SimulateError, directory, older_form, staging::INCOMPLETE};
use eddy_bag::custom_data::Quantity;
use eddy_frames::Material;
use eddy_mpm::{Energy, Scene, Settings, Simulation};
use eddy_settings::atomic;
use eddy_storage::{Version, is_remote};

const NAME: &str = "manifest.json";
/// A manifest on its way to its name.
const UNFINISHED: &str = "manifest.unfinished";
/// Maximum number of points of an energy curve.
const CURVE_POINTS: usize = 33;

/// The request of a directory: only the same request can resume it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RecordedRequest {
    /// Version of the program.
    pub(super) eddy: String,
    /// The preset, or the name of the scene file.
    pub(super) scene: String,
    /// The seed of random scenes.
    pub(super) seed: u64,
    /// Particles of random scenes, unless the default of 2,500.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) particles: Option<usize>,
    /// Whether all random scenes have the same bodies.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(super) same_bodies: bool,
    /// The range of the random fraction of the domain that bodies fill, unless all scenes have the same number of particles.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) fill: Option<[f32; 2]>,
    /// The range of the random stiffness of scenes, unless all have the preset's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) stiffness: Option<[f32; 2]>,
    /// Overrides of the scenes' own settings.
    pub(super) settings: Settings,
    /// Whether pressure and energy of every particle are recorded.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(super) fields: bool,
    /// The kind of device, unless the processor.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) device: Option<String>,
}

/// Initial conditions of a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Start {
    /// The scene's id.
    pub id: u64,
    /// The materials that occur.
    pub materials: Vec<Material>,
    /// Substeps per frame.
    pub substeps: u32,
    /// The scene, as in a scene file.
    pub scene: Scene,
}

impl Start {
    /// The initial conditions of a simulation.
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

/// Energy of the particles at times spread evenly over a scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnergyCurve {
    /// Simulated time (s).
    time: Vec<f64>,
    /// Kinetic energy (density x domain lengths^4 per s^2, like the others).
    kinetic: Vec<f32>,
    /// Elastic energy.
    elastic: Vec<f32>,
    /// Potential energy relative to the floor of the domain.
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

    /// The curve with at most [`CURVE_POINTS`] points, including the first and the last.
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
pub struct Finished {
    /// Its initial conditions.
    #[serde(flatten)]
    pub start: Start,
    /// Intervals that needed more substeps per frame than the start of the scene: their numbers and substeps, as
    /// [`Simulation::refined`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub refined: Vec<[u64; 2]>,
    /// Number of recorded frames.
    pub frames: u64,
    /// The energy over time.
    pub energy: EnergyCurve,
    /// SHA-256 of the concatenated CDR bytes of all frames.
    pub sha256: String,
}

/// The manifest of a directory.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Manifest {
    /// The directory.
    #[serde(skip)]
    output: PathBuf,
    /// In a store: the version that was read or written last; none before the first.
    #[serde(skip)]
    version: Option<Version>,
    request: RecordedRequest,
    /// The finished scenes, by id.
    scenes: Vec<Finished>,
}

impl Manifest {
    /// The manifest of a directory, or an empty one if there is none yet. Rejects the manifest of another request.
    pub(super) fn open(output: &Path, request: &RecordedRequest) -> Result<Self, SimulateError> {
        let output = output.to_owned();
        match read(&path(&output))? {
            Some(found) => found.of(request, path(&output)).map(|found| Self { output, ..found }),
            None => {
                Ok(Self { output, version: None, request: request.clone(), scenes: Vec::new() })
            }
        }
    }

    /// Itself if it is of this request.
    fn of(self, request: &RecordedRequest, file: PathBuf) -> Result<Self, SimulateError> {
        if self.request == *request {
            return Ok(self);
        }
        // Through text, since a value made directly has single-precision numbers with the digits of double precision.
        let value = |request| serde_json::from_str(&serde_json::to_string(request)?);
        let [there, here] = [&self.request, request].map(value);
        let invalid = |reason| SimulateError::NoManifest { file: file.clone(), reason };
        let (there, here) = (there.map_err(invalid)?, here.map_err(invalid)?);
        let mut fields = Vec::new();
        differences("", &there, &here, &mut fields);
        Err(SimulateError::OtherRequest { file, fields })
    }

    /// The directory.
    pub(super) fn output(&self) -> &Path {
        &self.output
    }

    /// The finished scene with this id, here or in its file.
    pub(super) fn scene(&self, id: u64) -> Result<Option<Finished>, SimulateError> {
        if let Some(found) = self.scenes.iter().find(|scene| scene.start.id == id) {
            return Ok(Some(found.clone()));
        }
        let file = entry(&self.output, id);
        let Some(found) = read(&file)? else { return Ok(None) };
        Ok(found.of(&self.request, file)?.scenes.into_iter().find(|scene| scene.start.id == id))
    }

    /// Enters the scenes that have a file of their own, if their bags are there. Whether there are any. In a store there are none:
    /// its directories are not shared.
    pub(super) fn collect(&mut self) -> Result<bool, SimulateError> {
        if is_remote(&self.output) {
            return Ok(false);
        }
        let folder = self.output.join(INCOMPLETE);
        let io = || SimulateError::io("read", &folder);
        let mut collected = false;
        for found in fs::read_dir(&folder).map_err(io())? {
            let file = found.map_err(io())?.path();
            if file.extension().is_none_or(|extension| extension != "json") {
                continue;
            }
            let Some(found) = read(&file)? else { continue };
            for scene in found.of(&self.request, file)?.scenes {
                if self.output.join(directory(scene.start.id)).exists() {
                    self.insert(scene);
                    collected = true;
                }
            }
        }
        Ok(collected)
    }

    /// Writes a scene to a file of its own.
    pub(super) fn save_entry(&self, scene: &Finished) -> Result<(), SimulateError> {
        let file = entry(&self.output, scene.start.id);
        let (request, scenes) = (self.request.clone(), vec![scene.clone()]);
        let text = Self { output: PathBuf::new(), version: None, request, scenes }.text(&file)?;
        atomic::replace(&file, text.as_bytes()).map_err(SimulateError::io("write", &file))
    }

    /// Adds a scene, or replaces the one with its id.
    pub(super) fn insert(&mut self, scene: Finished) {
        self.scenes.retain(|other| other.start.id != scene.start.id);
        self.scenes.push(scene);
        self.scenes.sort_by_key(|scene| scene.start.id);
    }

    /// Replaces the manifest atomically; in a store, unless another process has replaced it. On a disk the folder of unfinished
    /// bags must exist: the new manifest is written there, where a killed process leaves nothing that is not removed later.
    pub(super) fn save(&mut self) -> Result<(), SimulateError> {
        let path = path(&self.output);
        let text = self.text(&path)?.into_bytes();
        if !is_remote(&path) {
            let unfinished = self.output.join(INCOMPLETE).join(UNFINISHED);
            return atomic::write_synced(&unfinished, &text)
                .and_then(|()| atomic::rename(&unfinished, &path))
                .map_err(SimulateError::io("write", &path));
        }
        match eddy_storage::replace(&path, text, self.version.as_ref()) {
            Ok(version) => self.version = Some(version),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                return Err(SimulateError::Changed { output: self.output.clone() });
            }
            Err(error) => return Err(SimulateError::io("write", &path)(error)),
        }
        Ok(())
    }

    /// JSON with one line per scene, for readability; `path` is the file that it is for.
    fn text(&self, path: &Path) -> Result<String, SimulateError> {
        let invalid = |reason| SimulateError::NoManifest { file: path.to_owned(), reason };
        let scenes: Vec<String> = self
            .scenes
            .iter()
            .map(serde_json::to_string)
            .collect::<serde_json::Result<_>>()
            .map_err(invalid)?;
        Ok(format!(
            "{{\n\"request\": {},\n\"scenes\": [\n{}\n]\n}}\n",
            serde_json::to_string(&self.request).map_err(invalid)?,
            scenes.join(",\n")
        ))
    }
}

/// The scenes in the manifests beside bags; each manifest is read once.
#[derive(Debug, Default)]
pub struct ScenesBeside(HashMap<PathBuf, BTreeMap<u64, Scene>>);

impl ScenesBeside {
    /// The scene that a stream of a bag was simulated from; `None` without a manifest that has it.
    ///
    /// # Errors
    /// A manifest that cannot be read.
    pub fn of(&mut self, bag: &Path, stream: u64) -> Result<Option<&Scene>, SimulateError> {
        let folder = bag.parent().unwrap_or(bag);
        if !self.0.contains_key(folder) {
            let found = recorded_scenes(folder)?.unwrap_or_default();
            self.0.insert(folder.to_owned(), found);
        }
        Ok(self.0.get(folder).and_then(|scenes| scenes.get(&stream)))
    }

    /// A quantity of a stream, if `eddy simulate` has written its bag: its manifest must have the scene, and the bag its name.
    pub(crate) fn quantity(&mut self, bag: &Path, stream: u64, quantity: Quantity) -> Option<f32> {
        if bag.file_name()? != directory(stream).as_str() {
            return None;
        }
        match self.of(bag, stream) {
            Ok(scene) => scene.map(|scene| of_scene(scene, quantity)),
            Err(error) => {
                // A network that needs the stiffness reports that it is missing.
                tracing::debug!("{error}: stiffness and gravity of its scenes are not known");
                self.0.insert(bag.parent()?.to_owned(), BTreeMap::new());
                None
            }
        }
    }
}

/// A quantity of the matter in a scene.
pub(super) fn of_scene(scene: &Scene, quantity: Quantity) -> f32 {
    match quantity {
        Quantity::Stiffness => scene.materials.stiffness,
        Quantity::Gravity => scene.solver.gravity,
    }
}

/// The scenes in the manifest of a directory, by id; `None` without a manifest.
///
/// # Errors
/// [`SimulateError::Io`], [`SimulateError::NoManifest`].
pub fn recorded_scenes(directory: &Path) -> Result<Option<BTreeMap<u64, Scene>>, SimulateError> {
    let Some(Manifest { scenes, .. }) = read(&path(directory))? else { return Ok(None) };
    let scenes = scenes.into_iter().map(|Finished { start, .. }| (start.id, start.scene));
    Ok(Some(scenes.collect()))
}

/// A manifest, or the file of a scene; `None` if it does not exist.
fn read(file: &Path) -> Result<Option<Manifest>, SimulateError> {
    let failed = || SimulateError::io("read", file);
    let (text, version) = if is_remote(file) {
        let found = eddy_storage::read_version(file).map_err(failed())?;
        let Some((text, version)) = found else { return Ok(None) };
        (text, Some(version))
    } else {
        match fs::read(file) {
            Ok(text) => (text, None),
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(reason) => return Err(failed()(reason)),
        }
    };
    let mut found: Manifest = serde_json::from_slice(&text)
        .map_err(|reason| SimulateError::NoManifest { file: file.to_owned(), reason })?;
    for scene in &mut found.scenes {
        older_form::read(&mut scene.start.scene, file.display());
    }
    Ok(Some(Manifest { version, ..found }))
}

/// Adds the fields in which two values differ, such as `settings.duration 2.0 instead of 4.0`.
fn differences(prefix: &str, one: &Value, other: &Value, fields: &mut Vec<String>) {
    let (Value::Object(one), Value::Object(other)) = (one, other) else {
        if one != other {
            let shown = |value: &Value| match value {
                Value::Null => "the default".to_owned(),
                value => value.to_string(),
            };
            fields.push(format!("{prefix} {} instead of {}", shown(one), shown(other)));
        }
        return;
    };
    let keys: BTreeSet<&String> = one.keys().chain(other.keys()).collect();
    for key in keys {
        let path = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
        let value = |map: &serde_json::Map<String, Value>| map.get(key).cloned();
        let [one, other] = [one, other].map(|map| value(map).unwrap_or(Value::Null));
        differences(&path, &one, &other, fields);
    }
}

/// The manifest of a directory.
pub(super) fn path(directory: &Path) -> PathBuf {
    directory.join(NAME)
}

/// The file of a scene that is not in the manifest yet.
fn entry(output: &Path, id: u64) -> PathBuf {
    output.join(INCOMPLETE).join(directory(id) + ".json")
}
