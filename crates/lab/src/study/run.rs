//! Runs a comparison. Finished parts are not repeated.

use std::{
    cell::Cell,
    collections::VecDeque,
    fs,
    num::NonZeroUsize,
    path::{Path, PathBuf},
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread,
};

use anyhow::{Context, bail, ensure};

use super::{
    Comparison, DataSet, Folders, StudyConfig, Trained, Variant,
    command_lines::{CommandLines, shown},
    learning_curves, step_times, training, write,
};
#[cfg(feature = "cuda")]
use eddy_cuda::{load_surrogate, open_solver};
use eddy_dataset::{
    Dataset, DatasetError, LoadOptions,
    simulate::{SimulationRequest, simulate},
};
use eddy_evaluation::{Evaluation, EvaluationRequest, Report, Role, Settings};
use eddy_frames::progress::Progress;
use eddy_inference::{
    checkpoint::Checkpoint,
    engine::{ModelError, Surrogate},
};
use eddy_learning::{
    model::{DeviceKind, GpuOptions, Precision},
    train::TrainConfig,
};
use eddy_mpm::Accelerator;
use eddy_pages::{Table, command_line};

/// A comparison to run.
#[derive(Clone, Debug)]
pub struct StudyRequest {
    /// The comparison.
    pub comparison: Comparison,
    /// Data, networks and budget.
    pub study: StudyConfig,
    /// The folder of data, networks, evaluations and reports. Comparisons in the same folder share data and
    /// networks.
    pub output: PathBuf,
    /// Number of networks to train in parallel.
    pub jobs: NonZeroUsize,
    /// The device that trains the networks of cores, losses and windows, and takes the timed steps.
    pub device: DeviceKind,
    /// GPUs that networks are spread over, from that device on.
    pub gpus: NonZeroUsize,
    /// Precision of products on a GPU.
    pub precision: Precision,
}

/// Results of a comparison.
#[derive(Debug)]
pub struct StudyOutcome {
    /// The first table under each heading of the report.
    pub summaries: Vec<(String, Table)>,
    /// The report's page.
    pub page: PathBuf,
}

impl StudyRequest {
    /// Checks all settings.
    ///
    /// # Errors
    /// The first invalid setting.
    pub fn check(&self) -> anyhow::Result<()> {
        self.study.check()?;
        self.study.dense.check()?;
        for Variant { config, .. } in self.comparison.variants(&self.study) {
            config.check()?;
        }
        Ok(())
    }
}

/// Runs a comparison: simulates its scenes, trains its networks with every seed, evaluates them on the test scenes, and
/// writes the report. Repeating a cancelled request resumes it.
///
/// # Errors
/// The error of the part that failed, or cancellation. Finished parts are kept.
pub fn run(request: &StudyRequest, progress: &dyn Progress) -> anyhow::Result<StudyOutcome> {
    request.check()?;
    let work = Work::new(request, progress)?;
    work.simulate()?;
    match request.comparison {
        Comparison::Activations => learning_curves::run(&work)?,
        _ => training::run(&work)?,
    }
    if progress.cancelled() {
        bail!("interrupted: run the same command again to resume");
    }
    for set in &work.data_sets {
        work.evaluate(set)?;
    }
    if request.comparison == Comparison::Cores {
        step_times::run(&work)?;
    }
    if progress.cancelled() {
        bail!("interrupted: run the same command again to resume");
    }
    write::write(&work)
}

/// The device of a comparison.
///
/// # Errors
/// When there is none, or it cannot train the networks.
fn checked_device(request: &StudyRequest) -> anyhow::Result<DeviceKind> {
    let StudyRequest { comparison, study, device, gpus, .. } = request;
    let device = device.resolve(study.training.runs_on_gpus());
    if *comparison == Comparison::Activations {
        ensure!(
            device == DeviceKind::Flex || device.is_cuda(),
            "--device: found {}, expected flex or cuda: dense networks are trained on these",
            device.name()
        );
    }
    ensure!(
        gpus.get() == 1 || device.is_cuda(),
        "--gpus: found {gpus} with --device {}, expected --device cuda",
        device.name()
    );
    (0..gpus.get()).try_for_each(|number| device.plus(number).check())?;
    Ok(device)
}

/// What simulates on a device; `None` for the processor.
pub(crate) fn solvers(device: DeviceKind) -> anyhow::Result<Option<Box<dyn Accelerator>>> {
    match device {
        #[cfg(feature = "cuda")]
        DeviceKind::Cuda(number) => Ok(Some(Box::new(open_solver(number.into())?))),
        _ => Ok(None),
    }
}

