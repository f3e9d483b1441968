//! The defaults of training runs.

use serde::{Deserialize, Serialize};

use super::{
    LossConfig, LossKind, NetworkConfig, NoiseConfig, Observed, OptimizerConfig, OptimizerKind,
    Schedule, TrainConfig, TrainError, UnrollStage, ValidationConfig, WindowConfig,
    config::setting,
};
use eddy_inference::checkpoint::{
    Architecture, Core, Description, Form, FrameOptions, FrameOutput, MaterialInput, WeightFormat,
};

/// A set of defaults for a training run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Recipe {
    /// What eddy has found to work best.
    #[default]
    Default,
    /// The paper's network, loss and optimizer as published; batches of 4,096 windows, for a GPU.
    Paper,
}

impl Recipe {
    /// The defaults, for an architecture if one is asked for, or for a run that starts from a network.
    ///
    /// # Errors
    /// [`TrainError::Setting`] for the paper's recipe of another network than the paper's.
    pub fn defaults(
        self,
        architecture: Option<Architecture>,
        start: Option<&Description>,
    ) -> Result<TrainConfig, TrainError> {
        if self == Self::Paper && start.is_some() {
            return Err(setting("recipe", "paper with a checkpoint to start from", "default"));
        }
        let defaults = match (self, start.map(|network| network.architecture).or(architecture)) {
            (Self::Default, architecture) => {
                TrainConfig::defaults(architecture.unwrap_or_default())
            }
            (Self::Paper, None | Some(Architecture::Frame)) => TrainConfig::paper(),
            (Self::Paper, Some(Architecture::Particle)) => {
                let found = "paper for architecture particle";
                return Err(setting("recipe", found, "architecture frame"));
            }
        };
        Ok(match start {
            Some(network) => defaults.starting_from(network),
            None => defaults,
        })
    }
}

impl TrainConfig {
    /// The defaults of an architecture.
    pub fn defaults(architecture: Architecture) -> Self {
        match architecture {
            Architecture::Particle => Self::particle(),
            Architecture::Frame => Self::frame(),
        }
    }

    /// The particle model's, and what the others have in common with it. `docs/src/background/particle_model.md` describes the
    /// alternatives.
    fn particle() -> Self {
        Self {
            architecture: Architecture::Particle,
            core: Core::MinGru,
            seed: 1,
            epochs: 40,
            patience: 40,
            gravity: [0.0, -9.8],
            elastic_modulus: 0.0,
            unroll: stages(&[(0.4, 2), (0.3, 6), (0.25, 14), (0.05, 24)]),
            truncation: 0,
            network: NetworkConfig { layers: 1, ..NetworkConfig::of_widths(16, 24) },
            windows: WindowConfig {
                warm_up: 3,
                batch: 16,
                per_epoch: 4096,
                noise: NoiseConfig { position: 3e-4, velocity: 0.02, share: 0.5 },
                mirror: true,
            },
            // Errors in units of the best trivial predictor's over many windows, positions before velocities.
            loss: LossConfig {
                kind: LossKind::Relative,
                position_weight: 1.0,
                velocity_weight: 0.2,
                observed_weight: 0.5,
                common_share: 1.0,
                error_floor: LossConfig::LEAST_ERROR_FLOOR,
                resolution: LossConfig::USUAL_RESOLUTION,
                density_weight: 0.0,
                density_grid: 32,
            },
            optimizer: OptimizerConfig {
                kind: OptimizerKind::Muon,
                learning_rate: 2.5e-3,
                warm_up: 0.0,
                schedule: Schedule::Cosine,
                final_share: 0.02,
                clip: 1.0,
                epsilon: 1e-5,
                average: 0.997,
            },
            validation: ValidationConfig { horizon: 20, starts: 3, observed: Observed::Stream },
        }
    }

    /// The paper's network with what it needs to learn: a residual on the ballistic step, errors in units of the best trivial
    /// predictor's, free rollouts, a falling rate. Its 4,800 steps take about a minute on an H100; on CPUs, use smaller
    /// batches.
    fn frame() -> Self {
        let base = Self::particle();
        let mut network = NetworkConfig { dropout: 0.1, ..NetworkConfig::of_widths(256, 1250) };
        network.frame.output = FrameOutput::Residual;
        Self {
            architecture: Architecture::Frame,
            epochs: 8,
            patience: 8,
            unroll: stages(&[(0.25, 1), (0.15, 5), (0.6, 20)]),
            network,
            windows: WindowConfig {
                warm_up: 2,
                batch: 256,
                per_epoch: 600 * 256,
                noise: NoiseConfig::NONE,
                ..base.windows
            },
            optimizer: OptimizerConfig {
                kind: OptimizerKind::Adam,
                // Larger rates let the loss jump up, with a network that does not recover.
                learning_rate: 3e-4,
                warm_up: 0.05,
                epsilon: 1e-8,
                average: 0.99,
                ..base.optimizer
            },
            ..base
        }
    }

