//! `eddy simulate` as a plan.

use std::{
    num::NonZeroUsize,
    path::{Path, PathBuf},
};

use anyhow::ensure;
use clap::ValueEnum as _;
use eddy_dataset::simulate::{Job, Planned, SimulationRequest, Source};
use eddy_learning::model::DeviceKind;
use eddy_mpm::{Extent, ExtentOptions, Preset, Scene, Settings};
use eddy_plan::Task;
use serde::{Deserialize, Serialize};

use super::{DataTask, Work, cost};

/// The scenes of `eddy simulate`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SimulateJob {
    /// The directory of the bags.
    output: PathBuf,
    /// The preset, or the name of the scene file.
    name: String,
    /// Name of a single scene in errors.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    scene_name: Option<String>,
    /// The scene of a file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    scene: Option<Scene>,
    /// Number of scenes.
    scenes: u32,
    /// Seed of random scenes.
    seed: u64,
    /// Particles of random scenes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    particles: Option<usize>,
    /// Whether all random scenes have the same bodies.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    same_bodies: bool,
    /// Range of the fraction of the domain that the bodies of a random scene fill.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    fill: Option<[f32; 2]>,
    /// Range of the stiffness of random scenes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    stiffness: Option<[f32; 2]>,
    /// Overrides of the scenes' own settings.
    settings: Settings,
    /// Whether pressure and energy of every particle are recorded.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    fields: bool,
    /// Where the solver runs; on the processor unless it is a GPU.
    device: DeviceKind,
}

impl SimulateJob {
    pub(super) fn new(request: &SimulationRequest, output: &Path, device: DeviceKind) -> Self {
        let (scene, extent) = match &request.source {
            Source::Written(scene) => (Some(Scene::clone(scene)), None),
            Source::Random(extent) => (None, Some(extent)),
        };
        Self {
            output: output.to_owned(),
            name: request.name.clone(),
            scene_name: request.scene_name.clone(),
            scene,
            scenes: request.scenes,
            seed: request.seed,
            particles: extent.map(Extent::particles),
            same_bodies: extent.is_some_and(Extent::same_bodies),
            fill: extent.and_then(Extent::fill),
            stiffness: extent.and_then(Extent::stiffness),
            settings: request.settings,
            fields: request.fields,
            device,
        }
    }

    /// Name of its only data set.
    fn data_name(&self) -> String {
        self.output.file_name().unwrap_or_default().to_string_lossy().into_owned()
    }

    fn request(&self) -> anyhow::Result<SimulationRequest> {
        let twice = self.stiffness.is_some() && self.settings.stiffness.is_some();
        ensure!(!twice, "job: found stiffness and settings.stiffness, expected one of them");
        let alike = self.fill.is_some() && self.same_bodies;
        ensure!(!alike, "job: found fill and same_bodies, expected one of them");
        let source = match &self.scene {
            Some(scene) => Source::Written(Box::new(scene.clone())),
            None => {
                let preset = Preset::from_str(&self.name, false);
                let preset = preset.map_err(|reason| anyhow::anyhow!("job.name: {reason}"))?;
                let options = ExtentOptions {
                    particles: self.particles,
                    fill: self.fill,
                    stiffness: self.stiffness,
                    same_bodies: self.same_bodies,
                };
                Source::Random(Extent::requested(preset, options)?)
            }
        };
        Ok(SimulationRequest {
            source,
            name: self.name.clone(),
            scene_name: self.scene_name.clone(),
            scenes: self.scenes,
            seed: self.seed,
            settings: self.settings,
            fields: self.fields,
            device: self.device.is_cuda().then_some("cuda"),
            threads: Some(NonZeroUsize::MIN),
        })
    }

    pub(super) fn data(&self, name: &str) -> anyhow::Result<DataTask> {
        let expected = self.data_name();
        ensure!(name == expected, "data: found {name}, expected {expected}");
        Ok(DataTask { request: self.request()?, output: self.output.clone(), device: self.device })
    }

    pub(super) fn tasks(&self, per_task: u32) -> anyhow::Result<Vec<Task<Work>>> {
        let data = self.data(&self.data_name())?;
        data.tasks("", &self.data_name(), per_task)
    }
}

impl DataTask {
    /// One task for each `per_task` scenes, then one for the manifest. Names start with `prefix`.
    pub(super) fn tasks(
        &self,
        prefix: &str,
        data: &str,
        per_task: u32,
    ) -> anyhow::Result<Vec<Task<Work>>> {
        let Self { request, output, device } = self;
        let data = data.to_owned();
        // Checks all scenes, too, on all cores.
        let checked = SimulationRequest { threads: None, ..request.clone() };
        let job = Job::plan(&checked, None, Some(1))?;
        let mut tasks = Vec::new();
        let mut bags = Vec::new();
        for (number, scenes) in job.planned().chunks(per_task.max(1) as usize).enumerate() {
            let first = number as u32 * per_task.max(1);
            let count = scenes.len() as u32;
            let last = first + count - 1;
            let outputs: Vec<PathBuf> =
                (first..=last).map(|index| request.bag(output, index)).collect();
            bags.extend(outputs.clone());
            tasks.push(Task {
                name: match count {
                    1 => format!("{prefix}scene-{first:04}"),
                    _ => format!("{prefix}scenes-{first:04}-{last:04}"),
                },
                work: Work::Scenes { data: data.clone(), first, count },
                inputs: Vec::new(),
                outputs,
                cost: cost::simulation(scenes, device.is_cuda())?,
            });
        }
        tasks.push(Task {
            name: format!("{prefix}manifest"),
            work: Work::Manifest { data },
            inputs: bags,
            outputs: vec![SimulationRequest::manifest(output)],
            cost: cost::files(),
        });
        Ok(tasks)
    }

    /// Frames of all scenes, at most.
    pub(super) fn frames(&self) -> anyhow::Result<f64> {
        let checked = SimulationRequest { threads: None, ..self.request.clone() };
        let job = Job::plan(&checked, None, Some(1))?;
        let frames = |planned: &Planned| planned.most_frames as f64;
        Ok(job.planned().iter().map(frames).sum())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_keeps_the_ranges_of_the_fill_and_the_stiffness() {
        let extent = Extent::usual(Preset::Kinds).with_stiffness([300.0, 3e3]).unwrap();
        let extent = extent.with_fill([0.1, 0.3]).unwrap();
        let request = SimulationRequest {
            source: Source::Random(extent),
            name: "kinds".to_owned(),
            scene_name: None,
            scenes: 4,
            seed: 1,
            settings: Settings::default(),
            fields: false,
            device: None,
            threads: None,
        };
        let job = SimulateJob::new(&request, Path::new("bags/kinds"), DeviceKind::Flex);
        let mut job: SimulateJob =
            serde_json::from_str(&serde_json::to_string(&job).unwrap()).unwrap();
        let Source::Random(found) = job.request().unwrap().source else { panic!("a file") };
        assert_eq!(found, extent);
        job.settings.stiffness = Some(1e3);
        let message = job.request().unwrap_err().to_string();
        assert_eq!(message, "job: found stiffness and settings.stiffness, expected one of them");
    }
}
