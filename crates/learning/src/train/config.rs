//! The settings of a training run.

use serde::{Deserialize, Serialize, Serializer};

use super::TrainError;
use eddy_inference::checkpoint::{
    Activation, Architecture, Core, ElasticRule, FeatureScaling, Form, FrameOptions, FrameOutput,
    GridOptions, MaterialInput, Pooling, Sizes, VALID_ASSUMPTION, VALID_KNOTS, WeightFormat,
    valid_assumption, valid_knots,
};

/// Width of layers up to which Muon runs on every supported GPU.
const WIDEST_OF_MUON: usize = 120;
/// Largest width in a checkpoint.
const LARGEST_WIDTH: usize = 1 << 16;
/// Most recurrent layers: a deeper core is not trained without residual connections, which there are not.
const MOST_LAYERS: usize = 64;
/// Largest learning rate: Adam's steps are about as long, weights are about one.
const LARGEST_LEARNING_RATE: f64 = 10.0;
/// Most nodes of the density maps along an axis.
const LARGEST_DENSITY_GRID: usize = 4096;

/// Settings of a training run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// Architecture of the network.
    pub architecture: Architecture,
    /// Recurrent core.
    pub core: Core,
    /// Seed of the initial weights, the order of the data, and dropout.
    pub seed: u64,
    /// Maximum number of epochs; an epoch is `windows.per_epoch` windows.
    pub epochs: u32,
    /// Number of epochs without a better validation loss after which training stops early, but not before the last stage of
    /// `unroll` has begun.
    pub patience: u32,
    /// Gravity in the data (domain lengths per second squared). Frames do not contain it; a bag that states another one as eddy_gravity is warned of.
    pub gravity: [f32; 2],
    /// Particle model: Young's modulus of jelly (density x velocity^2) for the rule `elastic`, .3 E of the scenes, 300 where E = 1e3; for a
    /// network that is conditioned on the stiffness, relative to a stream's, .3; 0: without the rule.
    #[serde(default)]
    pub elastic_modulus: f32,
    /// Number of freely predicted frames per window, by stages of the run: later stages unroll further.
    pub unroll: Vec<UnrollStage>,
    /// Free frames after which gradients through time are cut (truncated backpropagation through time), so that training on long
    /// rollouts stays stable; 0 never cuts. On CUDA for the particle model only.
    #[serde(default)]
    pub truncation: usize,
    /// Layers of the network.
    pub network: NetworkConfig,
    /// Training windows.
    pub windows: WindowConfig,
    /// Loss.
    pub loss: LossConfig,
    /// Optimizer.
    pub optimizer: OptimizerConfig,
    /// Validation, which selects the best epoch.
    pub validation: ValidationConfig,
}

/// A part of the run with a constant length of unroll.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UnrollStage {
    /// Share of the run's batches (shares are divided by their sum).
    pub share: f32,
    /// Frames the network predicts from its own output after the warm-up.
    pub frames: usize,
}

/// Layers of the network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkConfig {
    /// Width of the encoder's first layer.
    pub encoder: usize,
    /// Width of the hidden state.
    pub hidden: usize,
    /// Number of recurrent layers.
    pub layers: usize,
    /// Dropout after each layer of the core in training (0 to below 1).
    pub dropout: f32,
    /// Form of the minimal recurrences.
    pub form: Form,
    /// Whether minLSTM's gates are divided by their sum.
    pub normalize_gates: bool,
    /// Options of the frame model.
    #[serde(serialize_with = "every_option")]
    pub frame: FrameOptions,
    /// Particle model: cell width of the grid's finest level (domain lengths).
    pub cell_width: f32,
    /// Particle model: channels of each level of the grid, finest first; two to four levels.
    pub channels: Vec<usize>,
    /// Particle model: whether the network is conditioned on the stiffness of each stream, which custom_data.eddy_stiffness in
    /// metadata.yaml of its bag or manifest.json beside it must have.
    #[serde(default)]
    pub stiffness: bool,
    /// Particle model that is conditioned on the stiffness: two to four ascending stiffnesses (density x velocity^2) that have weights of
    /// their own; a stream's are interpolated in the logarithm of its stiffness. Each batch is of about one stiffness then.
    #[serde(default)]
    pub stiffness_knots: Vec<f32>,
    /// Particle model that is conditioned on the stiffness: that of streams whose source does not state it, when the network predicts
    /// (density x velocity^2). Without it, such streams are refused. Training streams must state theirs.
    #[serde(default)]
    pub assumed_stiffness: Option<f32>,
    /// Number type of the weights of the best checkpoint, which is validated with the rounded weights; `last/` keeps f32.
    #[serde(default)]
    pub weights: WeightFormat,
}

