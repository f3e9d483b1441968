//! `evaluate` and `skill`: predictions beside the truth and the best trivial predictor.

use std::{num::NonZeroUsize, path::PathBuf, sync::Mutex};

use eddy_dataset::{LoadOptions, available_memory, load_trajectories};
use eddy_evaluation::{Evaluation, EvaluationRequest, Reference, Settings, position_skill};
use eddy_inference::checkpoint::Checkpoint;
use pyo3::prelude::*;

use crate::{
    arrays::{Argument, array, wrong},
    errors::{EvaluationError, raise},
    frame::Frame,
    interrupt, lock,
    values::{self, Paths},
};
use eddy_frames::State;

/// Width of the lines of tables (characters).
const TABLE_COLUMNS: usize = 80;

/// The result of an evaluation.
#[pyclass(frozen, module = "eddy")]
pub(crate) struct Report {
    inner: eddy_evaluation::Report,
}

#[pymethods]
impl Report {
    /// Everything that `report.json` holds.
    fn to_dict<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        values::render(py, &self.inner)
    }

    /// The tables that `eddy eval` prints.
    fn tables(&self) -> String {
        self.inner.tables(TABLE_COLUMNS)
    }

    /// Writes report.html, report.json and tables into a folder.
    fn save(&self, py: Python<'_>, folder: PathBuf) -> PyResult<()> {
        py.detach(|| self.inner.save(&folder))
            .map_err(|error| raise::<EvaluationError>(format!("{}: {error}", folder.display())))
    }

    fn __repr__(&self) -> String {
        let eddy_evaluation::Report { streams, windows, horizon, .. } = &self.inner;
        format!("Report(streams={streams}, windows={windows}, horizon={horizon})")
    }
}

/// Evaluates checkpoints on the bags at `data` by free rollouts over `horizon` frames from `starts` frames of each stream.
/// Streams that a checkpoint was trained on are left out. `references` may hold `mpm` (the solver restarted from the same frames) and
/// `chaos` (from slightly displaced ones). `stiffness` is that of all streams (Young's modulus, density x velocity^2), for checkpoints
/// that are conditioned on it; by default what the metadata.yaml of each bag states (`eddy_stiffness` of `custom_data`), otherwise the manifest.json beside it, otherwise what the checkpoint assumes. Without checkpoints, the particle model of the package is evaluated. `skip_streams` leaves out streams
/// with a frame that cannot be used, each with a warning, instead of raising.
#[pyfunction]
#[pyo3(signature = (data, checkpoints=None, *, horizon=100, starts=7, stiffness=None, references=Vec::new(), threads=None, skip_streams=false))]
#[expect(clippy::too_many_arguments, reason = "the options of an evaluation")]
pub(crate) fn evaluate(
    py: Python<'_>,
    data: Paths,
    checkpoints: Option<Paths>,
    horizon: usize,
    starts: usize,
    stiffness: Option<f32>,
    references: Vec<String>,
    threads: Option<usize>,
    skip_streams: bool,
) -> PyResult<Report> {
    let threads = match threads {
        None => None,
        Some(threads) => {
            Some(NonZeroUsize::new(threads).ok_or_else(|| wrong("threads", 0, "at least 1"))?)
        }
    };
    let reference = |name: &String| match name.as_str() {
        "mpm" => Ok(Reference::Restart),
        "chaos" => Ok(Reference::Chaos),
        other => Err(wrong("references", other, "mpm or chaos")),
    };
    let references = references.iter().map(reference).collect::<PyResult<Vec<_>>>()?;
    let checkpoints: Vec<PathBuf> = checkpoints.map(Paths::into).unwrap_or_default();
    let data: Vec<PathBuf> = data.into();
    let skipped = Mutex::new(Vec::new());
    let work = |watch: &interrupt::Watch<()>| -> Result<eddy_evaluation::Report, String> {
        let load = |path: &PathBuf| {
            let checkpoint = Checkpoint::load(path).map_err(|error| error.to_string())?;
            Ok::<_, String>((path.display().to_string(), checkpoint))
        };
        let mut models = checkpoints.iter().map(load).collect::<Result<Vec<_>, _>>()?;
        if models.is_empty() {
            let shipped = Checkpoint::shipped().map_err(|error| error.to_string())?;
            models.push(("shipped".to_owned(), shipped));
        }
        let options = LoadOptions { memory: available_memory() / 2, skip_streams };
        let loaded = load_trajectories(&data, options, &mut |_, _| ());
        let loaded = loaded.map_err(|error| values::refused(&error, skip_streams))?;
        *lock(&skipped) = loaded.skipped;
        let request = EvaluationRequest {
            checkpoints: models,
            recorded: Vec::new(),
            streams: loaded.streams,
            stiffness,
            settings: Settings::full(horizon, starts),
            references,
            join_late: false,
            threads,
        };
        let evaluation = Evaluation::new(request, watch).map_err(|error| error.to_string())?;
        evaluation.run(watch).map_err(|error| error.to_string())
    };
    let outcome = interrupt::run(py, |_, ()| Ok(()), work)?;
    values::warn_of_skipped(py, &lock(&skipped))?;
    Ok(Report { inner: outcome.map_err(raise::<EvaluationError>)? })
}

/// Skill of predictions from any source, float64 [T]: 1 - e / e0 for each frame ahead, where e is the squared position error over all
/// rollouts and particles, and e0 that of the best trivial predictor (persistence, constant velocity, ballistic with
/// walls) from the same frames. `starts` are the W last observed frames; `truth` and `predicted` are positions, float32
/// [W, T, N, 2]. Gravity is in domain lengths per s^2.
#[pyfunction]
#[pyo3(signature = (starts, truth, predicted, *, gravity=[0.0, -9.8]))]
pub(crate) fn skill<'py>(
    py: Python<'py>,
    starts: Vec<Bound<'py, Frame>>,
    truth: &Bound<'py, PyAny>,
    predicted: &Bound<'py, PyAny>,
    gravity: [f32; 2],
) -> PyResult<Bound<'py, PyAny>> {
    let starts = starts.iter().enumerate();
    let starts: Vec<&eddy_frames::Frame> = starts
        .map(|(index, frame)| frame.get().plane(&format!("starts[{index}]")))
        .collect::<PyResult<_>>()?;
    let Some(first) = starts.first() else {
        return Err(wrong("starts", "no frames", "at least 1"));
    };
    let particles = first.len();
    if let Some(index) = starts.iter().position(|frame| frame.len() != particles) {
        let found = format!("{} particles", starts[index].len());
        return Err(wrong(&format!("starts[{index}]"), found, format!("{particles}")));
    }
    let shape = [Some(starts.len()), None, Some(particles), Some(2)];
    let truth = Argument::<f32>::new("truth", truth, &shape)?;
    let horizon = truth.shape()[1];
    if horizon == 0 {
        return Err(wrong("truth", "0 frames", "at least 1"));
    }
    let shape = [Some(starts.len()), Some(horizon), Some(particles), Some(2)];
    let predicted = Argument::<f32>::new("predicted", predicted, &shape)?;
    let (truth, predicted) = (truth.rows(), predicted.rows());
    let states: Vec<State> = starts
        .iter()
        .map(|frame| State { position: frame.position.clone(), velocity: frame.velocity.clone() })
        .collect();
    let dt = first.dt;
    let skills = py.detach(|| position_skill(&states, truth, predicted, dt, gravity));
    Ok(array(py, skills, [horizon]))
}
