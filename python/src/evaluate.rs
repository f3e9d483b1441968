//! `evaluate`, `evaluation_starts` and `skill`: predictions beside the truth and the best trivial predictor.

use std::{collections::BTreeMap, num::NonZeroUsize, path::PathBuf, sync::Mutex};

use eddy_dataset::{LoadOptions, available_memory, load_trajectories};
use eddy_evaluation::{
    Evaluation, EvaluationRequest, Recorded, Reference, Settings, position_skill,
};
use eddy_inference::checkpoint::Checkpoint;
use eddy_messages::UnusableFrame;
use pyo3::{prelude::*, types::PyDict};

use crate::{
    arrays::{Argument, array, wrong},
    errors::{EvaluationError, raise},
    frame::Frame,
    interrupt, lock,
    values::{self, Paths},
};
use eddy_frames::State;

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

    /// The tables that `eddy eval` prints, in lines of at most `columns` characters.
    #[pyo3(signature = (columns=80))]
    fn tables(&self, columns: usize) -> String {
        self.inner.tables(columns)
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

/// What is evaluated, as Python gives it.
struct Request {
    data: Vec<PathBuf>,
    checkpoints: Vec<PathBuf>,
    /// Names and bags of recorded rollouts.
    predictions: BTreeMap<String, PathBuf>,
    settings: Settings,
    references: Vec<Reference>,
    stiffness: Option<f32>,
    threads: Option<NonZeroUsize>,
    skip_streams: bool,
}

impl Request {
    /// Loads what it names, and begins. Streams that were skipped are added to `skipped`.
    fn begin(
        self,
        watch: &interrupt::Watch<()>,
        skipped: &Mutex<Vec<UnusableFrame>>,
    ) -> Result<Evaluation, String> {
        let load = |path: &PathBuf| {
            let checkpoint =
                Checkpoint::load_or_shipped(Some(path)).map_err(|error| error.to_string())?;
            Ok::<_, String>((path.display().to_string(), checkpoint))
        };
        let mut checkpoints = self.checkpoints.iter().map(load).collect::<Result<Vec<_>, _>>()?;
        if checkpoints.is_empty() {
            let shipped = Checkpoint::shipped().map_err(|error| error.to_string())?;
            checkpoints.push(("shipped".to_owned(), shipped));
        }
        let open = |(name, path): (String, PathBuf)| Recorded::open(name, &path);
        let recorded = self.predictions.into_iter().map(open).collect::<Result<_, _>>();
        let recorded = recorded.map_err(|error| error.to_string())?;
        let skip_streams = self.skip_streams;
        let options = LoadOptions { memory: available_memory() / 2, skip_streams };
        let loaded = load_trajectories(&self.data, options, &mut |_, _| ());
        let loaded = loaded.map_err(|error| values::refused(&error, skip_streams))?;
        *lock(skipped) = loaded.skipped;
        let request = EvaluationRequest {
            checkpoints,
            recorded,
            streams: loaded.streams,
            stiffness: self.stiffness,
            settings: self.settings,
            references: self.references,
            join_late: false,
            threads: self.threads,
        };
        Evaluation::new(request, watch).map_err(|error| error.to_string())
    }

    /// Begins, and does something with the evaluation. Streams that were skipped are warned of.
    fn run<T: Send>(
        self,
        py: Python<'_>,
        then: impl FnOnce(Evaluation, &interrupt::Watch<()>) -> Result<T, String> + Send,
    ) -> PyResult<T> {
        let skipped = Mutex::new(Vec::<UnusableFrame>::new());
        let work = |watch: &interrupt::Watch<()>| then(self.begin(watch, &skipped)?, watch);
        let outcome = interrupt::run(py, |_, ()| Ok(()), work)?;
        values::warn_of_skipped(py, lock(&skipped).as_slice())?;
        outcome.map_err(raise::<EvaluationError>)
    }
}

/// Evaluates checkpoints on the bags at `data` by free rollouts over `horizon` frames from `starts` frames of each stream.
/// Streams that a checkpoint was trained on are left out. `predictions` are bags with rollouts of other predictors by name, as
/// `BagWriter.write_prediction` writes them from the frames that `evaluation_starts` names. `references` may hold `mpm` (the solver restarted from the same frames) and
/// `chaos` (from slightly displaced ones). `stiffness` is that of all streams (Young's modulus, density x velocity^2), for checkpoints
/// that are conditioned on it; by default what the metadata.yaml of each bag states (`eddy_stiffness` of `custom_data`), otherwise the manifest.json beside it, otherwise what the checkpoint assumes. Without checkpoints, the particle model of the package is evaluated. `skip_streams` leaves out streams
/// with a frame that cannot be used, each with a warning, instead of raising.
#[pyfunction]
#[pyo3(signature = (data, checkpoints=None, *, predictions=BTreeMap::new(), horizon=100, starts=7, stiffness=None, references=Vec::new(), threads=None, skip_streams=false))]
#[expect(clippy::too_many_arguments, reason = "the options of an evaluation")]
pub(crate) fn evaluate(
    py: Python<'_>,
    data: Paths,
    checkpoints: Option<Paths>,
    predictions: BTreeMap<String, PathBuf>,
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
    let request = Request {
        data: data.into(),
        checkpoints: checkpoints.map(Paths::into).unwrap_or_default(),
        predictions,
        settings: Settings::full(horizon, starts),
        references: references.iter().map(reference).collect::<PyResult<_>>()?,
        stiffness,
        threads,
        skip_streams,
    };
    let report = request
        .run(py, |evaluation, watch| evaluation.run(watch).map_err(|error| error.to_string()))?;
    Ok(Report { inner: report })
}

/// The frames that the rollouts of `evaluate` with the same arguments begin after: for each stream a dictionary with its `bag`, its
/// number `stream` and the `sequences` of the last observed frames. Another predictor is judged on rollouts from these.
#[pyfunction]
#[pyo3(signature = (data, checkpoints=None, *, horizon=100, starts=7, stiffness=None, skip_streams=false))]
pub(crate) fn evaluation_starts<'py>(
    py: Python<'py>,
    data: Paths,
    checkpoints: Option<Paths>,
    horizon: usize,
    starts: usize,
    stiffness: Option<f32>,
    skip_streams: bool,
) -> PyResult<Vec<Bound<'py, PyDict>>> {
    let request = Request {
        data: data.into(),
        checkpoints: checkpoints.map(Paths::into).unwrap_or_default(),
        predictions: BTreeMap::new(),
        settings: Settings::full(horizon, starts),
        references: Vec::new(),
        stiffness,
        threads: None,
        skip_streams,
    };
    let streams = request.run(py, |evaluation, _| {
        let starts = evaluation.starts();
        Ok(starts.map(|(bag, stream, sequences)| (bag.to_owned(), stream, sequences)).collect())
    })?;
    let streams: Vec<(PathBuf, u64, Vec<u64>)> = streams;
    let entry = |(bag, stream, sequences): (PathBuf, u64, Vec<u64>)| {
        let entry = PyDict::new(py);
        entry.set_item("bag", bag)?;
        entry.set_item("stream", stream)?;
        entry.set_item("sequences", sequences)?;
        Ok(entry)
    };
    streams.into_iter().map(entry).collect()
}

/// Skill of predictions from any source, float64 [T]: 1 - e / e0 for each frame ahead, where e is the squared position error over all
/// rollouts and particles, and e0 that of the best trivial predictor (persistence, constant velocity, ballistic with
/// walls, without tools, which `evaluate` knows) from the same frames. `starts` are the W last observed frames; `truth` and `predicted` are positions, float32
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