/// Loads a network on a GPU, or with one thread for rollouts over many streams side by side.
pub(super) fn load(checkpoint: &Checkpoint, device: DeviceKind) -> Result<Surrogate, ModelError> {
    match device {
        #[cfg(feature = "cuda")]
        DeviceKind::Cuda(number) => load_surrogate(checkpoint, None, number.into()),
        _ => Surrogate::load(checkpoint, Some(NonZeroUsize::MIN)),
    }
}

/// A running comparison.
pub(super) struct Work<'a> {
    pub(super) folders: Folders,
    pub(super) comparison: Comparison,
    pub(super) study: &'a StudyConfig,
    pub(super) variants: Vec<Variant>,
    pub(super) data_sets: Vec<DataSet>,
    /// Number of networks to train in parallel.
    pub(super) jobs: usize,
    /// The device that trains the networks whose cores, losses or windows are compared.
    pub(super) device: DeviceKind,
    /// GPUs that networks are spread over, from that device on.
    pub(super) gpus: usize,
    /// Precision of products on a GPU.
    pub(super) precision: Precision,
    pub(super) progress: &'a dyn Progress,
    /// Set when a task has failed, to stop the others.
    failed: AtomicBool,
}

impl<'a> Work<'a> {
    /// A comparison on a device that is there.
    pub(super) fn new(
        request: &'a StudyRequest,
        progress: &'a dyn Progress,
    ) -> anyhow::Result<Self> {
        let StudyRequest { comparison, study, output, jobs, gpus, precision, .. } = request;
        Ok(Self {
            folders: Folders::new(output),
            comparison: *comparison,
            variants: comparison.variants(study),
            data_sets: comparison.data_sets(study),
            study,
            jobs: jobs.get(),
            device: checked_device(request)?,
            gpus: gpus.get(),
            precision: *precision,
            progress,
            failed: AtomicBool::new(false),
        })
    }

