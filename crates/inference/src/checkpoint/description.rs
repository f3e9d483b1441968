//! `model.toml`: what a network is, what it saw, how its numbers are scaled.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{CheckpointError, Rules, rules};
use eddy_frames::{Domain, Material};
use eddy_settings::near;

/// Version of the checkpoint format that is written. It goes up when a file of the old form would be misread.
///
/// Version 1, which is read as well, had no `[rules]`: particle models had [`Rules::STANDARD`] whatever the file said.
pub const FORMAT_VERSION: u32 = 2;

/// Which network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Architecture {
    /// The paper's: one hidden state for the whole frame, a fixed number of particles (Table 1).
    Frame,
    /// One hidden state a particle, weights shared, any number of particles.
    #[default]
    Particle,
}

impl Architecture {
    /// The word in files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Frame => "frame",
            Self::Particle => "particle",
        }
    }
}

/// Which core.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Core {
    /// No recurrence: a linear layer and the activation, the paper's baseline.
    Mlp,
    /// Long short-term memory (Hochreiter and Schmidhuber 1997), as PyTorch has it.
    Lstm,
    /// Gated recurrent unit (Cho et al. 2014), as PyTorch has it.
    Gru,
    /// Forget gate, input gate, candidate (Feng et al. 2024, section 3.2).
    #[cfg_attr(feature = "clap", value(name = "minlstm"))]
    MinLstm,
    /// One gate, one candidate (Feng et al. 2024, section 3.1).
    #[default]
    #[cfg_attr(feature = "clap", value(name = "mingru"))]
    MinGru,
}

impl Core {
    /// Every core, the paper's order.
    pub const ALL: [Self; 5] = [Self::Mlp, Self::Lstm, Self::Gru, Self::MinLstm, Self::MinGru];

    /// The word in files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mlp => "mlp",
            Self::Lstm => "lstm",
            Self::Gru => "gru",
            Self::MinLstm => "minlstm",
            Self::MinGru => "mingru",
        }
    }
}

/// Which form of the minimal recurrences; the other cores have only one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Form {
    /// Candidates enter as they are (the paper's Fig. 6).
    #[default]
    Plain,
    /// Candidates are made positive first, by g(x) = x + 1/2 for x >= 0 and sigmoid(x) below, so that
    /// the recurrence can be computed in logarithms (Feng et al. 2024, appendix B). Another model.
    Log,
}

/// How the frame model makes one row of the particles' rows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Pooling {
    /// The mean over the particles.
    #[default]
    #[serde(rename = "mean")]
    Mean,
    /// The largest value over the particles.
    #[serde(rename = "max")]
    Max,
    /// Both, side by side.
    #[serde(rename = "mean+max")]
    MeanMax,
}

/// What follows the frame model's linear layers.
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
    /// Every activation, the order of the paper's Fig. 5.
    pub const ALL: [Self; 4] = [Self::Sigmoid, Self::Tanh, Self::Relu, Self::Elu];

    /// The word in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sigmoid => "sigmoid",
            Self::Tanh => "tanh",
            Self::Relu => "relu",
            Self::Elu => "elu",
        }
    }
}

/// How the frame model is told a particle's material.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum MaterialInput {
    /// A number each, 1 for the particle's material and 0 for the others.
    #[default]
    #[serde(rename = "one-hot")]
    OneHot,
    /// The paper's: one number, the material's number divided by the largest, 0..1.
    #[serde(rename = "scalar")]
    Scalar,
}

/// How the frame model's features are scaled, by the statistics of the training split.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum FeatureScaling {
    /// To 0..1 by the smallest and the largest value (the paper's eq. 1).
    #[default]
    #[serde(rename = "min-max")]
    MinMax,
    /// By mean and standard deviation.
    #[serde(rename = "z-score")]
    ZScore,
}

/// What the paper leaves open about the frame model, and what it compares.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FrameOptions {
    /// From particles to a frame.
    pub pooling: Pooling,
    /// Of the encoder, of the MLP core and of the mixer.
    pub activation: Activation,
    /// How materials enter.
    pub material: MaterialInput,
    /// How the other features are scaled.
    pub scaling: FeatureScaling,
}

impl FrameOptions {
    fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

/// How the particle model sees what surrounds a particle: a sparse grid of fixed cells that particles
/// write to, three levels of convolutions on it, and particles that read from it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridOptions {
    /// Width of a cell of the finest level; those of the others are two and four times as wide (domain
    /// lengths).
    pub cell_width: f32,
    /// Channels of each level, the finest first.
    pub channels: [usize; 3],
    /// Distance between neighbouring particles at rest (domain lengths).
    pub spacing: f32,
}

/// Widths of the network's layers.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sizes {
    /// Width of the pointwise encoder's first layer.
    pub encoder: usize,
    /// Width of the hidden state.
    pub hidden: usize,
    /// Number of recurrent layers.
    pub layers: usize,
    /// The frame model's fixed number of particles; absent where any number will do.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub particles: Option<usize>,
}

