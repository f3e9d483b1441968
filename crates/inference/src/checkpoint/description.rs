//! `model.toml`: network, training data and normalisation.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{CheckpointError, Rules, rules};
use eddy_frames::{Domain, Material};
use eddy_settings::near;

/// Version of the checkpoint format that is written. It increases when older files would be misread.
///
/// Version 1, which is also read, has no `[rules]`: its particle models always have [`Rules::STANDARD`].
pub const FORMAT_VERSION: u32 = 2;

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

/// The recurrent core of a network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Core {
    /// No recurrence: a linear layer and an activation, the paper's baseline.
    Mlp,
    /// Long short-term memory (Hochreiter and Schmidhuber 1997), as in PyTorch.
    Lstm,
    /// Gated recurrent unit (Cho et al. 2014), as in PyTorch.
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
    /// All cores, in the paper's order.
    pub const ALL: [Self; 5] = [Self::Mlp, Self::Lstm, Self::Gru, Self::MinLstm, Self::MinGru];

    /// Its name in files and on the command line.
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

/// The form of the minimal recurrences; other cores have only the plain form.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Form {
    /// Candidates enter the state unchanged (the paper's Fig. 6).
    #[default]
    Plain,
    /// Candidates pass through g(x) = x + 1/2 for x >= 0 and sigmoid(x) below, which is positive, so that the recurrence can be
    /// computed in logarithms (Feng et al. 2024, appendix B). This is a different model.
    Log,
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
}

impl FrameOptions {
    fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

/// The sparse grid that connects the particle model's particles with their surroundings: particles are summed on its nodes,
/// three levels of convolutions follow, and particles gather the result. Its table in `model.toml` is `[surroundings]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridOptions {
    /// Cell width of the finest level (domain lengths); the coarser levels have cells two and four times as wide.
    pub cell_width: f32,
    /// Channels of each level, finest first.
    pub channels: [usize; 3],
    /// Distance between neighbouring particles at rest (domain lengths).
    pub spacing: f32,
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

/// Statistics of the features x, y, vx, vy over the training split only (domain lengths and domain lengths per second).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normalization {
    /// Smallest value of each feature. For x and y this is the effective left and lower wall: a solver's walls have a
    /// thickness that no particle enters.
    pub minimum: [f32; 4],
    /// Largest value of each feature; for x and y the effective right and upper wall.
    pub maximum: [f32; 4],
    /// Mean of each feature.
    pub mean: [f32; 4],
    /// Standard deviation of each feature.
    pub standard_deviation: [f32; 4],
}

/// How the network was trained; the default is an untrained network.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingSummary {
    /// The command line.
    pub command: String,
    /// Seed of the initial weights and of the order of the data.
    pub seed: u64,
    /// Number of epochs.
    pub epochs: u32,
    /// The epoch of these weights, counted from 1.
    pub best_epoch: u32,
    /// Mean training loss of that epoch.
    pub training_loss: f64,
    /// Validation loss after that epoch.
    pub validation_loss: f64,
    /// Training windows up to that epoch.
    pub samples: u64,
    /// Fingerprints of the streams used for training and validation (`Trajectory::fingerprint`), which evaluations exclude;
    /// empty if unknown.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub seen: Vec<String>,
}

/// Everything needed to run a network but its weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// [`FORMAT_VERSION`].
    pub format_version: u32,
    /// Architecture of the network.
    pub architecture: Architecture,
    /// Recurrent core.
    pub core: Core,
    /// Form of the recurrence.
    pub form: Form,
    /// Whether minLSTM's gates are divided by their sum, f' = f / (f + i), i' = i / (f + i).
    #[serde(default = "normalized", skip_serializing_if = "is_normalized")]
    pub normalize_gates: bool,
    /// Time between two frames (s).
    pub dt: f32,
    /// Number of frames to observe before predictions are published.
    pub warm_up: u32,
    /// Gravity (domain lengths per second squared).
    pub gravity: [f32; 2],
    /// Materials in the training data; others are rejected.
    pub materials: Vec<Material>,
    /// Digest of the training data.
    pub data: String,
    /// Sizes of the layers.
    pub sizes: Sizes,
    /// Options of the frame model; defaults in a particle model.
    #[serde(default, skip_serializing_if = "FrameOptions::is_default")]
    pub frame: FrameOptions,
    /// The particle model's grid; absent in a frame model.
    #[serde(default, rename = "surroundings", skip_serializing_if = "Option::is_none")]
    pub grid: Option<GridOptions>,
    /// Rules that correct the particle model's predictions; empty in a frame model.
    #[serde(default, skip_serializing_if = "Rules::is_empty")]
    pub rules: Rules,
    /// The domain in training.
    pub domain: Domain,
    /// Statistics of the training data.
    pub normalization: Normalization,
    /// How the network was trained.
    pub training: TrainingSummary,
}