/// Writes options that a checkpoint omits too: a settings file is read over the defaults, which are others.
fn every_option<S: Serializer>(options: &FrameOptions, to: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Every {
        pooling: Pooling,
        activation: Activation,
        material: MaterialInput,
        scaling: FeatureScaling,
        output: FrameOutput,
    }
    let FrameOptions { pooling, activation, material, scaling, output } = *options;
    Every { pooling, activation, material, scaling, output }.serialize(to)
}

/// Training windows.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WindowConfig {
    /// Observed frames at the start of each window.
    pub warm_up: usize,
    /// Windows per batch.
    pub batch: usize,
    /// Windows per epoch.
    pub per_epoch: usize,
    /// Noise on the last observed frame.
    pub noise: NoiseConfig,
    /// Whether to mirror a random half of the windows left to right: for data without a preferred side (a symmetric domain, no
    /// sideways gravity).
    pub mirror: bool,
}

/// The normalisation of errors before they are summed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LossKind {
    /// By the feature's range in the training split: the mean squared error of MinMax-scaled features (the paper's eq. 2).
    Mse,
    /// By the best trivial predictor's error for the same material and number of frames ahead, and, if the network is conditioned
    /// on the stiffness, for about the same stiffness; the square root of the sum for each window, since these sums are
    /// heavy-tailed.
    Relative,
}

/// The loss.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossConfig {
    /// Normalisation of errors.
    pub kind: LossKind,
    /// Weight of position errors.
    pub position_weight: f32,
    /// Weight of velocity errors.
    pub velocity_weight: f32,
    /// Weight of one-step predictions during the warm-up, relative to those of the unroll.
    pub observed_weight: f32,
    /// Relative loss: exponent of the error over all windows (of about the same stiffness) in the divisor; the rest is the
    /// error of the window. With 1, windows count by their errors; with 0, all windows count alike.
    pub common_share: f32,
    /// Relative loss: added to the squared error of a window, in units of the best trivial predictor's, before the root. Windows
    /// whose error is less change the weights less; without it, a window that is predicted well changes them as much as any.
    #[serde(default = "LossConfig::least_error_floor")]
    pub error_floor: f32,
    /// Relative loss: position error below which accuracy does not count (domain lengths); of velocities, this in a frame. Errors
    /// below the noise do not count in windows with noise.
    #[serde(default = "LossConfig::usual_resolution")]
    pub resolution: f32,
    /// Weight of the mean squared error of density maps (whose mean is 1).
    pub density_weight: f32,
    /// Nodes of the density maps along an axis.
    pub density_grid: usize,
}

/// The schedule of the learning rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Schedule {
    /// Decreases to the final share along half a cosine (Loshchilov and Hutter 2017, without restarts).
    Cosine,
    /// Constant, as in the paper.
    Constant,
}

/// How weights are changed by their gradients.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OptimizerKind {
    /// Adam (Kingma and Ba 2015), which scales the step of each weight by its gradient's size.
    #[default]
    Adam,
    /// Muon (Jordan et al. 2024) for the matrices of hidden layers, whose steps it makes orthogonal, scaled as by Liu et al. 2025 so
    /// that Adam's learning rates fit; Adam for biases, the first layer and the decoder.
    Muon,
}

/// The optimizer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimizerConfig {
    /// Method. On CUDA, Muon is for the particle model only, with layers of which inputs or outputs are at most 120 (on an H100; GPUs
    /// whose blocks have less shared memory allow fewer).
    #[serde(default)]
    pub kind: OptimizerKind,
    /// Largest learning rate.
    pub learning_rate: f64,
    /// Share of the run during which the learning rate increases linearly from 0 to its largest value, 0 to below 1.
    pub warm_up: f64,
    /// Schedule of the learning rate after that.
    pub schedule: Schedule,
    /// Learning rate at the end of a decreasing schedule, relative to the largest.
    pub final_share: f64,
    /// Largest norm of a tensor's gradient; each tensor's gradient is clipped to it. `inf` switches clipping off.
    pub clip: f32,
    /// Adam's epsilon, which keeps steps finite where gradients vanish.
    pub epsilon: f32,
    /// Decay of the running average of the weights, 0 to below 1. The average is validated and saved; with 0, that is the
    /// weights themselves.
    pub average: f32,
}

