//! Reference solvers, and the scenes that they need: those the streams were simulated from, read from the manifests
//! beside the bags.

use rayon::prelude::*;

use super::{
    EvalError, EvaluationError, Predictor, Restart, chaos,
    reproduction::{FRAMES, Reproduction, reproduction},
};
use eddy_dataset::{Trajectory, simulate::ScenesBeside};
use eddy_mpm::Scene;

/// A solver that predicts from the same frames as the models.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reference {
    /// The solver restarted from positions and velocities, with each of [`Restart::ALL`].
    Restart,
    /// The true simulation from slightly displaced positions, see [`chaos`].
    Chaos,
}

/// The requested solvers that can run, with their scenes.
pub(super) struct References {
    /// The scene of each stream; `None` when no solver needs it.
    pub(super) scenes: Vec<Option<Scene>>,
    /// The solvers that can run.
    pub(super) predictors: Vec<Predictor<'static>>,
    /// Why the others cannot.
    pub(super) notes: Vec<String>,
}

impl References {
    /// Finds the scene of every stream. If one is missing, no solver runs, since all predictors are evaluated on the
    /// same frames. A restart without a grid in one of the scenes is excluded.
    pub(super) fn new(
        requested: &[Reference],
        streams: &[Trajectory],
    ) -> Result<Self, EvaluationError> {
        let none =
            |notes| Self { scenes: vec![None; streams.len()], predictors: Vec::new(), notes };
        if requested.is_empty() {
            return Ok(none(Vec::new()));
        }
        let without = |reason| Ok(none(vec![format!("no reference solvers: {reason}")]));
        let scenes = match scenes(streams)? {
            Ok(scenes) => scenes,
            Err(reason) => return without(reason),
        };
        let reproductions = reproductions(streams, &scenes)?;
        let first_that_is = |wanted| {
            let number = reproductions.iter().position(|&found| found == wanted)?;
            Some(streams[number].source.display())
        };
        if let Some(bag) = first_that_is(Reproduction::Different) {
            return without(format!(
                "{bag}: the first frames differ from those that its scene in manifest.json gives"
            ));
        }
        let (mut predictors, mut notes) = (Vec::new(), Vec::new());
        for restart in Restart::ALL.into_iter().filter(|_| requested.contains(&Reference::Restart))
        {
            let obstacle = |(stream, scene): (&Trajectory, &Scene)| {
                let reason = restart.grid(scene).err()?;
                Some(format!("no {}: {}: {reason}", restart.name(), stream.source.display()))
            };
            match streams.iter().zip(&scenes).find_map(obstacle) {
                Some(note) => notes.push(note),
                None => predictors.push(Predictor::Restart(restart)),
            }
        }
        if requested.contains(&Reference::Chaos) {
            match first_that_is(Reproduction::Rounded) {
                Some(bag) => notes.push(format!(
                    "no {}: {bag}: simulating its scene gives other bits, as after `eddy simulate --device cuda`",
                    chaos::NAME
                )),
                None => predictors.push(Predictor::Chaos),
            }
        }
        let scenes = scenes.into_iter().map(Some).collect();
        Ok(Self { scenes, predictors, notes })
    }
}

/// The scene of each stream, or why one has none.
fn scenes(streams: &[Trajectory]) -> Result<Result<Vec<Scene>, String>, EvaluationError> {
    let mut beside = ScenesBeside::default();
    let mut scenes = Vec::new();
    for stream in streams {
        let Some(scene) = beside.of(&stream.source, stream.id)? else {
            let (id, bag) = (stream.id, stream.source.display());
            return Ok(Err(format!(
                "{bag}: stream {id}: no manifest.json of `eddy simulate` with its scene beside the bag"
            )));
        };
        let bag = stream.source.display();
        if !(scene.emitters.is_empty() && scene.drains.is_empty()) {
            return Ok(Err(format!(
                "{bag}: its scene has emitters or drains; reference solvers need a fixed set of particles"
            )));
        }
        if !scene.tools.is_empty() {
            return Ok(Err(format!(
                "{bag}: its scene has tools, which reference solvers do not move"
            )));
        }
        scenes.push(scene.clone());
    }
    Ok(Ok(scenes))
}

/// Whether each stream is that of its scene.
fn reproductions(
    streams: &[Trajectory],
    scenes: &[Scene],
) -> Result<Vec<Reproduction>, EvaluationError> {
    let pairs: Vec<_> = streams.iter().zip(scenes).collect();
    let compare = |(stream, scene): (&Trajectory, &Scene)| {
        let first = stream.cut(0..stream.frames.min(FRAMES))?;
        let invalid = |reason| EvalError::Solver { stream: stream.id, reason };
        Ok(reproduction(scene, &first).map_err(invalid)?)
    };
    pairs.into_par_iter().map(compare).collect()
}
