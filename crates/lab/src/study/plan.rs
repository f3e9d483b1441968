//! The networks of a comparison, and the folders of a study.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{DataSet, StudyConfig};
use eddy_inference::checkpoint::{Core, FrameOutput};
use eddy_learning::train::TrainConfig;

/// A comparison of the paper.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Comparison {
    /// Compare the five cores on every preset: the paper's Tables 2 and 3, and its Table 4 for this machine.
    Cores,
    /// Compare activations of a dense network: the paper's Fig. 5.
    Activations,
    /// Compare training with and without the density loss.
    Loss,
    /// Compare numbers of observed frames.
    Window,
    /// Compare what the network predicts: position, displacement, or residual on the ballistic step.
    Output,
    /// Compare scenes to train on: their number, whether they have the same bodies, how particles are numbered.
    Scenes,
}

/// A network that is trained once per seed.
#[derive(Clone, Debug, PartialEq)]
pub struct Variant {
    /// Name of its folder. The same network has the same name in every comparison.
    pub name: String,
    /// The compared setting with its unit, as shown in tables.
    pub setting: String,
    /// Training settings; the seed is set for every run.
    pub config: TrainConfig,
}

impl Comparison {
    /// Its name on the command line and of its folder.
    pub fn name(self) -> &'static str {
        match self {
            Self::Cores => "cores",
            Self::Activations => "activations",
            Self::Loss => "loss",
            Self::Window => "window",
            Self::Output => "output",
            Self::Scenes => "scenes",
        }
    }

    /// The networks to train and evaluate; none for the activations, whose dense network is not a model.
    pub fn variants(self, study: &StudyConfig) -> Vec<Variant> {
        let base = &study.training;
        let all: Vec<TrainConfig> = match self {
            Self::Activations => Vec::new(),
            Self::Cores => {
                study.cores.iter().map(|&core| TrainConfig { core, ..base.clone() }).collect()
            }
            Self::Loss => {
                let weighted = |&weight: &f32| {
                    let mut config = base.clone();
                    config.loss.density_weight = weight;
                    config
                };
                study.density_weights.iter().map(weighted).collect()
            }
            Self::Window => {
                let observing = |core: Core, frames: usize| {
                    let mut config = TrainConfig { core, ..base.clone() };
                    config.windows.warm_up = frames;
                    config
                };
                let of = |&core: &Core| {
                    // Without memory, only the last frame counts.
                    let lengths = if core == Core::Mlp { 1 } else { study.windows.len() };
                    study.windows.iter().take(lengths).map(move |&frames| observing(core, frames))
                };
                study.windowed_cores.iter().flat_map(of).collect()
            }
            Self::Output => {
                let predicting = |&output: &FrameOutput| {
                    let mut config = base.clone();
                    config.network.frame.output = output;
                    config
                };
                study.outputs.iter().map(predicting).collect()
            }
            Self::Scenes => vec![base.clone()],
        };
        all.into_iter().map(|config| Variant::new(self, config, base)).collect()
    }

    /// Its data: all presets for the cores, the first for the others.
    pub fn data_sets(self, study: &StudyConfig) -> Vec<DataSet> {
        let data = &study.data;
        let all = data.presets.iter();
        let usual = |preset: &String| data.set(preset, data.usual());
        match self {
            Self::Cores => all.map(usual).collect(),
            Self::Activations | Self::Loss | Self::Window | Self::Output => {
                all.take(1).map(usual).collect()
            }
            Self::Scenes => {
                let choices = |preset: &String| -> Vec<DataSet> {
                    let sets = study.data_sets.iter();
                    sets.map(|&scenes| data.set(preset, scenes)).collect()
                };
                all.take(1).flat_map(choices).collect()
            }
        }
    }

    /// The scenes on which the networks of a data set are evaluated, if not on its test part.
    pub fn test_set(self, study: &StudyConfig, set: &DataSet) -> Option<DataSet> {
        let test_set = || study.data.test_set(&set.preset, set.scenes.order);
        (self == Self::Scenes).then(test_set)
    }
}