/// Noise on the particles of the last observed frame, from which a network learns to correct the errors of a rollout
/// (Sanchez-Gonzalez et al. 2020).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoiseConfig {
    /// Standard deviation of positions (domain lengths).
    pub position: f32,
    /// Standard deviation of velocities (domain lengths per second).
    pub velocity: f32,
    /// Share of the windows with noise, 0 to 1.
    pub share: f32,
}

impl NoiseConfig {
    /// No noise.
    pub const NONE: Self = Self { position: 0.0, velocity: 0.0, share: 0.0 };
}

/// Validation by free rollouts, which selects the best epoch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ValidationConfig {
    /// Length of the free rollouts (frames).
    pub horizon: usize,
    /// Rollouts per validation stream.
    pub starts: usize,
    /// What the network has observed when a rollout begins.
    #[serde(default)]
    pub observed: Observed,
}

/// What a network has observed of a stream when a rollout begins.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Observed {
    /// All frames of the stream so far, as a node has.
    #[default]
    Stream,
    /// As many frames as in the training windows, as in the paper. A network that has never seen a longer stream may predict
    /// these well, and streams badly.
    Window,
}

impl TrainConfig {
    /// Whether the network can be trained on an NVIDIA GPU.
    pub fn runs_on_gpus(&self) -> bool {
        match self.architecture {
            Architecture::Frame => {
                self.truncation == 0 && self.optimizer.kind == OptimizerKind::Adam
            }
            Architecture::Particle => {
                let NetworkConfig { hidden, ref channels, dropout, .. } = self.network;
                let widest = channels.iter().copied().fold(hidden, usize::max);
                let fits = self.optimizer.kind == OptimizerKind::Adam || widest <= WIDEST_OF_MUON;
                self.loss.density_weight == 0.0 && dropout == 0.0 && fits
            }
        }
    }

    /// Sizes of the layers for streams of `particles` particles.
    pub fn sizes(&self, particles: usize) -> Sizes {
        Sizes {
            encoder: self.network.encoder,
            hidden: self.network.hidden,
            layers: self.network.layers,
            particles: (self.architecture == Architecture::Frame).then_some(particles),
        }
    }

    /// The particle model's grid for particles with this spacing (domain lengths).
    pub fn grid(&self, spacing: f32) -> Option<GridOptions> {
        let NetworkConfig { cell_width, channels, .. } = &self.network;
        (self.architecture == Architecture::Particle).then(|| GridOptions {
            cell_width: *cell_width,
            channels: channels.clone(),
            spacing,
        })
    }

    /// The constants of the rule `elastic`, if it is on, for particles with this spacing (domain lengths) and frames of `dt` seconds.
    pub(super) fn elastic(&self, spacing: f32, dt: f32) -> Option<ElasticRule> {
        let modulus = self.elastic_modulus;
        // Each stream has its own where the network is conditioned on the stiffness.
        (modulus > 0.0).then(|| match self.network.stiffness {
            true => ElasticRule { modulus, ..ElasticRule::default() },
            false => ElasticRule::new(modulus, spacing, dt),
        })
    }

    /// Batches per epoch.
    pub fn batches(&self) -> usize {
        self.windows.per_epoch.div_ceil(self.windows.batch.max(1))
    }

