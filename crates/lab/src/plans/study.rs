//! `eddy-lab study` as a plan.

use std::{
    collections::BTreeMap,
    num::NonZeroUsize,
    path::{Path, PathBuf},
};

use anyhow::Context as _;
use eddy_dataset::simulate::SimulationRequest;
use eddy_evaluation::Report;
use eddy_frames::progress::Progress;
use eddy_learning::model::{DeviceKind, Precision};
use eddy_plan::Task;
use serde::{Deserialize, Serialize};

use super::{DataTask, Work, cost};
use crate::{
    bench::training::{FRAMES, paper_steps},
    study::{
        Comparison, Folders, Part, Speed, StudyConfig, StudyRequest, Trained, report_files,
        run_part, runs,
    },
};

/// A comparison of the paper.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StudyJob {
    comparison: Comparison,
    output: PathBuf,
    device: DeviceKind,
    precision: Precision,
    /// As the text of a file for `--config`: JSON has no infinite numbers, which settings may be.
    #[serde(with = "settings_text")]
    study: StudyConfig,
}

/// Settings as TOML.
mod settings_text {
    use serde::{Deserialize as _, Deserializer, Serializer, de::Error as _, ser::Error as _};

    use crate::study::StudyConfig;

    pub(super) fn serialize<S: Serializer>(study: &StudyConfig, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_str(&toml::to_string(study).map_err(S::Error::custom)?)
    }

    pub(super) fn deserialize<'a, D: Deserializer<'a>>(from: D) -> Result<StudyConfig, D::Error> {
        toml::from_str(&String::deserialize(from)?).map_err(D::Error::custom)
    }
}

impl StudyJob {
    pub(super) fn new(request: StudyRequest) -> Self {
        let StudyRequest { comparison, study, output, device, precision, .. } = request;
        Self { comparison, output, device, precision, study }
    }

    /// The request of a task: it trains one network, on one GPU.
    fn request(&self) -> StudyRequest {
        StudyRequest {
            comparison: self.comparison,
            study: self.study.clone(),
            output: self.output.clone(),
            jobs: NonZeroUsize::MIN,
            device: self.device,
            gpus: NonZeroUsize::MIN,
            precision: self.precision,
        }
    }

    pub(super) fn run(
        &self,
        part: &Part,
        progress: &dyn Progress,
    ) -> anyhow::Result<Option<String>> {
        run_part(&self.request(), part, progress)
    }

    pub(super) fn data(&self, name: &str) -> anyhow::Result<DataTask> {
        let sets = self.comparison.simulated_sets(&self.study);
        let set = sets.into_iter().find(|set| set.name == name);
        let set = set.with_context(|| {
            format!("data: found {name}, expected a data set of this comparison")
        })?;
        let request = SimulationRequest {
            device: self.device.is_cuda().then_some("cuda"),
            threads: Some(NonZeroUsize::MIN),
            ..set.simulation(&self.study.data)?
        };
        Ok(DataTask { request, output: Folders::new(&self.output).data(name), device: self.device })
    }

    #[expect(clippy::too_many_lines, reason = "the tasks of a study, one kind after another")]
    pub(super) fn tasks(&self, per_task: u32) -> anyhow::Result<Vec<Task<Work>>> {
        let Self { comparison, study, .. } = self;
        let folders = Folders::new(&self.output);
        let gpu = self.device.is_cuda();
        let mut tasks = Vec::new();
        let mut frames = BTreeMap::new();
        for set in comparison.simulated_sets(study) {
            let data = self.data(&set.name)?;
            tasks.extend(data.tasks(&format!("{}/", set.name), &set.name, per_task)?);
            frames.insert(set.name, (data.frames()?, f64::from(data.request.scenes)));
        }
        let manifest = |set: &str| SimulationRequest::manifest(&folders.data(set));
        let mut results = Vec::new();
        let variants = comparison.variants(study);
        for set in comparison.data_sets(study) {
            let name = set.name.as_str();
            let (set_frames, _) = frames[name];
            let mut networks = Vec::new();
            for (variant, seed) in runs(study, &variants) {
                let output = Trained::file(&folders.run(name, &variant.name, seed));
                networks.push(output.clone());
                tasks.push(Task {
                    name: format!("{name}/{}/seed-{seed}", variant.name),
                    work: Work::Study(Part::Network {
                        data: name.to_owned(),
                        network: variant.name.clone(),
                        seed,
                    }),
                    inputs: vec![manifest(name)],
                    outputs: vec![output],
                    cost: cost::training(&variant.config, set_frames, gpu),
                });
            }
            if *comparison == Comparison::Activations {
                tasks.extend(self.curves(name, &manifest(name), set_frames, &mut results));
                continue;
            }
            let test = comparison.test_set(study, &set).map_or(set.name.clone(), |test| test.name);
            let (test_frames, test_scenes) = frames[&test];
            let output = Report::file(&folders.evaluation(*comparison, name));
            results.push(output.clone());
            let rollouts = networks.len() as f64 * test_scenes * study.evaluation.starts as f64;
            let predictions = 2.0 * rollouts * (test_frames / test_scenes);
            tasks.push(Task {
                name: format!("{}/{name}", comparison.name()),
                work: Work::Study(Part::Evaluation { data: name.to_owned() }),
                inputs: networks.into_iter().chain([manifest(&test)]).collect(),
                outputs: vec![output],
                cost: cost::evaluation(&study.training, predictions, test_frames, gpu),
            });
        }
        let folder = folders.report(*comparison);
        if *comparison == Comparison::Cores {
            // After all else, so that no other task of this study disturbs the times.
            let speed = Speed::file(&folder);
            let whole = if gpu { &study.step_frames } else { &FRAMES[..1] };
            let steps = paper_steps(whole, &study.step_frames).len() as f64;
            tasks.push(Task {
                name: format!("{}/step-times", comparison.name()),
                work: Work::Study(Part::StepTimes),
                inputs: results.clone(),
                outputs: vec![speed.clone()],
                cost: cost::measurement(steps * study.step_seconds, gpu),
            });
            results.push(speed);
        }
        tasks.push(Task {
            name: format!("{}/report", comparison.name()),
            work: Work::Study(Part::Report),
            inputs: results,
            outputs: report_files(&folder).to_vec(),
            cost: cost::files(),
        });
        Ok(tasks)
    }

    /// The learning curves of a data set; their files are added to `results`.
    fn curves(
        &self,
        set: &str,
        manifest: &Path,
        frames: f64,
        results: &mut Vec<PathBuf>,
    ) -> Vec<Task<Work>> {
        let folders = Folders::new(&self.output);
        let mut tasks = Vec::new();
        for &seed in &self.study.seeds {
            for &activation in &self.study.activations {
                let output = folders.curve(set, activation.name(), seed);
                results.push(output.clone());
                tasks.push(Task {
                    name: format!("{set}/{}-{seed}", activation.name()),
                    work: Work::Study(Part::Curve { data: set.to_owned(), activation, seed }),
                    inputs: vec![manifest.to_owned()],
                    outputs: vec![output],
                    cost: cost::curve(&self.study.dense, frames, self.device.is_cuda()),
                });
            }
        }
        tasks
    }
}
