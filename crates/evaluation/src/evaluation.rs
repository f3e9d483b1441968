//! A whole evaluation: checkpoints, trivial predictors and solvers on the same frames, their time per frame, and the
//! report.

use std::{
    num::NonZeroUsize,
    path::{Path, PathBuf},
};

use rayon::{ThreadPoolBuildError, prelude::*};

use super::{
    Cost, EvalError, EvaluationResults, Kind, Origin, Predictor, PredictorInfo, Recorded, Report,
    Role, SceneResult, Settings, Snapshot, chaos, cost, evaluate_scene,
    references::{Reference, References},
    selection::Selection,
    side_by_side::rollout_threads,
    snapshot::snapshot,
};
use eddy_dataset::{DatasetError, Stream, Trajectory, simulate::SimulateError};
use eddy_frames::progress::Progress;
use eddy_inference::{
    checkpoint::Checkpoint,
    engine::{ModelError, Surrogate, WarningCounts, warnings},
};
use eddy_mpm::Scene;
use eddy_pages::Provenance;

/// Maximum number of models whose rollouts are shown as pictures.
const PICTURED_MODELS: usize = 4;
/// Maximum number of threads.
const MAX_THREADS: usize = 1024;

/// The checkpoints to evaluate, the data and the settings.
#[derive(Clone, Debug)]
pub struct EvaluationRequest {
    /// Checkpoints with their paths.
    pub checkpoints: Vec<(String, Checkpoint)>,
    /// Rollouts that other programs have recorded.
    pub recorded: Vec<Recorded>,
    /// Streams; those that a checkpoint was trained on are excluded.
    pub streams: Vec<Trajectory>,
    /// Young's modulus of all streams (density x velocity^2), for checkpoints with the stiffness as an input; by default that of each stream.
    pub stiffness: Option<f32>,
    /// Horizon, starts and measures.
    pub settings: Settings,
    /// Solvers that predict from the same frames.
    pub references: Vec<Reference>,
    /// Whether each checkpoint is also evaluated on streams that it joins in the middle.
    pub join_late: bool,
    /// Streams evaluated in parallel; by default one per core, or more with models on a device.
    pub threads: Option<NonZeroUsize>,
}