    /// Checks the values.
    ///
    /// # Errors
    /// [`TrainError::Setting`] for the first value that is out of its range.
    pub fn check(&self) -> Result<(), TrainError> {
        let Self { windows, loss, optimizer, validation, unroll, .. } = self;
        let largest_seed = "at most 9223372036854775807, TOML's largest";
        require("seed", self.seed, i64::try_from(self.seed).is_ok(), largest_seed)?;
        at_least_one("epochs", self.epochs as usize)?;
        at_least_one("windows.warm_up", windows.warm_up)?;
        at_least_one("windows.batch", windows.batch)?;
        at_least_one("windows.per_epoch", windows.per_epoch)?;
        at_least_one("validation.horizon", validation.horizon)?;
        at_least_one("validation.starts", validation.starts)?;
        at_least_one("unroll", unroll.len())?;
        for stage in unroll {
            at_least_one("unroll.frames", stage.frames)?;
            positive("unroll.share", stage.share)?;
        }
        let finite = self.gravity.iter().all(|g| g.is_finite());
        require("gravity", format!("{:?}", self.gravity), finite, "finite numbers")?;
        not_negative("windows.noise.position", windows.noise.position)?;
        not_negative("windows.noise.velocity", windows.noise.velocity)?;
        share("windows.noise.share", windows.noise.share)?;
        self.check_network()?;
        loss.check()?;
        optimizer.check()
    }

    fn check_network(&self) -> Result<(), TrainError> {
        let NetworkConfig { encoder, hidden, layers, dropout, form, ref channels, .. } =
            self.network;
        for (field, width) in [("network.encoder", encoder), ("network.hidden", hidden)] {
            let valid = (1..=LARGEST_WIDTH).contains(&width);
            require(field, width, valid, "1 to 65536")?;
        }
        let valid = (1..=MOST_LAYERS).contains(&layers);
        require("network.layers", layers, valid, "1 to 64")?;
        below_one("network.dropout", dropout)?;
        positive("network.cell_width", self.network.cell_width)?;
        let valid = GridOptions::valid_channels(channels);
        require("network.channels", format!("{channels:?}"), valid, GridOptions::CHANNELS)?;
        let (frame, default) = (self.network.frame, FrameOptions::default());
        let valid = self.architecture == Architecture::Frame || frame == default;
        require("network.frame", format!("{frame:?}"), valid, "nothing for the particle model")?;
        let knots = &self.network.stiffness_knots;
        let valid = valid_knots(knots, self.network.stiffness);
        require("network.stiffness_knots", format!("{knots:?}"), valid, VALID_KNOTS)?;
        if let Some(assumed) = self.network.assumed_stiffness {
            let valid = valid_assumption(assumed, self.network.stiffness);
            require("network.assumed_stiffness", assumed, valid, VALID_ASSUMPTION)?;
        }
        let valid = self.architecture == Architecture::Particle || !self.network.stiffness;
        require("network.stiffness", "true", valid, "false for the frame model")?;
        let modulus = self.elastic_modulus;
        let particle = self.architecture == Architecture::Particle;
        let most = if self.network.stiffness { 10.0 } else { f32::MAX };
        let valid = modulus == 0.0 || (modulus > 0.0 && modulus <= most && particle);
        let expected = "0 or more; at most 10, relative to a stream's stiffness, with network.stiffness; 0 for the frame model";
        require("elastic_modulus", modulus, valid, expected)?;
        let valid = form == Form::Plain || matches!(self.core, Core::MinGru | Core::MinLstm);
        require("network.form", "log", valid, "plain: only minGRU and minLSTM have both")?;
        let valid = self.network.normalize_gates || self.core == Core::MinLstm;
        let expected = "true: only minLSTM has gates to divide by their sum";
        require("network.normalize_gates", "false", valid, expected)
    }
}

impl LossConfig {
    /// Keeps the derivative of the square root finite.
    pub(super) const LEAST_ERROR_FLOOR: f32 = 1e-8;

    fn least_error_floor() -> f32 {
        Self::LEAST_ERROR_FLOOR
    }

    /// A fifteenth of the spacing of particles in the solver's scenes.
    pub(super) const USUAL_RESOLUTION: f32 = 5e-4;

    fn usual_resolution() -> f32 {
        Self::USUAL_RESOLUTION
    }

