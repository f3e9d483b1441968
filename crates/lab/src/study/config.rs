//! Settings of a study.

use serde::{Deserialize, Serialize};

use super::Comparison;
use crate::{bench::training::FRAMES, dense::DenseConfig};
use eddy_dataset::simulate::{SimulationRequest, Source};
use eddy_evaluation::{SCENE_FRAMES, bootstrap::MIN_SCENES};
use eddy_inference::checkpoint::{Activation, Architecture, Core, FrameOutput};
use eddy_learning::train::{Observed, TrainConfig};
use eddy_mpm::{Extent, Law, ParticleOrder, Preset, Settings};

/// What the seed of `study scenes`'s test scenes is larger by.
const TEST_SEEDS: u64 = 1000;

/// Settings of a study: data, networks and training budget.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StudyConfig {
    /// Seeds: every network is trained once per seed.
    pub seeds: Vec<u64>,
    /// The scenes.
    pub data: DataConfig,
    /// The cores of `study cores`.
    pub cores: Vec<Core>,
    /// Weights of the density loss in `study loss`.
    pub density_weights: Vec<f32>,
    /// Observed frames T in `study window`.
    pub windows: Vec<usize>,
    /// The cores whose windows are compared there.
    pub windowed_cores: Vec<Core>,
    /// What the networks of `study output` predict.
    pub outputs: Vec<FrameOutput>,
    /// The scenes of `study scenes`, each with the other settings of `data`.
    pub data_sets: Vec<SceneChoice>,
    /// The activations of `study activations`.
    pub activations: Vec<Activation>,
    /// The network in which activations are compared.
    pub dense: DenseConfig,
    /// Training settings of the other studies; the compared setting is replaced.
    pub training: TrainConfig,
    /// How they are evaluated.
    #[serde(alias = "judging")]
    pub evaluation: EvaluationConfig,
    /// Window lengths for which training steps of the cores are timed in `study cores`.
    pub step_frames: Vec<usize>,
    /// Approximate duration of each timing (s), at least three steps.
    pub step_seconds: f64,
}

/// The simulated scenes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// Presets of `eddy simulate`, one data set each. Cores are compared on all of them, other settings on the first.
    pub presets: Vec<String>,
    /// Scenes per preset: the first 80 % for training, the next 10 % for validation, the rest for the test.
    pub scenes: u32,
    /// Seed of the scenes.
    pub seed: u64,
    /// Length of a scene (simulated seconds); the preset's by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub duration: Option<f64>,
    /// Whether all scenes have the bodies of the first, at the same places.
    #[serde(default)]
    pub same_bodies: bool,
    /// The order in which particles are numbered.
    #[serde(default)]
    pub order: ParticleOrder,
    /// Scenes of a seed that is larger by 1,000, on which `study scenes` evaluates all its networks.
    pub test_scenes: u32,
}

/// Scenes that differ from those of a study's other comparisons.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneChoice {
    /// Number of scenes.
    pub scenes: u32,
    /// As [`DataConfig::same_bodies`].
    #[serde(default)]
    pub same_bodies: bool,
    /// As [`DataConfig::order`].
    #[serde(default)]
    pub order: ParticleOrder,
}

/// Scenes of a preset, simulated into a folder of their own.
#[derive(Clone, Debug, PartialEq)]
pub struct DataSet {
    /// The preset, the number of scenes, and what is special about them.
    pub name: String,
    /// The preset.
    pub preset: String,
    /// The scenes.
    pub scenes: SceneChoice,
    /// Their seed.
    pub seed: u64,
}

/// Evaluation of networks by free rollouts on the test scenes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Frames ahead that are compared with the truth.
    pub horizon: usize,
    /// Start frames per scene.
    pub starts: usize,
}

/// An invalid setting of a study.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: found {found}, expected {expected}")]
pub struct InvalidStudy {
    /// The key in the file.
    pub field: &'static str,
    /// Its value.
    pub found: String,
    /// What it should be.
    pub expected: &'static str,
}

