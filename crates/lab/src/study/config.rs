//! Settings of a study.

use serde::{Deserialize, Serialize};

use crate::bench::training::FRAMES;
use eddy_evaluation::{
    SCENE_FRAMES,
    bootstrap::MIN_SCENES,
    dataset::simulate::{SimulationRequest, Source},
};
use eddy_inference::checkpoint::{Activation, Architecture, Core, MaterialInput};
use eddy_learning::train::{Schedule, TrainConfig, dense::DenseConfig};
use eddy_mpm::{Extent, Preset, Settings};

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
    /// The activations of `study activations`.
    pub activations: Vec<Activation>,
    /// The network in which activations are compared.
    pub dense: DenseConfig,
    /// Training settings of the other studies; the compared setting is replaced.
    pub training: TrainConfig,
    /// How they are evaluated.
    #[serde(rename = "judging")]
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
    /// The paper's setup: 60 scenes per preset, the widths of Table 1, T = 2, three seeds. The paper's Table 4 has 85 to 99
    /// epochs of 23,856 pairs in batches of 4,096, or 500 to 600 steps of Adam; this has 600 steps, in batches of 192 as
    /// initially in the paper.
    pub fn paper() -> Self {
        let mut training = TrainConfig::defaults(Architecture::Frame);
        training.network.frame.material = MaterialInput::Scalar;
        training.windows.batch = 192;
        training.windows.per_epoch = 30 * 192;
        training.windows.mirror = false;
        training.optimizer.schedule = Schedule::Constant;
        training.optimizer.clip = f32::INFINITY;
        (training.epochs, training.patience) = (20, 20);
        Self {
            seeds: vec![1, 2, 3],
            data: DataConfig {
                presets: ["fluid", "multi-material"].map(str::to_owned).to_vec(),
                scenes: 60,
                seed: 1,
                duration: None,
            },
            cores: vec![Core::MinGru, Core::MinLstm, Core::Lstm, Core::Gru, Core::Mlp],
            density_weights: vec![0.0, 1e-3, 1e-2],
            windows: vec![1, 2, 4],
            windowed_cores: vec![Core::MinGru],
            activations: Activation::ALL.to_vec(),
            dense: DenseConfig::paper(50, 30 * 192),
            training,
            evaluation: EvaluationConfig { horizon: 20, starts: 7 },
            step_frames: FRAMES.to_vec(),
            step_seconds: 2.0,
        }
    }

    /// Ten short scenes per preset, narrow networks, two seeds: minutes on two cores. A functional check; the results are
    /// not meaningful.
    pub fn quick() -> Self {
        let mut quick = Self::paper();
        quick.seeds = vec![1, 2];
        (quick.data.scenes, quick.data.duration) = (10, Some(1.5));
        (quick.density_weights, quick.windows) = (vec![0.0, 1e-3], vec![1, 2, 4]);
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
    pub fn warning(&self) -> Option<String> {
        // The last tenth of the scenes, rounded up.
        let test = self.data.scenes.div_ceil(10);
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
            self.data.simulation(preset)?;
        }
        different("cores", &self.cores)?;
        different("density_weights", &self.density_weights)?;
        different("windows", &self.windows)?;
        different("windowed_cores", &self.windowed_cores)?;
        different("activations", &self.activations)?;
        different("step_frames", &self.step_frames)?;
        let numbers = [
            (
                "data.scenes",
                self.data.scenes as usize,
                3,
                "at least 3: for training, validation and test",
            ),
            ("judging.horizon", self.evaluation.horizon, 1, "at least 1"),
            (
                "step_frames",
                self.step_frames.iter().copied().min().unwrap_or(0),
                1,
                "at least 1 each",
            ),
            ("judging.starts", self.evaluation.starts, 1, "at least 1"),
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
            return Err(InvalidStudy { field: "judging.horizon", found, expected });
        }
        if self.training.architecture != Architecture::Frame {
            let found = self.training.architecture.name().to_owned();
            let expected = "frame: the paper's network";
            return Err(InvalidStudy { field: "training.architecture", found, expected });
        }
        Ok(())
    }
}

impl DataConfig {
    /// The scenes of a preset, as `eddy simulate` makes them.
    ///
    /// # Errors
    /// [`InvalidStudy`] for an unknown preset.
    pub fn simulation(&self, preset: &str) -> Result<SimulationRequest, InvalidStudy> {
        let all = [Preset::MultiMaterial, Preset::Fluid, Preset::Stiff, Preset::Kinds];
        let Some(found) = all.into_iter().find(|known| known.name() == preset) else {
            return Err(InvalidStudy {
                field: "data.presets",
                found: preset.to_owned(),
                expected: "multi-material, fluid, stiff or kinds",
            });
        };
        Ok(SimulationRequest {
            source: Source::Random(Extent::usual(found)),
            name: preset.to_owned(),
            scene_name: None,
            scenes: self.scenes,
            seed: self.seed,
            settings: Settings { duration: self.duration, ..Settings::default() },
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