    fn check(&self) -> Result<(), TrainError> {
        not_negative("loss.position_weight", self.position_weight)?;
        not_negative("loss.velocity_weight", self.velocity_weight)?;
        not_negative("loss.observed_weight", self.observed_weight)?;
        not_negative("loss.density_weight", self.density_weight)?;
        let valid = (Self::LEAST_ERROR_FLOOR..=1.0).contains(&self.error_floor);
        require("loss.error_floor", self.error_floor, valid, "1e-8 to 1")?;
        let field = "loss.position_weight, loss.velocity_weight";
        let valid = self.position_weight + self.velocity_weight > 0.0;
        require(field, "0, 0", valid, "at least one above 0")?;
        let valid =
            self.density_weight == 0.0 || (2..=LARGEST_DENSITY_GRID).contains(&self.density_grid);
        require("loss.density_grid", self.density_grid, valid, "2 to 4096")?;
        positive("loss.resolution", self.resolution)?;
        share("loss.common_share", self.common_share)
    }
}

impl OptimizerConfig {
    fn check(&self) -> Result<(), TrainError> {
        let rate = self.learning_rate;
        let valid = rate > 0.0 && rate <= LARGEST_LEARNING_RATE;
        require("optimizer.learning_rate", rate, valid, "above 0, at most 10")?;
        share("optimizer.final_share", self.final_share)?;
        below_one("optimizer.warm_up", self.warm_up)?;
        below_one("optimizer.average", self.average)?;
        positive("optimizer.epsilon", self.epsilon)?;
        // Infinity switches clipping off.
        require("optimizer.clip", self.clip, self.clip > 0.0, "a positive number")
    }
}

fn require(
    field: &'static str,
    found: impl ToString,
    valid: bool,
    expected: &'static str,
) -> Result<(), TrainError> {
    if valid { Ok(()) } else { Err(setting(field, found, expected)) }
}

fn at_least_one(field: &'static str, found: usize) -> Result<(), TrainError> {
    require(field, found, found >= 1, "at least 1")
}

fn not_negative(field: &'static str, found: f32) -> Result<(), TrainError> {
    require(field, found, found.is_finite() && found >= 0.0, "a number from 0")
}

fn positive<T: Into<f64> + ToString + Copy>(
    field: &'static str,
    found: T,
) -> Result<(), TrainError> {
    let number = found.into();
    require(field, found, number.is_finite() && number > 0.0, "a positive number")
}

fn share<T: Into<f64> + ToString + Copy>(field: &'static str, found: T) -> Result<(), TrainError> {
    require(field, found, (0.0..=1.0).contains(&found.into()), "0 to 1")
}

fn below_one<T: Into<f64> + ToString + Copy>(
    field: &'static str,
    found: T,
) -> Result<(), TrainError> {
    require(field, found, (0.0..1.0).contains(&found.into()), "0 to below 1")
}

pub(super) fn setting(
    field: &'static str,
    found: impl ToString,
    expected: &'static str,
) -> TrainError {
    TrainError::Setting { field, found: found.to_string(), expected }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grid_has_two_to_four_levels() {
        let checked = |channels: &[usize]| {
            let mut config = TrainConfig::defaults(Architecture::Particle);
            config.network.channels = channels.to_vec();
            config.check().map_err(|error| error.to_string())
        };
        for channels in [&[8, 1][..], &[8, 4096, 3], &[8; 4]] {
            checked(channels).unwrap();
        }
        for channels in [&[][..], &[8], &[8; 5], &[8, 0], &[8, 4097]] {
            let message = checked(channels).unwrap_err();
            let expected = "expected two to four numbers, 1 to 4096 each";
            assert_eq!(message, format!("network.channels: found {channels:?}, {expected}"));
        }
    }

    #[test]
    fn weights_for_several_stiffnesses_need_two_to_four_rising_ones() {
        let checked = |knots: &[f32], stiffness| {
            let mut config = TrainConfig::defaults(Architecture::Particle);
            config.network.stiffness_knots = knots.to_vec();
            config.network.stiffness = stiffness;
            config.check().map_err(|error| error.to_string())
        };
        checked(&[], false).unwrap();
        checked(&[1e2, 1e5], true).unwrap();
        for (knots, stiffness) in [
            (&[1e2, 1e5][..], false),
            (&[1e2], true),
            (&[1e5, 1e2], true),
            (&[0.0, 1e2], true),
            (&[1.0, 2.0, 3.0, 4.0, 5.0], true),
        ] {
            let message = checked(knots, stiffness).unwrap_err();
            let found = format!("network.stiffness_knots: found {knots:?}, expected {VALID_KNOTS}");
            assert_eq!(message, found);
        }
    }
}
