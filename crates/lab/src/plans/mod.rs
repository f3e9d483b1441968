//! Long jobs as plans: `eddy-lab plan`.
//!
//! 1. [`simulate`]: a data set, one task per scene, then its manifest.
//! 2. [`study`]: a comparison of the paper: scenes, networks or learning curves, evaluations, report.
//! 3. [`cost`]: what the tasks cost.

mod cost;
mod simulate;
mod study;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};

use eddy_dataset::simulate::{SimulationRequest, collect, simulate_some};
use eddy_frames::progress::Progress;
use eddy_learning::model::DeviceKind;
use eddy_mpm::Accelerator;
use eddy_plan::{Job, Plan};
use serde::{Deserialize, Serialize};

use crate::study::{Part, StudyRequest, solvers};
use simulate::SimulateJob;
use study::StudyJob;

/// A long job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum LongJob {
    /// `eddy simulate`
    Simulate(Box<SimulateJob>),
    /// `eddy-lab study`
    Study(Box<StudyJob>),
}

/// What a task does.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Work {
    /// Simulate scenes of a data set.
    Scenes {
        /// Name of the data set.
        data: String,
        /// The first scene.
        first: u32,
        /// Their number.
        count: u32,
    },
    /// Write the manifest of a data set.
    Manifest {
        /// Name of the data set.
        data: String,
    },
    /// A part of a study.
    Study(Part),
}

impl LongJob {
    /// The plan of a simulation into `output`, with `per_task` scenes per task.
    ///
    /// # Errors
    /// As [`eddy_dataset::simulate::Job::plan`].
    pub fn simulate(
        request: &SimulationRequest,
        output: &Path,
        device: DeviceKind,
        per_task: u32,
    ) -> anyhow::Result<Plan<Self>> {
        let job = SimulateJob::new(request, output, device);
        let tasks = job.tasks(per_task)?;
        Ok(Plan::new(Self::Simulate(Box::new(job)), tasks))
    }

    /// The plan of a study, with `per_task` scenes per task.
    ///
    /// # Errors
    /// Invalid settings.
    pub fn study(request: StudyRequest, per_task: u32) -> anyhow::Result<Plan<Self>> {
        request.check()?;
        let job = StudyJob::new(request);
        let tasks = job.tasks(per_task)?;
        Ok(Plan::new(Self::Study(Box::new(job)), tasks))
    }
}

impl Job for LongJob {
    type Work = Work;

    fn kind(&self, work: &Work) -> &'static str {
        match work {
            Work::Scenes { .. } => "simulate",
            Work::Manifest { .. } => "manifest",
            Work::Study(Part::Network { .. }) => "train",
            Work::Study(Part::Curve { .. }) => "curve",
            Work::Study(Part::Evaluation { .. }) => "evaluate",
            Work::Study(Part::StepTimes) => "time",
            Work::Study(Part::Report) => "report",
        }
    }

    fn run(&self, work: &Work, progress: &dyn Progress) -> anyhow::Result<Option<String>> {
        let data = |name: &str| match self {
            Self::Simulate(job) => job.data(name),
            Self::Study(job) => job.data(name),
        };
        match (self, work) {
            (_, Work::Scenes { data: name, first, count }) => {
                data(name)?.simulate(*first, *count, progress)
            }
            (_, Work::Manifest { data: name }) => {
                let data = data(name)?;
                collect(&data.request, &data.output)?;
                Ok(Some(format!("{} scenes", data.request.scenes)))
            }
            (Self::Study(job), Work::Study(part)) => job.run(part, progress),
            (Self::Simulate(_), Work::Study(_)) => {
                anyhow::bail!("work: found a part of a study, expected scenes or a manifest")
            }
        }
    }
}

/// Scenes of a job, and where they are written.
struct DataTask {
    request: SimulationRequest,
    output: PathBuf,
    device: DeviceKind,
}

impl DataTask {
    /// Simulates some of the scenes, each on one thread: the other cores are for other tasks.
    fn simulate(
        &self,
        first: u32,
        count: u32,
        progress: &dyn Progress,
    ) -> anyhow::Result<Option<String>> {
        let mut device = solvers(self.device)?;
        let device = device.as_mut().map(|device| &mut **device as &mut dyn Accelerator);
        let scenes = first..first.saturating_add(count).min(self.request.scenes);
        let summary = simulate_some(&self.request, scenes, &self.output, progress, device)?;
        let message = summary.to_string();
        if progress.cancelled() {
            return Ok(None);
        }
        summary.complete()?;
        Ok(Some(message))
    }
}
