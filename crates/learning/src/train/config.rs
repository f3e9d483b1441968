//! Everything about a training run that can be chosen, with defaults for each architecture.

use serde::{Deserialize, Serialize};

use super::TrainError;
use eddy_inference::checkpoint::{Architecture, Core, Form, FrameOptions, GridOptions, Sizes};

/// The largest width a checkpoint may have.
const LARGEST_WIDTH: usize = 1 << 16;

/// A training run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// Which network.
    pub architecture: Architecture,
    /// Which recurrent core.
    pub core: Core,
    /// Seed of initial weights, of the order of the data, and of dropout.
    pub seed: u64,
    /// Most epochs; one epoch is `windows.per_epoch` windows.
    pub epochs: u32,
    /// Epochs without a better validation loss after which training stops early; it never does before
    /// the last stage of `unroll` has begun.
    pub patience: u32,
    /// Gravity of the data (domain lengths per second squared). Bags do not carry it.
    pub gravity: [f32; 2],
    /// Free frames a window, by share of the run: later stages unroll further.
    pub unroll: Vec<UnrollStage>,
    /// Widths.
    pub network: NetworkConfig,
    /// What a batch is made of.
    pub windows: WindowConfig,
    /// What is minimised.
    pub loss: LossConfig,
    /// How it is minimised.
    pub optimizer: OptimizerConfig,
    /// What the best epoch is chosen by.
    pub validation: ValidationConfig,
}

/// A part of the run with one length of unroll.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UnrollStage {
    /// Share of the run's iterations (any unit: shares are divided by their sum).
    pub share: f32,
    /// Frames the network predicts from its own output after the warm-up.
    pub frames: usize,
}

/// Widths of the network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkConfig {
    /// Width of the pointwise encoder's first layer.
    pub encoder: usize,
    /// Width of the hidden state.
    pub hidden: usize,
    /// Recurrent layers.
    pub layers: usize,
    /// Share of the core's outputs dropped in training, after each layer (0 to below 1).
    pub dropout: f32,
    /// Form of the minimal recurrences.
    pub form: Form,
    /// Whether minLSTM's gates are divided by their sum.
    pub normalize_gates: bool,
    /// Choices within the frame model.
    pub frame: FrameOptions,
    /// Particle model: width of a cell of its grid's finest level (domain lengths).
    pub cell_width: f32,
    /// Particle model: channels of each level of its grid, the finest first.
    pub channels: [usize; 3],
}

/// What a batch is made of.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WindowConfig {
    /// Observed frames at the start of each window.
    pub warm_up: usize,
    /// Windows a batch.
    pub batch: usize,
    /// Windows an epoch.
    pub per_epoch: usize,
    /// What is done to the last observed frame.
    pub noise: NoiseConfig,
    /// Whether every other window, by chance, is mirrored left to right. Right for data without a
    /// preferred side: a symmetric box, no sideways gravity.
    pub mirror: bool,
}

/// What an error is divided by before errors are summed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LossKind {
    /// The range of the feature in the training split: the mean squared error of MinMax-scaled
    /// features (the paper's eq. 2).
    Mse,
    /// The best trivial predictor's error of the same material and frame ahead; square root of the
    /// sum for each window, since these sums are heavy-tailed.
    Relative,
}

/// What is minimised.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossConfig {
    /// What errors are divided by.
    pub kind: LossKind,
    /// Weight of position errors.
    pub position_weight: f32,
    /// Weight of velocity errors.
    pub velocity_weight: f32,
    /// Weight of the one-step predictions during the warm-up, relative to the unroll's.
    pub observed_weight: f32,
    /// Relative loss: share of the error over all windows in the divisor; the rest is the window's
    /// own. 1 weighs windows as their errors are, 0 weighs all windows alike.
    pub common_share: f32,
    /// Weight of the density maps' mean squared error (1 = all particles spread evenly).
    pub density_weight: f32,
    /// Nodes of the density map along an axis.
    pub density_grid: usize,
}

/// What becomes of the learning rate over the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Schedule {
    /// It falls to its final share along half a cosine (Loshchilov and Hutter 2017, without restarts).
    Cosine,
    /// It stays as it is, the paper's.
    Constant,
}

/// Adam.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimizerConfig {
    /// The largest learning rate.
    pub learning_rate: f64,
    /// Share of the run in which the learning rate rises evenly from 0 to its largest, 0 to below 1.
    pub warm_up: f64,
    /// How the learning rate goes on from there.
    pub schedule: Schedule,
    /// Learning rate at the end of a falling schedule, as a share of the largest.
    pub final_share: f64,
    /// Largest norm of a tensor's gradient; longer ones are shortened to it, tensor by tensor. `inf`
    /// leaves all as they are.
    pub clip: f32,
    /// Keeps a step finite where gradients vanish.
    pub epsilon: f32,
    /// Share of the running average of the weights that a step leaves, 0 to below 1. The average is
    /// what is judged and saved; with 0, that is the weights themselves.
    pub average: f32,
}

