//! The commands equivalent to the steps of a study: printed as it runs and kept in its reports. The study
//! itself calls the functions behind these commands.

use std::path::Path;

use super::{Comparison, DataSet, Folders, SceneChoice, StudyConfig, Variant, plan::runs};
use eddy_learning::model::{DeviceKind, Precision};
use eddy_mpm::ParticleOrder;
use eddy_pages::command_line;

/// Builds command lines.
pub(super) struct CommandLines<'a> {
    pub(super) folders: &'a Folders,
    pub(super) comparison: Comparison,
    pub(super) study: &'a StudyConfig,
    pub(super) variants: &'a [Variant],
    pub(super) data_sets: &'a [DataSet],
    /// The device that trains.
    pub(super) device: DeviceKind,
    /// Precision of products on a GPU.
    pub(super) precision: Precision,
}

impl CommandLines<'_> {
    /// The command that simulates the scenes of a data set.
    pub(super) fn simulation(&self, set: &DataSet) -> Vec<String> {
        let data = &self.study.data;
        let SceneChoice { scenes, same_bodies, order } = set.scenes;
        let mut words = command("simulate");
        words.extend(["--preset".into(), set.preset.clone()]);
        words.extend(["--scenes".into(), scenes.to_string()]);
        if same_bodies {
            words.push("--same-bodies".into());
        }
        if order == ParticleOrder::Curve {
            words.extend(["--particle-order".into(), "curve".into()]);
        }
        words.extend(["--seed".into(), set.seed.to_string()]);
        if let Some(duration) = data.duration {
            words.extend(["--duration".into(), duration.to_string()]);
        }
        words.extend(self.gpu());
        words.extend(["--output".into(), shown(&self.folders.data(&set.name))]);
        words
    }

    /// The command that trains a network with a seed. Its settings are in a file beside its folder.
    pub(super) fn training(&self, set: &str, variant: &Variant, seed: u64) -> Vec<String> {
        let output = self.folders.run(set, &variant.name, seed);
        let mut words = command("train");
        words.extend(["--data".into(), shown(&self.folders.data(set))]);
        words.extend(["--config".into(), shown(&output.with_extension("toml"))]);
        words.extend(["--output".into(), shown(&output), "--resume".into()]);
        if self.device != DeviceKind::default() {
            words.extend(["--device".into(), self.device.name().into()]);
        }
        if self.precision != Precision::default() {
            words.extend(["--precision".into(), self.precision.name().into()]);
        }
        words
    }

    /// The command that evaluates the networks of a data set.
    pub(super) fn evaluation(&self, data_set: &DataSet) -> Vec<String> {
        let set = data_set.name.as_str();
        let mut words = command("eval");
        words.push("--checkpoint".into());
        let run =
            |(variant, seed): (&Variant, u64)| shown(&self.folders.run(set, &variant.name, seed));
        words.extend(runs(self.study, self.variants).map(run));
        let test_set = self.comparison.test_set(self.study, data_set);
        let data = test_set.map_or_else(|| set.to_owned(), |test| test.name);
        words.extend(["--data".into(), shown(&self.folders.data(&data))]);
        words.extend(["--horizon".into(), self.study.evaluation.horizon.to_string()]);
        words.extend(["--starts".into(), self.study.evaluation.starts.to_string()]);
        words.push("--join-late".into());
        words.extend(self.gpu());
        let folder = self.folders.evaluation(self.comparison, set);
        words.extend(["--output".into(), shown(&folder)]);
        words
    }

    /// The option for an NVIDIA GPU, if that is the device: without it, scenes are simulated and networks evaluated on the
    /// processor.
    fn gpu(&self) -> Vec<String> {
        let option = || vec!["--device".to_owned(), self.device.name().to_owned()];
        self.device.is_cuda().then(option).unwrap_or_default()
    }

    /// All equivalent commands in order; learning curves have none.
    pub(super) fn all(&self) -> Vec<String> {
        let mut lines = Vec::new();
        for set in self.data_sets {
            lines.push(command_line(&self.simulation(set)));
            for (variant, seed) in runs(self.study, self.variants) {
                lines.push(command_line(&self.training(&set.name, variant, seed)));
            }
            if let Some(test_set) = self.comparison.test_set(self.study, set) {
                lines.push(command_line(&self.simulation(&test_set)));
            }
            if !self.variants.is_empty() {
                lines.push(command_line(&self.evaluation(set)));
            }
        }
        lines
    }
}

/// The first words of a command line.
fn command(name: &str) -> Vec<String> {
    vec!["eddy".to_owned(), name.to_owned()]
}

/// A path as text.
pub(super) fn shown(path: &Path) -> String {
    path.display().to_string()
}