    /// The paper's training of its network: the mean squared error of the next frame, a constant rate, batches of 4,096 windows,
    /// the 600 steps of its Table 4 and on until 20 epochs of 30 steps bring nothing. `docs/src/background/paper.md` shows why
    /// this hardly moves the weights.
    pub fn paper() -> Self {
        let base = Self::frame();
        let frame = FrameOptions { material: MaterialInput::Scalar, ..FrameOptions::default() };
        Self {
            epochs: 40,
            patience: 20,
            unroll: stages(&[(1.0, 1)]),
            network: NetworkConfig { frame, ..base.network },
            windows: WindowConfig {
                batch: 4096,
                per_epoch: 30 * 4096,
                mirror: false,
                ..base.windows
            },
            loss: LossConfig {
                kind: LossKind::Mse,
                velocity_weight: 1.0,
                observed_weight: 0.0,
                common_share: 0.0,
                density_weight: 1e-3,
                ..base.loss
            },
            optimizer: OptimizerConfig {
                learning_rate: 1e-3,
                warm_up: 0.0,
                schedule: Schedule::Constant,
                final_share: 1.0,
                clip: f32::INFINITY,
                average: 0.0,
                ..base.optimizer
            },
            validation: ValidationConfig { observed: Observed::Window, ..base.validation },
            ..base
        }
    }
}

/// Stages of their shares of the run and numbers of free frames.
fn stages(stages: &[(f32, usize)]) -> Vec<UnrollStage> {
    stages.iter().map(|&(share, frames)| UnrollStage { share, frames }).collect()
}

/// Share of the usual learning rate for a network that is trained already.
const STARTED_RATE: f64 = 0.2;

impl TrainConfig {
    /// These defaults for a run that starts from a network: its layers, gravity and observed frames, and a fifth of the
    /// learning rate, since larger steps would undo what it has learned.
    #[must_use]
    pub fn starting_from(mut self, network: &Description) -> Self {
        (self.architecture, self.core) = (network.architecture, network.core);
        self.network = self.network.with_layers_of(network);
        self.gravity = network.gravity;
        self.elastic_modulus = network.rules.elastic.map_or(0.0, |rule| rule.modulus);
        self.windows.warm_up = network.warm_up as usize;
        self.optimizer.learning_rate *= STARTED_RATE;
        self
    }
}

impl NetworkConfig {
    /// The same with the layers of a network.
    pub(super) fn with_layers_of(&self, network: &Description) -> Self {
        let grid = network.grid.as_ref();
        Self {
            encoder: network.sizes.encoder,
            hidden: network.sizes.hidden,
            layers: network.sizes.layers,
            dropout: self.dropout,
            form: network.form,
            normalize_gates: network.normalize_gates,
            frame: network.frame,
            cell_width: grid.map_or(self.cell_width, |grid| grid.cell_width),
            channels: grid.map_or_else(|| self.channels.clone(), |grid| grid.channels.clone()),
            // A network that does not know the stiffness can be the start of one that does.
            stiffness: network.stiffness || self.stiffness,
            // One set of weights can be the start of several.
            stiffness_knots: match network.stiffness_knots.as_slice() {
                [] => self.stiffness_knots.clone(),
                knots => knots.to_vec(),
            },
            assumed_stiffness: self.assumed_stiffness.or(network.assumed_stiffness),
            weights: self.weights,
        }
    }

    /// Two layers without dropout, other options by default.
    fn of_widths(encoder: usize, hidden: usize) -> Self {
        Self {
            encoder,
            hidden,
            layers: 2,
            dropout: 0.0,
            form: Form::default(),
            normalize_gates: true,
            frame: FrameOptions::default(),
            cell_width: 1.0 / 32.0,
            channels: vec![24, 32, 48, 64],
            stiffness: false,
            stiffness_knots: Vec::new(),
            assumed_stiffness: None,
            weights: WeightFormat::default(),
        }
    }
}