/// What particles of the last observed frame are moved by, so that a network learns to correct what a
/// rollout gets wrong (Sanchez-Gonzalez et al. 2020).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoiseConfig {
    /// Standard deviation of positions (domain lengths).
    pub position: f32,
    /// Standard deviation of velocities (domain lengths per second).
    pub velocity: f32,
    /// Share of the windows that have any, 0 to 1.
    pub share: f32,
}

/// What the best epoch is chosen by.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ValidationConfig {
    /// Length of the free rollouts (frames).
    pub horizon: usize,
    /// Rollouts a validation stream.
    pub starts: usize,
}

impl NetworkConfig {
    /// Two layers without dropout; everything else by default.
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
            channels: [24, 32, 48],
        }
    }
}

impl TrainConfig {
    /// The defaults for a network.
    pub fn defaults(architecture: Architecture) -> Self {
        match architecture {
            Architecture::Particle => Self::particle(),
            Architecture::Frame => Self::frame(),
        }
    }

    /// `docs/src/background/particle_model.md` says what was tried.
    fn particle() -> Self {
        let stage = |share, frames| UnrollStage { share, frames };
        Self {
            architecture: Architecture::Particle,
            core: Core::MinGru,
            seed: 1,
            epochs: 40,
            patience: 40,
            gravity: [0.0, -9.8],
            unroll: vec![stage(0.4, 2), stage(0.3, 6), stage(0.25, 14), stage(0.05, 24)],
            network: NetworkConfig { layers: 1, ..NetworkConfig::of_widths(16, 24) },
            windows: WindowConfig {
                warm_up: 3,
                batch: 16,
                per_epoch: 4096,
                noise: NoiseConfig { position: 3e-4, velocity: 0.02, share: 0.5 },
                mirror: true,
            },
            loss: LossConfig {
                kind: LossKind::Relative,
                position_weight: 1.0,
                velocity_weight: 0.2,
                observed_weight: 0.5,
                common_share: 1.0,
                density_weight: 0.0,
                density_grid: 32,
            },
            optimizer: OptimizerConfig {
                learning_rate: 2.5e-3,
                warm_up: 0.0,
                schedule: Schedule::Cosine,
                final_share: 0.02,
                clip: 1.0,
                epsilon: 1e-5,
                average: 0.997,
            },
            validation: ValidationConfig { horizon: 20, starts: 3 },
        }
    }

    /// The paper's widths, window and learning rate. Sixteen windows of 2,500 particles take about
    /// half a second on two cores, hence the short epoch.
    fn frame() -> Self {
        Self {
            architecture: Architecture::Frame,
            core: Core::MinGru,
            seed: 1,
            epochs: 100,
            patience: 15,
            gravity: [0.0, -9.8],
            unroll: vec![UnrollStage { share: 1.0, frames: 1 }],
            network: NetworkConfig { dropout: 0.1, ..NetworkConfig::of_widths(256, 1250) },
            windows: WindowConfig {
                warm_up: 2,
                batch: 16,
                per_epoch: 512,
                noise: NoiseConfig { position: 0.0, velocity: 0.0, share: 0.0 },
                mirror: true,
            },
            loss: LossConfig {
                kind: LossKind::Mse,
                position_weight: 1.0,
                velocity_weight: 1.0,
                observed_weight: 0.0,
                common_share: 0.0,
                density_weight: 1e-3,
                density_grid: 32,
            },
            optimizer: OptimizerConfig {
                learning_rate: 1e-3,
                warm_up: 0.0,
                schedule: Schedule::Cosine,
                final_share: 0.02,
                clip: 1.0,
                epsilon: 1e-8,
                average: 0.0,
            },
            validation: ValidationConfig { horizon: 20, starts: 3 },
        }
    }

    /// Widths of the layers for streams of `particles` particles.
    pub fn sizes(&self, particles: usize) -> Sizes {
        Sizes {
            encoder: self.network.encoder,
            hidden: self.network.hidden,
            layers: self.network.layers,
            particles: (self.architecture == Architecture::Frame).then_some(particles),
        }
    }

    /// What the particle model sees of the grid of particles that are `spacing` apart.
    pub fn grid(&self, spacing: f32) -> Option<GridOptions> {
        let NetworkConfig { cell_width, channels, .. } = self.network;
        (self.architecture == Architecture::Particle).then_some(GridOptions {
            cell_width,
            channels,
            spacing,
        })
    }

    /// Batches an epoch.
    pub fn batches(&self) -> usize {
        self.windows.per_epoch.div_ceil(self.windows.batch.max(1))
    }