    /// The precision of products on an NVIDIA GPU; empty on other devices.
    pub(super) fn gpu_precision(&self) -> &'static str {
        if self.device.is_cuda() { self.precision.name() } else { "" }
    }

    /// How a single GPU is used.
    pub(super) fn gpu(&self) -> GpuOptions {
        GpuOptions { precision: self.precision, ..GpuOptions::default() }
    }

    /// The device of a network or curve by its number, always the same.
    pub(super) fn device_of(&self, number: usize) -> DeviceKind {
        self.device.plus(number % self.gpus)
    }

    /// Whether tasks should stop.
    pub(super) fn stops(&self) -> bool {
        self.progress.cancelled() || self.failed.load(Ordering::Relaxed)
    }

    /// The equivalent command lines.
    pub(super) fn command_lines(&self) -> CommandLines<'_> {
        CommandLines {
            folders: &self.folders,
            comparison: self.comparison,
            study: self.study,
            variants: &self.variants,
            data_sets: &self.data_sets,
            device: self.device,
            precision: self.precision,
        }
    }

    /// The scenes of a data set.
    pub(super) fn load_data(&self, set: &str) -> Result<Dataset, DatasetError> {
        let memory = LoadOptions::within(eddy_dataset::available_memory() / 2);
        Dataset::load(&[self.folders.data(set)], memory, &mut |_, _| ())
    }

    /// Simulates the missing scenes of every data set, and those for the evaluation, on an NVIDIA GPU if that is the device.
    fn simulate(&self) -> anyhow::Result<()> {
        let mut device = solvers(self.device)?;
        for set in &self.comparison.simulated_sets(self.study) {
            let request = set.simulation(&self.study.data)?;
            let request = SimulationRequest { device: device.as_ref().map(|_| "cuda"), ..request };
            self.tell(&command_line(&self.command_lines().simulation(set)));
            let device = device.as_mut().map(|device| &mut **device as &mut dyn Accelerator);
            simulate(&request, &self.folders.data(&set.name), self.progress, device)?.complete()?;
        }
        Ok(())
    }

    /// Evaluates every network of a data set on its scenes, unless already done.
    pub(super) fn evaluate(&self, set: &DataSet) -> anyhow::Result<()> {
        let folder = self.folders.evaluation(self.comparison, &set.name);
        if self.variants.is_empty() || self.is_evaluated(set, &folder)? {
            return Ok(());
        }
        let command = command_line(&self.command_lines().evaluation(set));
        self.tell(&command);
        let evaluation =
            Evaluation::with_models(self.evaluation(set)?, &self.loader(), self.progress)?;
        let sentences = evaluation.remarks().iter().chain(evaluation.warnings());
        sentences.for_each(|sentence| self.tell(sentence));
        let mut report = evaluation.run(self.progress)?;
        report.made.command = command;
        report.save(&folder).with_context(|| shown(&folder))
    }

    /// Loads networks for their evaluation, on the GPUs in turn.
    fn loader(&self) -> impl Fn(&Checkpoint) -> Result<Surrogate, ModelError> {
        let next = Cell::new(0);
        move |checkpoint| load(checkpoint, self.device_of(next.replace(next.get() + 1)))
    }

    /// The evaluation of all networks of a data set.
    fn evaluation(&self, set: &DataSet) -> anyhow::Result<EvaluationRequest> {
        let load = |(variant, seed): (&Variant, u64)| {
            let path = self.folders.run(&set.name, &variant.name, seed);
            Ok((shown(&path), Checkpoint::load(&path)?))
        };
        let checkpoints = self.runs().map(load).collect::<anyhow::Result<_>>()?;
        let test_set = self.comparison.test_set(self.study, set);
        let data = self.folders.data(&test_set.as_ref().unwrap_or(set).name);
        let memory = LoadOptions::within(eddy_dataset::available_memory() / 2);
        let evaluation = &self.study.evaluation;
        Ok(EvaluationRequest {
            recorded: Vec::new(),
            checkpoints,
            streams: eddy_dataset::load_trajectories(&[data], memory, &mut |_, _| ())?.streams,
            stiffness: None,
            // The study's tables need nothing else, and rollouts to detect blow-ups would take ten times as long.
            settings: Settings::errors_only(evaluation.horizon, evaluation.starts),
            references: Vec::new(),
            join_late: true,
            threads: None,
        })
    }

    /// Whether `folder` has the report of this evaluation.
    fn is_evaluated(&self, set: &DataSet, folder: &Path) -> anyhow::Result<bool> {
        if !Report::file(folder).exists() {
            return Ok(false);
        }
        let report = Report::load(folder)?;
        let models = report.predictors.iter().filter(|entry| entry.role == Role::Model);
        let evaluated: Vec<_> = models.filter_map(|entry| entry.digest.as_ref()).collect();
        let networks = self.trained(&set.name)?;
        let networks: Vec<_> = networks.iter().map(|(_, trained)| &trained.checkpoint).collect();
        Ok(report.made.command == command_line(&self.command_lines().evaluation(set))
            && evaluated == networks)
    }

    /// Results of the networks' training, in the order of [`Work::runs`].
    pub(super) fn trained(&self, set: &str) -> anyhow::Result<Vec<(&Variant, Trained)>> {
        let mut all = Vec::new();
        for (variant, seed) in self.runs() {
            let folder = self.folders.run(set, &variant.name, seed);
            let config = TrainConfig { seed, ..variant.config.clone() };
            let trained = Trained::find(&folder, &config, self.device, self.gpu_precision())?
                .with_context(|| format!("{}: no trained network found", folder.display()))?;
            all.push((variant, trained));
        }
        Ok(all)
    }

    /// Every network with every seed, see [`plan::runs`](super::plan::runs).
    pub(super) fn runs(&self) -> impl Iterator<Item = (&Variant, u64)> {
        super::plan::runs(self.study, &self.variants)
    }

    /// Runs tasks, `jobs` in parallel, until one fails or all should stop. A task returns a message, or nothing if it was
    /// stopped.
    pub(super) fn each<T: Send>(
        &self,
        tasks: VecDeque<T>,
        what: &str,
        run: impl Fn(T) -> anyhow::Result<Option<String>> + Sync,
    ) -> anyhow::Result<()> {
        self.progress.begin(tasks.len() as u64, what);
        let jobs = self.jobs.min(tasks.len());
        let tasks = Mutex::new(tasks);
        let next = || tasks.lock().unwrap_or_else(PoisonError::into_inner).pop_front();
        let worker = || -> anyhow::Result<()> {
            while let (false, Some(task)) = (self.stops(), next()) {
                let outcome = run(task);
                let line = outcome.inspect_err(|_| self.failed.store(true, Ordering::Relaxed))?;
                if let Some(line) = line {
                    self.tell(&line);
                    self.progress.advance(1);
                }
            }
            Ok(())
        };
        let outcomes: Vec<anyhow::Result<()>> = thread::scope(|scope| {
            let workers: Vec<_> = (0..jobs).map(|_| scope.spawn(worker)).collect();
            let join = |worker: thread::ScopedJoinHandle<'_, _>| {
                worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
            };
            workers.into_iter().map(join).collect()
        });
        self.progress.finish();
        outcomes.into_iter().collect()
    }

    fn tell(&self, line: &str) {
        self.progress.message(line);
    }
}

/// Writes a settings file for an equivalent command.
pub(super) fn write_settings(file: &Path, text: &str) -> anyhow::Result<()> {
    let folder = file.parent().unwrap_or(Path::new("."));
    let written = fs::create_dir_all(folder).and_then(|()| fs::write(file, text));
    written.with_context(|| file.display().to_string())
}