impl Comparison {
    /// All scenes: of its data, and of the test sets.
    pub fn simulated_sets(self, study: &StudyConfig) -> Vec<DataSet> {
        let mut sets = self.data_sets(study);
        for set in sets.clone() {
            let test_set = self.test_set(study, &set);
            sets.extend(test_set.filter(|test_set| !sets.contains(test_set)));
        }
        sets
    }
}

impl Variant {
    fn new(comparison: Comparison, config: TrainConfig, base: &TrainConfig) -> Self {
        let core = config.core.name();
        let density = config.loss.density_weight;
        let frames = config.windows.warm_up;
        let output = config.network.frame.output;
        let setting = match comparison {
            Comparison::Loss => format!("density weight {density}"),
            Comparison::Window => format!("{core}, T = {frames}"),
            Comparison::Output => format!("{core}, {}", output.name()),
            Comparison::Cores | Comparison::Activations | Comparison::Scenes => core.to_owned(),
        };
        let mut name = core.to_owned();
        if density != base.loss.density_weight {
            name.push_str(&format!("-density-{density}"));
        }
        if frames != base.windows.warm_up {
            name.push_str(&format!("-window-{frames}"));
        }
        if output != base.network.frame.output {
            name.push_str(&format!("-{}", output.name()));
        }
        Self { name, setting, config }
    }
}

/// Every network with every seed. Seeds are in the outer loop, so that an interrupted study has complete seeds.
pub(crate) fn runs<'a>(
    study: &'a StudyConfig,
    variants: &'a [Variant],
) -> impl Iterator<Item = (&'a Variant, u64)> {
    study.seeds.iter().flat_map(|&seed| variants.iter().map(move |variant| (variant, seed)))
}

/// The folders of a study. Comparisons with the same folder share data and networks.
#[derive(Clone, Debug)]
pub struct Folders {
    root: PathBuf,
}

impl Folders {
    /// Folders of the study in `root`.
    pub fn new(root: &Path) -> Self {
        Self { root: root.to_owned() }
    }

    /// The bags of a data set.
    pub fn data(&self, set: &str) -> PathBuf {
        self.root.join("data").join(set)
    }

    /// A network trained with one seed.
    pub fn run(&self, set: &str, variant: &str, seed: u64) -> PathBuf {
        self.root.join("runs").join(set).join(variant).join(format!("seed-{seed}"))
    }

    /// The learning curve of a dense network.
    pub fn curve(&self, set: &str, activation: &str, seed: u64) -> PathBuf {
        let name = format!("{activation}-{seed}.toml");
        self.root.join("curves").join(set).join(name)
    }

    /// The evaluation of a comparison's networks on a data set.
    pub fn evaluation(&self, comparison: Comparison, set: &str) -> PathBuf {
        self.report(comparison).join(set)
    }

    /// The report of a comparison.
    pub fn report(&self, comparison: Comparison) -> PathBuf {
        self.root.join(comparison.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(comparison: Comparison) -> Vec<String> {
        let variants = comparison.variants(&StudyConfig::paper());
        variants.into_iter().map(|variant| variant.name).collect()
    }

    #[test]
    fn a_network_has_one_name_in_every_comparison() {
        assert_eq!(names(Comparison::Cores), ["mingru", "minlstm", "lstm", "gru", "mlp"]);
        assert_eq!(names(Comparison::Loss), ["mingru-density-0", "mingru", "mingru-density-0.01"]);
        assert_eq!(names(Comparison::Window), ["mingru", "mingru-window-4", "mingru-window-16"]);
    }

    #[test]
    fn networks_with_the_same_name_have_the_same_settings() {
        let study = StudyConfig::paper();
        let all = [Comparison::Cores, Comparison::Loss, Comparison::Window, Comparison::Output];
        let all: Vec<Variant> = all.iter().flat_map(|one| one.variants(&study)).collect();
        for one in &all {
            for other in all.iter().filter(|other| other.name == one.name) {
                assert_eq!(one.config, other.config);
            }
        }
    }
}