/// Statistics of the training split over the features x, y, vx, vy (domain lengths and domain
/// lengths per second). No test or validation frame enters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normalization {
    /// Smallest value of each feature. For x and y this is where the left and lower wall are in
    /// effect: a solver's walls have a thickness, and no particle goes beyond.
    pub minimum: [f32; 4],
    /// Largest value of each feature; for x and y the right and upper wall in effect.
    pub maximum: [f32; 4],
    /// Mean of each feature.
    pub mean: [f32; 4],
    /// Standard deviation of each feature.
    pub standard_deviation: [f32; 4],
}

/// How the weights came about; by default, that they did not yet.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingSummary {
    /// The command line that made it.
    pub command: String,
    /// Seed of initial weights and of the order of the data.
    pub seed: u64,
    /// Epochs done.
    pub epochs: u32,
    /// The epoch these weights are from, counted from 1.
    pub best_epoch: u32,
    /// Mean training loss of that epoch.
    pub training_loss: f64,
    /// Validation loss after that epoch.
    pub validation_loss: f64,
    /// Windows seen by then.
    pub samples: u64,
    /// Fingerprints of the streams it was fitted to or chosen by (`Trajectory::fingerprint`), so that they are
    /// not judged on; none where that is not known.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub seen: Vec<String>,
}

/// What a network is: everything needed to run it but the weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// [`FORMAT_VERSION`].
    pub format_version: u32,
    /// Which network.
    pub architecture: Architecture,
    /// Which recurrent core.
    pub core: Core,
    /// Which form of the recurrence.
    pub form: Form,
    /// Whether minLSTM's gates are divided by their sum, f' = f / (f + i), i' = i / (f + i).
    #[serde(default = "normalized", skip_serializing_if = "is_normalized")]
    pub normalize_gates: bool,
    /// Time between two frames (s).
    pub dt: f32,
    /// Frames a stream must deliver before its predictions count.
    pub warm_up: u32,
    /// Gravity (domain lengths per second squared).
    pub gravity: [f32; 2],
    /// Materials that occur in the data; others are refused.
    pub materials: Vec<Material>,
    /// Digest of the training data.
    pub data: String,
    /// Widths of the layers.
    pub sizes: Sizes,
    /// Choices within the frame model; the particle model has the defaults.
    #[serde(default, skip_serializing_if = "FrameOptions::is_default")]
    pub frame: FrameOptions,
    /// How the particle model sees grid; the frame model has none.
    #[serde(default, rename = "surroundings", skip_serializing_if = "Option::is_none")]
    pub grid: Option<GridOptions>,
    /// Rules that correct the particle model's predictions; the frame model has none.
    #[serde(default, skip_serializing_if = "Rules::is_empty")]
    pub rules: Rules,
    /// The box that holds the particles.
    pub domain: Domain,
    /// Scale of the numbers.
    pub normalization: Normalization,
    /// How the weights came about.
    pub training: TrainingSummary,
}

impl Description {
    /// An untrained network of the given widths with every choice by default: all rules for the particle model, frames of the paper's 16
    /// ms in the unit square, velocities up to 1 domain length per second.
    pub fn untrained(architecture: Architecture, core: Core, sizes: Sizes) -> Self {
        Self {
            format_version: FORMAT_VERSION,
            architecture,
            core,
            form: Form::default(),
            normalize_gates: true,
            dt: 0.016,
            warm_up: 2,
            gravity: [0.0, -9.8],
            materials: Material::ALL.to_vec(),
            data: String::new(),
            sizes,
            frame: FrameOptions::default(),
            grid: (architecture == Architecture::Particle).then_some(GridOptions {
                cell_width: 1.0 / 32.0,
                channels: [32, 64, 64],
                spacing: 1.0 / 128.0,
            }),
            rules: Rules::standard(architecture),
            domain: Domain::UNIT,
            normalization: Normalization {
                minimum: [0.0, 0.0, -1.0, -1.0],
                maximum: [1.0; 4],
                mean: [0.5, 0.5, 0.0, 0.0],
                standard_deviation: [0.3, 0.3, 0.6, 0.6],
            },
            training: TrainingSummary::default(),
        }
    }
}

