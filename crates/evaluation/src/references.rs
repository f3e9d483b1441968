//! Solvers that predict beside models, and what they need: the scenes that streams were simulated from, by the
//! manifests beside their bags.

use std::{
    collections::{BTreeMap, HashMap},
    path::PathBuf,
};

use rayon::prelude::*;

use super::{EvalError, EvaluationError, Predictor, Restart, chaos};
use crate::dataset::{Trajectory, simulate::recorded_scenes};
use eddy_mpm::Scene;

/// A solver that predicts beside models and trivial predictors, from the same frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reference {
    /// The solver restarted from positions and velocities, with each of [`Restart::ALL`].
    Restart,
    /// The truth from positions that are slightly off: [`chaos`].
    Chaos,
}

/// The solvers that predict, of those asked for, with what they need.
pub(super) struct References {
    /// For each stream the scene it was simulated from; `None` where no solver needs it.
    pub(super) scenes: Vec<Option<Scene>>,
    /// The solvers.
    pub(super) predictors: Vec<Predictor<'static>>,
    /// Why others do not predict.
    pub(super) notes: Vec<String>,
}

impl References {
    /// Finds the scene of every stream. If one has none, no solver predicts: all are evaluated on the
    /// same frames. A restart that has no grid in one of the scenes is left out.
    pub(super) fn new(
        asked: &[Reference],
        streams: &[Trajectory],
    ) -> Result<Self, EvaluationError> {
        let none =
            |notes| Self { scenes: vec![None; streams.len()], predictors: Vec::new(), notes };
        if asked.is_empty() {
            return Ok(none(Vec::new()));
        }
        let scenes = match scenes(streams)? {
            Ok(scenes) => scenes,
            Err(reason) => return Ok(none(vec![format!("no rivals: {reason}")])),
        };
        let (mut predictors, mut notes) = (Vec::new(), Vec::new());
        for restart in Restart::ALL.into_iter().filter(|_| asked.contains(&Reference::Restart)) {
            let hindrance = |(stream, scene): (&Trajectory, &Scene)| {
                let reason = restart.grid(scene).err()?;
                Some(format!("no {}: {}: {reason}", restart.name(), stream.source.display()))
            };
            match streams.iter().zip(&scenes).find_map(hindrance) {
                Some(note) => notes.push(note),
                None => predictors.push(Predictor::Restart(restart)),
            }
        }
        if asked.contains(&Reference::Chaos) {
            predictors.push(Predictor::Chaos);
        }
        let scenes = scenes.into_iter().map(Some).collect();
        Ok(Self { scenes, predictors, notes })
    }
}

/// The scene of each stream, or why one has none.
fn scenes(streams: &[Trajectory]) -> Result<Result<Vec<Scene>, String>, EvaluationError> {
    let mut manifests: HashMap<PathBuf, BTreeMap<u64, Scene>> = HashMap::new();
    let mut scenes = Vec::new();
    for stream in streams {
        let folder = stream.source.parent().unwrap_or(&stream.source).to_owned();
        if !manifests.contains_key(&folder) {
            let found = recorded_scenes(&folder)?.unwrap_or_default();
            manifests.insert(folder.clone(), found);
        }
        let scene = manifests.get(&folder).and_then(|manifest| manifest.get(&stream.id));
        let Some(scene) = scene else {
            let (id, bag) = (stream.id, stream.source.display());
            return Ok(Err(format!(
                "{bag}: stream {id}: found no manifest.json beside the bag that has its scene, expected \
                 that of `eddy simulate`"
            )));
        };
        if !(scene.emitters.is_empty() && scene.drains.is_empty()) {
            let bag = stream.source.display();
            return Ok(Err(format!(
                "{bag}: found emitters or drains in its scene, expected particles that stay"
            )));
        }
        scenes.push(scene.clone());
    }
    let differs = |(stream, scene): (&Trajectory, &Scene)| {
        let same = || -> Result<bool, EvaluationError> {
            let invalid = |reason| EvalError::Rival { stream: stream.id, reason };
            Ok(chaos::is_scene_of(scene, &stream.cut(0..1)?).map_err(invalid)?)
        };
        match same() {
            Ok(true) => None,
            Ok(false) => Some(Ok(stream.source.display().to_string())),
            Err(error) => Some(Err(error)),
        }
    };
    let pairs: Vec<_> = streams.iter().zip(&scenes).collect();
    match pairs.into_par_iter().find_map_first(differs) {
        None => Ok(Ok(scenes)),
        Some(Err(error)) => Err(error),
        Some(Ok(bag)) => Ok(Err(format!(
            "{bag}: found another first frame than its scene in manifest.json gives, expected the same"
        ))),
    }
}