impl StudyConfig {
    /// The paper's setup and training as published ([`TrainConfig::paper`]): 60 scenes per preset, the widths of Table 1, T = 2,
    /// three seeds. Its Table 4 has 85 to 99 epochs of 23,856 pairs in batches of 4,096, or 500 to 600 steps of Adam; this has
    /// at least 600, and goes on until 20 epochs of 30 steps bring no better validation loss.
    pub fn paper() -> Self {
        Self {
            seeds: vec![1, 2, 3],
            data: DataConfig {
                presets: ["fluid", "multi-material"].map(str::to_owned).to_vec(),
                scenes: 60,
                seed: 1,
                duration: None,
                same_bodies: false,
                order: ParticleOrder::Bodies,
                test_scenes: 60,
            },
            cores: vec![Core::MinGru, Core::MinLstm, Core::Lstm, Core::Gru, Core::Mlp],
            density_weights: vec![0.0, 1e-3, 1e-2],
            windows: vec![2, 4, 16],
            windowed_cores: vec![Core::MinGru],
            outputs: FrameOutput::ALL.to_vec(),
            data_sets: vec![
                SceneChoice::of(60),
                SceneChoice { same_bodies: true, ..SceneChoice::of(60) },
                SceneChoice { order: ParticleOrder::Curve, ..SceneChoice::of(60) },
                SceneChoice::of(600),
            ],
            activations: Activation::ALL.to_vec(),
            dense: DenseConfig::paper(50, 30 * 192),
            training: TrainConfig::paper(),
            evaluation: EvaluationConfig { horizon: 20, starts: 7 },
            step_frames: FRAMES.to_vec(),
            step_seconds: 2.0,
        }
    }

    /// The same comparisons with a training that lets every core learn: eddy's defaults for the frame model
    /// ([`TrainConfig::defaults`], but validated after windows as in training) on ten times as many scenes, at one budget for all cores.
    pub fn mended() -> Self {
        let mut mended = Self::paper();
        mended.data.scenes = 600;
        mended.windowed_cores.clone_from(&mended.cores);
        mended.training = TrainConfig::defaults(Architecture::Frame);
        mended.training.validation.observed = Observed::Window;
        mended
    }

    /// Ten short scenes per preset, narrow networks, two seeds: minutes on two cores. A functional check; the results are
    /// not meaningful.
    pub fn quick() -> Self {
        let mut quick = Self::paper();
        quick.seeds = vec![1, 2];
        (quick.data.scenes, quick.data.duration) = (10, Some(1.5));
        quick.data.test_scenes = 3;
        (quick.density_weights, quick.windows) = (vec![0.0, 1e-3], vec![1, 2, 4]);
        quick.data_sets =
            [SceneChoice::of(10), SceneChoice { same_bodies: true, ..SceneChoice::of(10) }]
                .to_vec();
        quick.dense = DenseConfig { epochs: 8, batch: 32, ..DenseConfig::paper(8, 10 * 32) };
        let training = &mut quick.training;
        (training.network.encoder, training.network.hidden) = (64, 200);
        (training.windows.batch, training.windows.per_epoch) = (16, 10 * 16);
        (training.epochs, training.patience) = (3, 3);
        quick.evaluation.starts = 3;
        (quick.step_frames, quick.step_seconds) = (vec![2, 16], 0.2);
        quick
    }

    /// What to know before reading the results; `None` for a study that can rank its networks.
    pub fn warning(&self, comparison: Comparison) -> Option<String> {
        let test = match comparison {
            Comparison::Scenes => self.data.test_scenes,
            // The last tenth of the scenes, rounded up.
            _ => self.data.scenes.div_ceil(10),
        };
        ((test as usize) < MIN_SCENES).then(|| {
            let scenes = if test == 1 { "scene" } else { "scenes" };
            format!(
                "This study shows that everything works, and nothing about ranks: it has {test} test {scenes} per preset. \
                 --paper has the paper's setup."
            )
        })
    }

    /// Checks all settings.
    ///
    /// # Errors
    /// [`InvalidStudy`] for the first invalid setting.
    pub fn check(&self) -> Result<(), InvalidStudy> {
        different("seeds", &self.seeds)?;
        different("data.presets", &self.data.presets)?;
        for preset in &self.data.presets {
            self.data.set(preset, self.data.usual()).simulation(&self.data)?;
        }
        different("cores", &self.cores)?;
        different("density_weights", &self.density_weights)?;
        different("windows", &self.windows)?;
        different("windowed_cores", &self.windowed_cores)?;
        different("outputs", &self.outputs)?;
        different("data_sets", &self.data_sets)?;
        different("activations", &self.activations)?;
        different("step_frames", &self.step_frames)?;
        let numbers = [
            (
                "data.scenes",
                self.data.scenes as usize,
                3,
                "at least 3: for training, validation and test",
            ),
            (
                "data_sets.scenes",
                self.data_sets.iter().map(|set| set.scenes as usize).min().unwrap_or(0),
                3,
                "at least 3: for training, validation and test",
            ),
            ("evaluation.horizon", self.evaluation.horizon, 1, "at least 1"),
            ("data.test_scenes", self.data.test_scenes as usize, 1, "at least 1"),
            (
                "step_frames",
                self.step_frames.iter().copied().min().unwrap_or(0),
                1,
                "at least 1 each",
            ),
            ("evaluation.starts", self.evaluation.starts, 1, "at least 1"),
        ];
        for (field, found, least, expected) in numbers {
            if found < least {
                return Err(InvalidStudy { field, found: found.to_string(), expected });
            }
        }
        if !(self.step_seconds > 0.0 && self.step_seconds.is_finite()) {
            let found = self.step_seconds.to_string();
            return Err(InvalidStudy {
                field: "step_seconds",
                found,
                expected: "a positive number",
            });
        }
        if self.evaluation.horizon > SCENE_FRAMES {
            let found = self.evaluation.horizon.to_string();
            let expected = "at most 20: errors of scenes are kept for the paper's 20 frames";
            return Err(InvalidStudy { field: "evaluation.horizon", found, expected });
        }
        if self.training.architecture != Architecture::Frame {
            let found = self.training.architecture.name().to_owned();
            let expected = "frame: the paper's network";
            return Err(InvalidStudy { field: "training.architecture", found, expected });
        }
        Ok(())
    }
}

