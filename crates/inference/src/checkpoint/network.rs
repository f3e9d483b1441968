//! The network of a checkpoint: architecture, core, options and sizes.

use std::ops::RangeInclusive;

use half::f16;
use serde::{Deserialize, Serialize};

use crate::kernels::nodes::{MAX_LEVELS, MIN_LEVELS};

/// The architecture of a network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Architecture {
    /// The paper's network: one hidden state per frame, a fixed number of particles (Table 1).
    Frame,
    /// One hidden state per particle, shared weights, any number of particles.
    #[default]
    Particle,
}

impl Architecture {
    /// Its name in files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Frame => "frame",
            Self::Particle => "particle",
        }
    }
}

/// Number type of a checkpoint's weights. Networks compute in f32 with either.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WeightFormat {
    /// 32 bits.
    #[default]
    F32,
    /// 16 bits, 11 of them significant (IEEE 754 binary16): half the size, values up to 65504, to which larger ones are limited.
    F16,
}

impl WeightFormat {
    #[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
    pub(super) fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// The nearest number of this type.
    pub(super) fn rounded(self, value: f32) -> f32 {
        match self {
            Self::F32 => value,
            Self::F16 => {
                let limit = f16::MAX.to_f32();
                f16::from_f32(value.clamp(-limit, limit)).to_f32()
            }
        }
    }
}

/// How the frame model pools particles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Pooling {
    /// The mean over the particles.
    #[default]
    #[serde(rename = "mean")]
    Mean,
    /// The largest value over the particles.
    #[serde(rename = "max")]
    Max,
    /// Both, concatenated.
    #[serde(rename = "mean+max")]
    MeanMax,
}

/// The activation after the frame model's linear layers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    /// 1 / (1 + exp(-x)).
    Sigmoid,
    /// Hyperbolic tangent.
    Tanh,
    /// max(0, x).
    Relu,
    /// x for x > 0, exp(x) - 1 below (Clevert et al. 2015), the paper's choice.
    #[default]
    Elu,
}

impl Activation {
    /// All activations, in the order of the paper's Fig. 5.
    pub const ALL: [Self; 4] = [Self::Sigmoid, Self::Tanh, Self::Relu, Self::Elu];

    /// Its name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sigmoid => "sigmoid",
            Self::Tanh => "tanh",
            Self::Relu => "relu",
            Self::Elu => "elu",
        }
    }
}

/// How a particle's material enters the frame model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum MaterialInput {
    /// One input per material: 1 for the particle's material, else 0.
    #[default]
    #[serde(rename = "one-hot")]
    OneHot,
    /// As in the paper: one input, the material's number divided by the largest, 0..1.
    #[serde(rename = "scalar")]
    Scalar,
}

/// How the frame model's features are normalised, with statistics of the training split.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum FeatureScaling {
    /// To 0..1 by minimum and maximum (the paper's eq. 1).
    #[default]
    #[serde(rename = "min-max")]
    MinMax,
    /// By mean and standard deviation.
    #[serde(rename = "z-score")]
    ZScore,
}

/// What the frame model's decoder predicts of each particle: o, two numbers. x, v: position and velocity (domain lengths,
/// domain lengths per second); dt: time between two frames (s).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FrameOutput {
    /// The change of the velocity: v' = v + o, x' = x + v' dt. Zeros are constant velocity.
    #[default]
    Displacement,
    /// The change of the velocity after the ballistic step to (xb, vb): v' = vb + o, x' = xb + o dt / 2. Zeros are free fall
    /// between walls.
    Residual,
    /// The next position in standard deviations from the mean of the training split: x' = mean + deviation o,
    /// v' = (x' - x) / dt. Zeros are the mean.
    Position,
}

impl FrameOutput {
    /// All outputs.
    pub const ALL: [Self; 3] = [Self::Displacement, Self::Residual, Self::Position];

    /// Its name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Displacement => "displacement",
            Self::Residual => "residual",
            Self::Position => "position",
        }
    }
}

/// Options of the frame model that the paper leaves open or compares.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FrameOptions {
    /// Pooling over particles.
    pub pooling: Pooling,
    /// Activation of the encoder, the MLP core and the mixer.
    pub activation: Activation,
    /// How materials enter.
    pub material: MaterialInput,
    /// How the other features are normalised.
    pub scaling: FeatureScaling,
    /// What the decoder predicts.
    #[serde(skip_serializing_if = "is_displacement")]
    pub output: FrameOutput,
}

/// Omitted from the file: checkpoints without other outputs keep their digests.
#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_displacement(output: &FrameOutput) -> bool {
    *output == FrameOutput::Displacement
}

impl FrameOptions {
    pub(super) fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

/// The sparse grid that connects the particle model's particles with their surroundings: particles are summed on its nodes,
/// two to four levels of convolutions follow, and particles gather the result. Its table in `model.toml` is `[surroundings]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridOptions {
    /// Cell width of the finest level (domain lengths); each coarser level has cells twice as wide.
    pub cell_width: f32,
    /// Channels of each level, finest first; two to four levels.
    pub channels: Vec<usize>,
    /// Distance between neighbouring particles at rest (domain lengths).
    pub spacing: f32,
}

impl GridOptions {
    /// Numbers of levels that a grid can have.
    pub const LEVELS: RangeInclusive<usize> = MIN_LEVELS..=MAX_LEVELS;

    /// What is expected of the channels.
    pub const CHANNELS: &str = "two to four numbers, 1 to 4096 each";

    /// Whether the channels are as expected.
    pub fn valid_channels(channels: &[usize]) -> bool {
        Self::LEVELS.contains(&channels.len())
            && channels.iter().all(|width| (1..=1 << 12).contains(width))
    }
}

/// Sizes of a network's layers.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sizes {
    /// Width of the encoder's first layer.
    pub encoder: usize,
    /// Width of the hidden state.
    pub hidden: usize,
    /// Number of recurrent layers.
    pub layers: usize,
    /// The frame model's number of particles; absent in particle models.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub particles: Option<usize>,
}