/// What is left out of the file.
fn normalized() -> bool {
    true
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde asks for a reference")]
fn is_normalized(normalize_gates: &bool) -> bool {
    *normalize_gates
}

/// The text of `model.toml`.
pub(super) fn render(description: &Description) -> String {
    toml::to_string(description).expect("numbers, words and tables of them are all TOML")
}

/// Reads `model.toml`. The version goes first, so that a file of a later format is refused for that
/// and not for a key this version does not know. A description of version 1 becomes one of version 2 with the rules
/// that it implied.
pub(super) fn parse(file: &Path, text: &str) -> Result<Description, CheckpointError> {
    let syntax = |error: toml::de::Error| CheckpointError::Description {
        file: file.to_owned(),
        reason: near::in_toml(error.to_string().trim_end()),
    };
    let table: toml::Table = text.parse().map_err(syntax)?;
    match table.get("format_version").and_then(toml::Value::as_integer) {
        Some(1) if table.contains_key("rules") => {
            let expected = "nothing in format version 1";
            Err(field(file, "rules", "a table".to_owned(), expected))
        }
        Some(1) => {
            let description: Description = toml::from_str(text).map_err(syntax)?;
            let rules = Rules::standard(description.architecture);
            Ok(Description { format_version: FORMAT_VERSION, rules, ..description })
        }
        Some(2) => toml::from_str(text).map_err(syntax),
        _ => {
            let found =
                table.get("format_version").map_or("nothing".to_owned(), ToString::to_string);
            Err(field(file, "format_version", found, "1 or 2"))
        }
    }
}

/// Checks the numbers of a description.
pub(super) fn check(file: &Path, description: &Description) -> Result<(), CheckpointError> {
    let Description { architecture, dt, warm_up, gravity, materials, sizes, domain, .. } =
        description;
    let positive = "a positive number";
    if !(dt.is_finite() && *dt > 0.0) {
        return Err(field(file, "dt", dt.to_string(), positive));
    }
    if *warm_up == 0 {
        return Err(field(file, "warm_up", "0".to_owned(), "at least 1 frame"));
    }
    if !gravity.iter().all(|g| g.is_finite()) {
        return Err(field(file, "gravity", format!("{gravity:?}"), "finite numbers"));
    }
    if materials.is_empty() {
        return Err(field(file, "materials", "[]".to_owned(), "at least one material"));
    }
    // An upper limit keeps a damaged description from asking for all the memory there is.
    let widths = [("encoder", sizes.encoder), ("hidden", sizes.hidden), ("layers", sizes.layers)];
    for (name, width) in widths {
        if !(1..=1 << 16).contains(&width) {
            let name = format!("sizes.{name}");
            return Err(field(file, name, width.to_string(), "1 to 65536"));
        }
    }
    let particles = match (architecture, sizes.particles) {
        (Architecture::Frame, Some(1..=0x100_0000)) | (Architecture::Particle, None) => None,
        (Architecture::Frame, _) => Some("1 to 16777216 for the frame model"),
        (Architecture::Particle, _) => Some("nothing for the particle model"),
    };
    if let Some(expected) = particles {
        let found = sizes.particles.map_or("nothing".to_owned(), |n| n.to_string());
        return Err(field(file, "sizes.particles", found, expected));
    }
    if *architecture == Architecture::Particle && !description.frame.is_default() {
        let found = format!("{:?}", description.frame);
        return Err(field(file, "frame", found, "nothing for the particle model"));
    }
    let grid = match (architecture, description.grid.is_some()) {
        (Architecture::Frame, true) => Some(("a table", "nothing for the frame model")),
        (Architecture::Particle, false) => Some(("nothing", "a table for the particle model")),
        _ => None,
    };
    if let Some((found, expected)) = grid {
        return Err(field(file, "surroundings", found.to_owned(), expected));
    }
    if let Some(GridOptions { cell_width, channels, spacing }) = description.grid {
        for (name, length) in [("cell_width", cell_width), ("spacing", spacing)] {
            if !(length.is_finite() && length > 0.0) {
                let name = format!("surroundings.{name}");
                return Err(field(file, name, length.to_string(), positive));
            }
        }
        if channels.iter().any(|width| !(1..=1 << 12).contains(width)) {
            let found = format!("{channels:?}");
            return Err(field(file, "surroundings.channels", found, "1 to 4096 each"));
        }
    }
    if *architecture == Architecture::Frame && !description.rules.is_empty() {
        return Err(field(file, "rules", "a table".to_owned(), "nothing for the frame model"));
    }
    rules::check(file, &description.rules)?;
    if !domain.is_whole() {
        let found = format!("{:?}, {:?}", domain.lower, domain.upper);
        return Err(field(file, "domain", found, "finite corners with lower < upper"));
    }
    check_normalization(file, &description.normalization)
}

fn check_normalization(file: &Path, scale: &Normalization) -> Result<(), CheckpointError> {
    for feature in 0..4 {
        let (lower, upper) = (scale.minimum[feature], scale.maximum[feature]);
        if !(lower.is_finite() && upper.is_finite() && lower < upper) {
            let name = format!("normalization.minimum, maximum [{feature}]");
            let found = format!("{lower}, {upper}");
            return Err(field(file, name, found, "finite numbers, minimum < maximum"));
        }
        let (mean, deviation) = (scale.mean[feature], scale.standard_deviation[feature]);
        if !(mean.is_finite() && deviation.is_finite() && deviation > 0.0) {
            let name = format!("normalization.mean, standard_deviation [{feature}]");
            let found = format!("{mean}, {deviation}");
            return Err(field(file, name, found, "a finite number and a positive one"));
        }
    }
    Ok(())
}

pub(super) fn field(
    file: &Path,
    field: impl Into<String>,
    found: String,
    expected: impl Into<String>,
) -> CheckpointError {
    CheckpointError::Field {
        file: file.to_owned(),
        field: field.into(),
        found,
        expected: expected.into(),
    }
}