/// Why checkpoints cannot be evaluated.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    /// A number of the request is out of range.
    #[error("{field}: found {found}, expected {expected}")]
    Request {
        /// Field of [`EvaluationRequest`].
        field: &'static str,
        /// Its value.
        found: usize,
        /// What it should be.
        expected: &'static str,
    },
    /// The threads cannot be started.
    #[error("threads: {0}")]
    Threads(#[from] ThreadPoolBuildError),
    /// A checkpoint cannot be loaded as a model.
    #[error("{checkpoint}: {reason}")]
    Checkpoint {
        /// Its path.
        checkpoint: String,
        /// Why.
        reason: Box<ModelError>,
    },
    /// A checkpoint cannot predict a stream.
    #[error("{checkpoint}: {}: stream {stream}: {reason}", bag.display())]
    Stream {
        /// The checkpoint's path.
        checkpoint: String,
        /// The stream's bag.
        bag: PathBuf,
        /// The stream.
        stream: u64,
        /// Why.
        reason: Box<ModelError>,
    },
    /// Every stream was used to train a checkpoint.
    #[error(
        "data: every stream was used to train a checkpoint (training or validation part); \
         evaluate on other data"
    )]
    Seen,
    /// The streams cannot be evaluated.
    #[error(transparent)]
    Eval(#[from] EvalError),
    /// A stream cannot be evaluated.
    #[error("{}: {reason}", bag.display())]
    Scene {
        /// Its bag.
        bag: PathBuf,
        /// Why.
        reason: Box<Self>,
    },
    /// The given stiffness is invalid, or no checkpoint has it as an input.
    #[error("stiffness: found {found}, expected {expected}")]
    Stiffness {
        /// The stiffness.
        found: String,
        /// What it should be.
        expected: &'static str,
    },
    /// A checkpoint has the stiffness as an input, and that of a stream is not known.
    #[error("{0}, or `stiffness` given for all streams")]
    UnknownStiffness(DatasetError),
    /// A bag cannot be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The manifest beside a bag cannot be read.
    #[error(transparent)]
    Manifest(#[from] SimulateError),
    /// The evaluation was cancelled.
    #[error("interrupted")]
    Cancelled,
}

impl EvaluationError {
    pub(super) fn request(field: &'static str, found: usize, expected: &'static str) -> Self {
        Self::Request { field, found, expected }
    }
}

impl EvaluationRequest {
    /// Checks the ranges of the numbers.
    fn check(&self) -> Result<(), EvaluationError> {
        let Settings { horizon, starts, .. } = self.settings;
        let threads = self.threads.map_or(1, NonZeroUsize::get);
        for (field, found, range, expected) in [
            ("horizon", horizon, 1..=usize::MAX, "at least 1 frame"),
            ("starts", starts, 1..=usize::MAX, "at least 1 per stream"),
            ("threads", threads, 1..=MAX_THREADS, "1 to 1024"),
        ] {
            if !range.contains(&found) {
                return Err(EvaluationError::request(field, found, expected));
            }
        }
        Ok(())
    }
}

/// Checks that every model can predict every stream. Returns how streams differ from what the models were trained on, one
/// sentence each.
fn check_fits(
    names: &[String],
    models: &[Surrogate],
    streams: &[Trajectory],
) -> Result<Vec<String>, EvaluationError> {
    let mut counts = WarningCounts::default();
    for stream in streams {
        let first = stream.cut(0..1)?.frame(0);
        for (name, model) in names.iter().zip(models) {
            model.fits(&first).map_err(|reason| EvaluationError::Stream {
                checkpoint: name.clone(),
                bag: stream.source.clone(),
                stream: stream.id,
                reason: Box::new(reason),
            })?;
            for warning in warnings(model.description(), &stream.setup()) {
                counts.add(name, &warning, format!("{name}: {warning}"));
            }
        }
    }
    Ok(counts.sentences(streams.len()).collect())
}

/// An evaluation that is ready to run: everything is loaded and compatible.
pub struct Evaluation {
    selection: Selection,
    references: References,
    /// Paths of the checkpoints.
    names: Vec<String>,
    /// The checkpoints' models; on the CPU their steppers have one thread.
    models: Vec<Surrogate>,
    recorded: Vec<Recorded>,
    join_late: bool,
    remarks: Vec<String>,
    warnings: Vec<String>,
    pool: rayon::ThreadPool,
}

impl Evaluation {
    /// Loads all models and checks that they can predict all streams.
    ///
    /// # Errors
    /// [`EvaluationError`] when a number is out of range, a checkpoint cannot predict a stream, or every stream was
    /// used to train a checkpoint.
    pub fn new(
        request: EvaluationRequest,
        progress: &dyn Progress,
    ) -> Result<Self, EvaluationError> {
        let load = |checkpoint: &Checkpoint| Surrogate::load(checkpoint, Some(NonZeroUsize::MIN));
        Self::with_models(request, &load, progress)
    }

    /// As [`Evaluation::new`], with models made by `load`, such as those of a GPU.
    ///
    /// # Errors
    /// As [`Evaluation::new`], and those of `load`.
    pub fn with_models(
        request: EvaluationRequest,
        load: &dyn Fn(&Checkpoint) -> Result<Surrogate, ModelError>,
        progress: &dyn Progress,
    ) -> Result<Self, EvaluationError> {
        request.check()?;
        let EvaluationRequest {
            checkpoints,
            recorded,
            streams,
            stiffness,
            settings,
            references,
            join_late,
            threads,
        } = request;
        let descriptions: Vec<_> = checkpoints.iter().map(|(_, c)| &c.description).collect();
        let selection = Selection::new(settings, &descriptions, streams, stiffness)?;
        let load = |(name, checkpoint): &(String, Checkpoint)| {
            load(checkpoint).map_err(|reason| EvaluationError::Checkpoint {
                checkpoint: name.clone(),
                reason: Box::new(reason),
            })
        };
        let models: Vec<Surrogate> = checkpoints.iter().map(load).collect::<Result<_, _>>()?;
        let names: Vec<String> = checkpoints.into_iter().map(|(name, _)| name).collect();
        let threads =
            threads.map_or_else(|| rollout_threads(&models, &selection.streams), NonZeroUsize::get);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        let warnings = check_fits(&names, &models, &selection.streams)?;
        let mut remarks = selection.remarks.clone();
        for (name, model) in names.iter().zip(&models) {
            remarks.extend(calibrated_on(name, model, &selection.streams)?);
        }
        if progress.cancelled() {
            return Err(EvaluationError::Cancelled);
        }
        let references = pool.install(|| References::new(&references, &selection.streams))?;
        Ok(Self {
            selection,
            references,
            names,
            models,
            recorded,
            join_late,
            remarks,
            warnings,
            pool,
        })
    }

    /// The streams to evaluate on: bag, id, and the sequence numbers that rollouts start from.
    pub fn starts(&self) -> impl Iterator<Item = (&Path, u64, Vec<u64>)> {
        self.selection.streams.iter().map(|stream| {
            let starts = self.selection.context.starts(stream.frames).into_iter();
            let sequences = starts.map(|start| stream.first_sequence + start as u64).collect();
            (stream.source.as_path(), stream.id, sequences)
        })
    }

    /// Remarks for the user, one sentence each: excluded streams, what a model was calibrated on.
    pub fn remarks(&self) -> &[String] {
        &self.remarks
    }

    /// How streams differ from what the models were trained on, one sentence each.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Evaluates and times all predictors. Apart from times, the report does not depend on the number of threads.
    ///
    /// # Errors
    /// [`EvaluationError`] when a bag cannot be read, a scene cannot be simulated, or the evaluation was cancelled.
    pub fn run(&self, progress: &dyn Progress) -> Result<Report, EvaluationError> {
        let Selection { streams, context, digest, .. } = &self.selection;
        progress.begin(streams.len() as u64, "scenes");
        let evaluate = |(stream, scene): (&Trajectory, &Option<Scene>)| {
            if progress.cancelled() {
                return Err(EvaluationError::Cancelled);
            }
            let whole = stream.cut(0..stream.frames)?;
            let predictors = self.predictors();
            let result =
                evaluate_scene(context, &predictors, &whole, scene.as_ref()).map_err(|error| {
                    let reason = Box::new(EvaluationError::from(error));
                    EvaluationError::Scene { bag: stream.source.clone(), reason }
                })?;
            progress.advance(1);
            Ok(result)
        };
        let pairs: Vec<_> = streams.iter().zip(&self.references.scenes).collect();
        let scenes: Result<Vec<_>, EvaluationError> =
            self.pool.install(|| pairs.into_par_iter().with_max_len(1).map(evaluate).collect());
        progress.finish();
        let scenes = scenes?;
        let samples = self.samples()?;
        let timed = self.predictors().into_iter();
        let costs = timed.map(|predictor| cost::time(context, predictor, &samples));
        let costs = costs.collect::<Result<_, _>>()?;
        let snapshots = self.snapshots(&samples)?;
        Ok(self.report(scenes, costs, snapshots, digest.clone()))
    }

    /// One stream of each kind for timing and pictures: the first that has room for a rollout.
    fn samples(&self) -> Result<Vec<(Stream, Option<Scene>)>, EvaluationError> {
        let all = || self.selection.streams.iter().zip(&self.references.scenes);
        let has_rollouts =
            |stream: &Trajectory| !self.selection.context.starts(stream.frames).is_empty();
        let first = |kind: Kind| {
            all().find(|(stream, _)| Kind::of(&stream.material) == kind && has_rollouts(stream))
        };
        let cut = |(stream, scene): (&Trajectory, &Option<Scene>)| {
            Ok((stream.cut(0..stream.frames)?, scene.clone()))
        };
        Kind::ALL.into_iter().filter_map(first).map(cut).collect()
    }

    /// Snapshots of a few models and the first solver, with the indices of these predictors.
    fn snapshots(
        &self,
        samples: &[(Stream, Option<Scene>)],
    ) -> Result<(Vec<usize>, Vec<Snapshot>), EvaluationError> {
        let all = self.predictors();
        let numbers = |wanted: fn(&Predictor<'_>) -> bool, most: usize| {
            let found = all.iter().enumerate().filter(move |(_, predictor)| wanted(predictor));
            found.map(|(number, _)| number).take(most)
        };
        let models =
            numbers(|p| matches!(p, Predictor::Model(_) | Predictor::Recorded(_)), PICTURED_MODELS);
        let chosen: Vec<usize> =
            models.chain(numbers(|p| matches!(p, Predictor::Restart(_)), 1)).collect();
        let predictors: Vec<_> = chosen.iter().map(|&number| all[number]).collect();
        let context = &self.selection.context;
        let take = |(stream, scene): &(Stream, Option<Scene>)| {
            snapshot(context, &predictors, stream, scene.as_ref()).transpose()
        };
        let snapshots = samples.iter().filter_map(take).collect::<Result<_, _>>()?;
        Ok((chosen, snapshots))
    }

    /// All predictors.
    fn predictors(&self) -> Vec<Predictor<'_>> {
        let late = self.models.iter().filter(|_| self.join_late).map(Predictor::JoinedLate);
        let references = self.references.predictors.iter().copied();
        let models = self.models.iter().map(Predictor::Model).chain(late);
        let simple = self.selection.context.simple_predictors();
        let recorded = self.recorded.iter().map(Predictor::Recorded);
        let learned = models.chain(recorded);
        learned.chain(simple).chain(references).chain([Predictor::Truth]).collect()
    }

    fn report(
        &self,
        scenes: Vec<SceneResult>,
        costs: Vec<Option<Cost>>,
        snapshots: (Vec<usize>, Vec<Snapshot>),
        data_digest: String,
    ) -> Report {
        let short = short_names(&self.names);
        let mut models = 0;
        let predictors = self.predictors();
        let infos = predictors.iter().map(|predictor| {
            // Models follow the order of the checkpoints, once or twice.
            let number = models % self.names.len();
            if matches!(predictor, Predictor::Model(_) | Predictor::JoinedLate(_)) {
                models += 1;
            }
            info(predictor, &short[number], &self.names[number])
        });
        let infos = infos.collect();
        let notes = self.references.notes.clone();
        let made = Provenance::here();
        let results =
            EvaluationResults { infos, scenes, costs, data_digest, snapshots, notes, made };
        Report::new(&self.selection.context, results)
    }
}