impl SceneChoice {
    /// So many scenes that differ, numbered body by body.
    pub fn of(scenes: u32) -> Self {
        Self { scenes, same_bodies: false, order: ParticleOrder::Bodies }
    }

    /// What its name says of bodies and order.
    fn suffix(self) -> String {
        let bodies = if self.same_bodies { "-same-bodies" } else { "" };
        let order = match self.order {
            ParticleOrder::Curve => "-curve",
            ParticleOrder::Bodies => "",
        };
        format!("{bodies}{order}")
    }
}

impl DataConfig {
    /// The scenes of all comparisons but `study scenes`.
    pub fn usual(&self) -> SceneChoice {
        let &Self { scenes, same_bodies, order, .. } = self;
        SceneChoice { scenes, same_bodies, order }
    }

    /// Scenes of a preset.
    pub fn set(&self, preset: &str, scenes: SceneChoice) -> DataSet {
        let name = format!("{preset}-{}{}", scenes.scenes, scenes.suffix());
        DataSet { name, preset: preset.to_owned(), scenes, seed: self.seed }
    }

    /// The scenes on which `study scenes` evaluates networks that learned from such scenes: of another seed, with bodies that
    /// differ, and in the same order of particles.
    pub fn test_set(&self, preset: &str, order: ParticleOrder) -> DataSet {
        let scenes = SceneChoice { order, ..SceneChoice::of(self.test_scenes) };
        let name = format!("{preset}-test-{}{}", self.test_scenes, scenes.suffix());
        let seed = self.seed.wrapping_add(TEST_SEEDS);
        DataSet { name, preset: preset.to_owned(), scenes, seed }
    }
}

impl DataSet {
    /// The scenes as `eddy simulate` makes them, with the study's duration.
    ///
    /// # Errors
    /// [`InvalidStudy`] for an unknown preset.
    pub fn simulation(&self, data: &DataConfig) -> Result<SimulationRequest, InvalidStudy> {
        let all = [Preset::MultiMaterial, Preset::Fluid, Preset::Stiff, Preset::Kinds];
        let Some(found) = all.into_iter().find(|known| known.name() == self.preset) else {
            return Err(InvalidStudy {
                field: "data.presets",
                found: self.preset.clone(),
                expected: "multi-material, fluid, stiff or kinds",
            });
        };
        let SceneChoice { scenes, same_bodies, order } = self.scenes;
        let extent = Extent::usual(found);
        let order = (order != ParticleOrder::Bodies).then_some(order);
        Ok(SimulationRequest {
            source: Source::Random(if same_bodies { extent.with_same_bodies() } else { extent }),
            name: self.preset.clone(),
            scene_name: None,
            scenes,
            seed: self.seed,
            // The law of the results in `docs/lab/the_papers_study.md`.
            settings: Settings {
                duration: data.duration,
                order,
                law: Some(Law::Water),
                ..Settings::default()
            },
            fields: false,
            device: None,
            threads: None,
        })
    }
}

/// Checks that a list is not empty and has no duplicates.
fn different<T: PartialEq + std::fmt::Debug>(
    field: &'static str,
    list: &[T],
) -> Result<(), InvalidStudy> {
    let twice = (1..list.len()).any(|number| list[..number].contains(&list[number]));
    if list.is_empty() || twice {
        let expected = "at least one, without duplicates";
        return Err(InvalidStudy { field, found: format!("{list:?}"), expected });
    }
    Ok(())
}