    /// Checks the numbers.
    ///
    /// # Errors
    /// [`TrainError::Setting`] for the first number that is out of its range.
    pub fn check(&self) -> Result<(), TrainError> {
        let at_least_one = [
            ("epochs", self.epochs as usize),
            ("network.encoder", self.network.encoder),
            ("network.hidden", self.network.hidden),
            ("network.layers", self.network.layers),
            ("windows.warm_up", self.windows.warm_up),
            ("windows.batch", self.windows.batch),
            ("windows.per_epoch", self.windows.per_epoch),
            ("validation.horizon", self.validation.horizon),
            ("validation.starts", self.validation.starts),
            ("unroll", self.unroll.len()),
            ("unroll.frames", self.unroll.iter().map(|stage| stage.frames).min().unwrap_or(1)),
        ];
        for (field, found) in at_least_one {
            if found == 0 {
                return Err(setting(field, "0", "at least 1"));
            }
        }
        if i64::try_from(self.seed).is_err() {
            return Err(setting("seed", self.seed, "at most 9223372036854775807, TOML's largest"));
        }
        let loss = &self.loss;
        let not_negative = [
            ("loss.position_weight", loss.position_weight),
            ("loss.velocity_weight", loss.velocity_weight),
            ("loss.observed_weight", loss.observed_weight),
            ("loss.density_weight", loss.density_weight),
        ];
        for (field, found) in not_negative {
            if !(found.is_finite() && found >= 0.0) {
                return Err(setting(field, found, "a number from 0"));
            }
        }
        let shares = self.unroll.iter().map(|stage| stage.share);
        if let Some(found) = shares.clone().find(|share| !(share.is_finite() && *share > 0.0)) {
            return Err(setting("unroll.share", found, "a positive number"));
        }
        if loss.position_weight + loss.velocity_weight == 0.0 {
            let field = "loss.position_weight, loss.velocity_weight";
            return Err(setting(field, "0, 0", "at least one above 0"));
        }
        if loss.density_weight > 0.0 && loss.density_grid < 2 {
            return Err(setting("loss.density_grid", loss.density_grid, "at least 2"));
        }
        if !(0.0..=1.0).contains(&loss.common_share) {
            return Err(setting("loss.common_share", loss.common_share, "0 to 1"));
        }
        if !(0.0..1.0).contains(&self.network.dropout) {
            return Err(setting("network.dropout", self.network.dropout, "0 to below 1"));
        }
        let rate = self.optimizer.learning_rate;
        if !(rate.is_finite() && rate > 0.0) {
            return Err(setting("optimizer.learning_rate", rate, "a positive number"));
        }
        if !(0.0..=1.0).contains(&self.optimizer.final_share) {
            return Err(setting("optimizer.final_share", self.optimizer.final_share, "0 to 1"));
        }
        let warm_up = self.optimizer.warm_up;
        if !(0.0..1.0).contains(&warm_up) {
            return Err(setting("optimizer.warm_up", warm_up, "0 to below 1"));
        }
        let average = self.optimizer.average;
        if !(0.0..1.0).contains(&average) {
            return Err(setting("optimizer.average", average, "0 to below 1"));
        }
        let NoiseConfig { position, velocity, share } = self.windows.noise;
        for (field, found) in
            [("windows.noise.position", position), ("windows.noise.velocity", velocity)]
        {
            if !(found.is_finite() && found >= 0.0) {
                return Err(setting(field, found, "a number from 0"));
            }
        }
        if !(0.0..=1.0).contains(&share) {
            return Err(setting("windows.noise.share", share, "0 to 1"));
        }
        let cell_width = self.network.cell_width;
        if !(cell_width.is_finite() && cell_width > 0.0) {
            return Err(setting("network.cell_width", cell_width, "a positive number"));
        }
        if self.network.channels.iter().any(|channels| !(1..=4096).contains(channels)) {
            let found = format!("{:?}", self.network.channels);
            return Err(setting("network.channels", found, "1 to 4096 each"));
        }
        let epsilon = self.optimizer.epsilon;
        if !(epsilon.is_finite() && epsilon > 0.0) {
            return Err(setting("optimizer.epsilon", epsilon, "a positive number"));
        }
        if self.architecture == Architecture::Particle
            && self.network.frame != FrameOptions::default()
        {
            let found = format!("{:?}", self.network.frame);
            return Err(setting("network.frame", found, "nothing for the particle model"));
        }
        if self.network.form == Form::Log && !matches!(self.core, Core::MinGru | Core::MinLstm) {
            return Err(setting("network.form", "log", "plain: only minGRU and minLSTM have both"));
        }
        if !self.network.normalize_gates && self.core != Core::MinLstm {
            let expected = "true: only minLSTM has gates to divide by their sum";
            return Err(setting("network.normalize_gates", "false", expected));
        }
        let clip = self.optimizer.clip;
        if clip.is_nan() || clip <= 0.0 {
            return Err(setting("optimizer.clip", clip, "a positive number"));
        }
        if !self.gravity.iter().all(|g| g.is_finite()) {
            return Err(setting("gravity", format!("{:?}", self.gravity), "finite numbers"));
        }
        for (field, found) in [
            ("network.encoder", self.network.encoder),
            ("network.hidden", self.network.hidden),
            ("network.layers", self.network.layers),
        ] {
            if found > LARGEST_WIDTH {
                return Err(setting(field, found, "at most 65536"));
            }
        }
        Ok(())
    }
}

pub(super) fn setting(
    field: &'static str,
    found: impl ToString,
    expected: &'static str,
) -> TrainError {
    TrainError::Setting { field, found: found.to_string(), expected }
}