/// A remark if the model's error estimates were calibrated on some of the streams.
fn calibrated_on(
    name: &str,
    model: &Surrogate,
    streams: &[Trajectory],
) -> Result<Option<String>, DatasetError> {
    let Some(model) = model.error_model() else { return Ok(None) };
    let mut known = 0;
    for stream in streams {
        known += usize::from(model.seen.contains(&stream.fingerprint()?));
    }
    let all = streams.len();
    Ok((known > 0).then(|| {
        format!("{name}: its error estimates were calibrated on {known} of the {all} streams")
    }))
}

/// Evaluates a single model and the trivial predictors, stream by stream, with all threads of the model. Measures no
/// times.
///
/// # Errors
/// [`EvaluationError`] when the model was trained on every stream, or a bag cannot be read.
pub fn evaluate_model(
    surrogate: &Surrogate,
    name: &str,
    streams: Vec<Trajectory>,
    settings: Settings,
    progress: &dyn Progress,
) -> Result<Report, EvaluationError> {
    let Selection { streams, context, digest, remarks } =
        Selection::new(settings, &[surrogate.description()], streams, None)?;
    remarks.iter().for_each(|remark| progress.message(remark));
    let predictors: Vec<_> =
        std::iter::once(Predictor::Model(surrogate)).chain(context.simple_predictors()).collect();
    progress.begin(streams.len() as u64, "scenes");
    let evaluate = |stream: &Trajectory| -> Result<SceneResult, EvaluationError> {
        let result = evaluate_scene(&context, &predictors, &stream.cut(0..stream.frames)?, None)?;
        progress.advance(1);
        Ok(result)
    };
    let scenes: Result<Vec<_>, EvaluationError> = streams.iter().map(evaluate).collect();
    progress.finish();
    let infos: Vec<_> = predictors.iter().map(|p| info(p, name, name)).collect();
    let costs = vec![None; infos.len()];
    let snapshots = match streams.first() {
        Some(stream) => snapshot(&context, &predictors[..1], &stream.cut(0..stream.frames)?, None)?,
        None => None,
    };
    let results = EvaluationResults {
        infos,
        scenes: scenes?,
        costs,
        data_digest: digest,
        snapshots: (vec![0], snapshots.into_iter().collect()),
        notes: Vec::new(),
        made: Provenance::here(),
    };
    Ok(Report::new(&context, results))
}