impl Description {
    /// An untrained network of the given sizes with default options: standard rules for the particle model, the paper's frame
    /// interval of 16 ms, the unit square, velocities up to 1 domain length per second.
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

/// The value that is omitted from the file.
fn normalized() -> bool {
    true
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_normalized(normalize_gates: &bool) -> bool {
    *normalize_gates
}

/// The text of `model.toml`.
pub(super) fn render(description: &Description) -> String {
    toml::to_string(description).expect("numbers, words and tables of them are all TOML")
}

/// Reads `model.toml`. The version is checked first, so that a file of a later format is rejected for its version and not for
/// an unknown key. Version 1 is converted to version 2 with the rules that it implied.
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

/// Checks the values of a description.
pub(super) fn check(file: &Path, description: &Description) -> Result<(), CheckpointError> {
    let Description { architecture, dt, warm_up, gravity, materials, .. } = description;
    let Description { sizes, frame, grid, domain, .. } = description;
    let require = |valid: bool, name: &str, found: &dyn ToString, expected: &str| match valid {
        true => Ok(()),
        false => Err(field(file, name, found.to_string(), expected)),
    };
    let positive =
        |name: &str, x: f32| require(x.is_finite() && x > 0.0, name, &x, "a positive number");
    positive("dt", *dt)?;
    require(*warm_up > 0, "warm_up", warm_up, "at least 1 frame")?;
    let finite = gravity.iter().all(|g| g.is_finite());
    require(finite, "gravity", &format!("{gravity:?}"), "finite numbers")?;
    require(!materials.is_empty(), "materials", &"[]", "at least one material")?;
    // The upper limit keeps a damaged description from exhausting the memory.
    for (name, width) in [
        ("sizes.encoder", sizes.encoder),
        ("sizes.hidden", sizes.hidden),
        ("sizes.layers", sizes.layers),
    ] {
        require((1..=1 << 16).contains(&width), name, &width, "1 to 65536")?;
    }
    let particles = sizes.particles.map_or("nothing".to_owned(), |n| n.to_string());
    match architecture {
        Architecture::Frame => {
            let valid = matches!(sizes.particles, Some(1..=0x100_0000));
            let expected = "1 to 16777216 for the frame model";
            require(valid, "sizes.particles", &particles, expected)?;
            let expected = "nothing for the frame model";
            require(grid.is_none(), "surroundings", &"a table", expected)?;
            require(description.rules.is_empty(), "rules", &"a table", expected)?;
        }
        Architecture::Particle => {
            let expected = "nothing for the particle model";
            require(sizes.particles.is_none(), "sizes.particles", &particles, expected)?;
            require(frame.is_default(), "frame", &format!("{frame:?}"), expected)?;
            let expected = "a table for the particle model";
            require(grid.is_some(), "surroundings", &"nothing", expected)?;
        }
    }
    if let Some(GridOptions { cell_width, channels, spacing }) = *grid {
        positive("surroundings.cell_width", cell_width)?;
        positive("surroundings.spacing", spacing)?;
        let valid = channels.iter().all(|width| (1..=1 << 12).contains(width));
        require(valid, "surroundings.channels", &format!("{channels:?}"), "1 to 4096 each")?;
    }
    rules::check(file, &description.rules)?;
    let corners = format!("{:?}, {:?}", domain.lower, domain.upper);
    require(domain.is_valid(), "domain", &corners, "finite corners with lower < upper")?;
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
