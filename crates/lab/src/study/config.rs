//! Everything about a study that can be chosen.

use serde::{Deserialize, Serialize};

use crate::bench::training::FRAMES;
use eddy_evaluation::{
    SCENE_FRAMES,
    dataset::simulate::{SimulationRequest, Source},
};
use eddy_inference::checkpoint::{Activation, Architecture, Core, MaterialInput};
use eddy_learning::train::{Schedule, TrainConfig, dense::DenseConfig};
use eddy_mpm::{Extent, Preset, Settings};

/// What is compared, on which data, with how much training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StudyConfig {
    /// Seeds: every network is trained once with each.
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
    /// The network they are compared with.
    pub dense: DenseConfig,
    /// How the networks of the other studies are trained; what is compared takes the place of its setting here.
    pub training: TrainConfig,
    /// How they are judged.
    pub judging: JudgingConfig,
    /// Frames a window for which training steps of the cores are timed in `study cores`.
    pub step_frames: Vec<usize>,
    /// About how long each of them is timed (s); five steps at least.
    pub step_seconds: f64,
}

/// Which scenes are simulated.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// Presets of `eddy simulate`; each is a data set of its own. Cores are compared on all of them, the rest on
    /// the first.
    pub presets: Vec<String>,
    /// Scenes of each. The first 80 % of them train, the next 10 % validate, the rest judge.
    pub scenes: u32,
    /// Seed of the scenes.
    pub seed: u64,
    /// Length of a scene (simulated seconds); its own if not given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub duration: Option<f64>,
}

/// How networks are judged: free rollouts over the scenes that nobody was trained on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JudgingConfig {
    /// Frames of the rollouts that are compared with the truth.
    pub horizon: usize,
    /// Start frames a scene.
    pub starts: usize,
}

/// A setting of a study that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: found {found}, expected {expected}")]
pub struct InvalidStudy {
    /// The setting's name in the file.
    pub field: &'static str,
    /// Its value.
    pub found: String,
    /// What it should be.
    pub expected: &'static str,
}

impl StudyConfig {
    /// The paper's: 60 scenes of each preset, the widths of Table 1, T = 2, three seeds. The paper's Table 4 has
    /// 85 to 99 epochs of 23,856 pairs in batches of 4,096: 500 to 600 steps of Adam. This has 600, in the
    /// batches of 192 that the paper began with.
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
            judging: JudgingConfig { horizon: 20, starts: 7 },
            step_frames: FRAMES.to_vec(),
            step_seconds: 2.0,
        }
    }

    /// Minutes on two cores: ten short scenes of each preset, narrow networks, two seeds. It shows that everything
    /// works, not who is better.
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
        quick.judging.starts = 3;
        (quick.step_frames, quick.step_seconds) = (vec![2, 16], 0.2);
        quick
    }

    /// Checks the numbers and names.
    ///
    /// # Errors
    /// [`InvalidStudy`] for the first setting that cannot be used.
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
                "at least 3: to learn, to choose, to judge",
            ),
            ("judging.horizon", self.judging.horizon, 1, "at least 1"),
            (
                "step_frames",
                self.step_frames.iter().copied().min().unwrap_or(0),
                1,
                "at least 1 each",
            ),
            ("judging.starts", self.judging.starts, 1, "at least 1"),
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
        if self.judging.horizon > SCENE_FRAMES {
            let found = self.judging.horizon.to_string();
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
    /// [`InvalidStudy`] for a name that is no preset of random scenes.
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
            threads: None,
        })
    }
}

/// Refuses a list that is empty, or has something twice.
fn different<T: PartialEq + std::fmt::Debug>(
    field: &'static str,
    list: &[T],
) -> Result<(), InvalidStudy> {
    let twice = (1..list.len()).any(|number| list[..number].contains(&list[number]));
    if list.is_empty() || twice {
        let expected = "at least one, none of them twice";
        return Err(InvalidStudy { field, found: format!("{list:?}"), expected });
    }
    Ok(())
}