/// Name and origin of a predictor; `short` and `path` name the checkpoint of a model.
fn info(predictor: &Predictor<'_>, short: &str, path: &str) -> PredictorInfo {
    let origin = |surrogate: &Surrogate| Origin {
        checkpoint: path.to_owned(),
        digest: surrogate.digest().to_owned(),
        description: surrogate.description().clone(),
    };
    let (name, role, origin) = match predictor {
        Predictor::Model(surrogate) => (short.to_owned(), Role::Model, Some(origin(surrogate))),
        Predictor::JoinedLate(surrogate) => {
            (format!("{short}, joined late"), Role::JoinedLate, Some(origin(surrogate)))
        }
        Predictor::Recorded(recorded) => (recorded.name.clone(), Role::Recorded, None),
        Predictor::Baseline(baseline) => (baseline.name().to_owned(), Role::Baseline, None),
        Predictor::Mean => ("mean of the training".to_owned(), Role::Mean, None),
        Predictor::LinearFit(_) => ("linear fit".to_owned(), Role::LinearFit, None),
        Predictor::Restart(restart) => (restart.name().to_owned(), Role::Solver, None),
        Predictor::Chaos => (chaos::NAME.to_owned(), Role::Chaos, None),
        Predictor::Truth => ("truth".to_owned(), Role::Truth, None),
    };
    PredictorInfo { name, role, origin }
}

/// The last components of paths if they are distinct, else the whole paths.
pub fn short_names(paths: &[String]) -> Vec<String> {
    let last = |path: &String| {
        let name = Path::new(path).file_name();
        name.map_or(path.clone(), |name| name.to_string_lossy().into_owned())
    };
    let mut short: Vec<String> = paths.iter().map(last).collect();
    short.sort();
    short.dedup();
    if short.len() < paths.len() { paths.to_vec() } else { paths.iter().map(last).collect() }
}

#[cfg(test)]
mod tests;
