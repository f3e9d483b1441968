//! `model.toml`: network, training data and normalisation.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{
    CheckpointError, Core, Form, Rules, VALID_ASSUMPTION, VALID_KNOTS,
    fingerprints::Fingerprints,
    network::{Architecture, FrameOptions, GridOptions, Sizes, WeightFormat},
    rules, valid_assumption, valid_knots,
};
use eddy_frames::{Domain, Material};
use eddy_settings::near;

/// Version of the format that a network without anything newer is written in.
///
/// Version 1, which is also read, has no `[rules]`: its particle models always have [`Rules::STANDARD`], with a rate of the rule `area` of 1
/// and the speeds .25 and 1 of the rule `rest`. Version 3 has `material_inputs`: the networks of the versions before have
/// [`MATERIAL_INPUTS`].
pub const FORMAT_VERSION: u32 = 2;
/// The latest version.
const LATEST_VERSION: u32 = 3;
/// Materials that a network has inputs for, unless its description says otherwise.
pub const MATERIAL_INPUTS: usize = 4;

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
    /// Digest of the checkpoint that the training started from, if it did not start from random weights.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<String>,
    /// The smallest and the largest stiffness of the streams used for training (density x velocity^2), if they stated it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stiffness: Option<[f32; 2]>,
    /// Fingerprints of the streams used for training and validation (`Trajectory::fingerprint`), which evaluations exclude;
    /// empty if unknown.
    #[serde(default, skip_serializing_if = "Fingerprints::is_empty")]
    pub seen: Fingerprints,
    /// A baseline fitted by least squares to the training part: the change of a particle's velocity within a frame along x and
    /// along y as a + A (x, y, vx, vy), `[a, A]` each (domain lengths, domain lengths per second).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub linear_fit: Option<[[f32; 5]; 2]>,
}

/// Everything needed to run a network but its weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// [`Description::version`].
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
    /// Particle model: whether the network is conditioned on the stiffness of a stream, as one more feature of every particle, the
    /// last: another input of `encoder.0`, and of `context` before those from the grid.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub stiffness: bool,
    /// Particle model that is conditioned on the stiffness: ascending stiffnesses (density x velocity^2) for each of which the file
    /// has weights, along the first axis of every tensor. Those of a stream are interpolated linearly in the logarithm of its
    /// stiffness; beyond the ends, they are those of the nearest. Empty if there is one set of weights.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub stiffness_knots: Vec<f32>,
    /// Particle model that is conditioned on the stiffness: that of streams whose source does not state it (density x velocity^2).
    /// Without it, such streams are refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub assumed_stiffness: Option<f32>,
    /// Number type of the weights in `model.safetensors`.
    #[serde(default, skip_serializing_if = "WeightFormat::is_default")]
    pub weights: WeightFormat,
    /// Time between two frames (s).
    pub dt: f32,
    /// Number of frames to observe before predictions are published.
    pub warm_up: u32,
    /// Gravity (domain lengths per second squared).
    pub gravity: [f32; 2],
    /// Materials in the training data; others are rejected.
    pub materials: Vec<Material>,
    /// Number of materials, from the first one on, that the network has inputs for.
    #[serde(default = "material_inputs", skip_serializing_if = "is_usual")]
    pub material_inputs: usize,
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

/// Largest accepted difference between a stream's frame interval and the checkpoint's, relative to it.
const INTERVAL_TOLERANCE: f32 = 1e-3;

impl Description {
    /// The first version of the format that has so many inputs for materials.
    pub const fn version(material_inputs: usize) -> u32 {
        if material_inputs == MATERIAL_INPUTS { FORMAT_VERSION } else { LATEST_VERSION }
    }

    /// Whether a frame interval (s) is that of the network.
    pub fn has_interval(&self, dt: f32) -> bool {
        (dt - self.dt).abs() <= INTERVAL_TOLERANCE * self.dt
    }

    /// The smallest and the largest stiffness of the matter that it was trained on (density x velocity^2): what the streams stated,
    /// otherwise those that it has weights for, otherwise that of the rule `elastic`; `None` if none of them says it.
    pub fn trained_stiffness(&self) -> Option<[f32; 2]> {
        let of_weights = || match self.stiffness_knots.as_slice() {
            [low, .., high] => Some([*low, *high]),
            _ => None,
        };
        let rule = self.rules.elastic.filter(|_| !self.stiffness);
        let of_rule = || rule.map(|rule| [rule.stiffness(); 2]);
        self.training.stiffness.or_else(of_weights).or_else(of_rule)
    }

    /// An untrained network of the given sizes with default options: standard rules for the particle model, the paper's frame
    /// interval of 16 ms, the unit square, velocities up to 1 domain length per second.
    pub fn untrained(architecture: Architecture, core: Core, sizes: Sizes) -> Self {
        Self {
            format_version: Self::version(MATERIAL_INPUTS),
            architecture,
            core,
            form: Form::default(),
            normalize_gates: true,
            stiffness: false,
            stiffness_knots: Vec::new(),
            assumed_stiffness: None,
            weights: WeightFormat::default(),
            dt: 0.016,
            warm_up: 2,
            gravity: [0.0, -9.8],
            materials: Material::ALL[..MATERIAL_INPUTS].to_vec(),
            material_inputs: MATERIAL_INPUTS,
            data: String::new(),
            sizes,
            frame: FrameOptions::default(),
            grid: (architecture == Architecture::Particle).then_some(GridOptions {
                cell_width: 1.0 / 32.0,
                channels: vec![32, 64, 64],
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
fn material_inputs() -> usize {
    MATERIAL_INPUTS
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_usual(material_inputs: &usize) -> bool {
    *material_inputs == MATERIAL_INPUTS
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
            let rules = Rules::of_version_1(description.architecture);
            Ok(Description { format_version: FORMAT_VERSION, rules, ..description })
        }
        Some(2) if table.contains_key("material_inputs") => {
            let expected = "nothing before format version 3";
            Err(field(file, "material_inputs", "a key".to_owned(), expected))
        }
        Some(2 | 3) => toml::from_str(text).map_err(syntax),
        _ => {
            let found =
                table.get("format_version").map_or("nothing".to_owned(), ToString::to_string);
            Err(field(file, "format_version", found, "1 to 3"))
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
    let inputs = description.material_inputs;
    require((2..=64).contains(&inputs), "material_inputs", &inputs, "2 to 64")?;
    let found = format!("{materials:?}");
    let known = materials.iter().all(|&material| usize::from(material as u8) < inputs);
    require(known, "materials", &found, &format!("the first {inputs} materials"))?;
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
            let expected = "false for the frame model";
            require(!description.stiffness, "stiffness", &"true", expected)?;
        }
        Architecture::Particle => {
            let expected = "nothing for the particle model";
            require(sizes.particles.is_none(), "sizes.particles", &particles, expected)?;
            require(frame.is_default(), "frame", &format!("{frame:?}"), expected)?;
            let expected = "a table for the particle model";
            require(grid.is_some(), "surroundings", &"nothing", expected)?;
        }
    }
    check_stiffness(file, description)?;
    if let Some(GridOptions { cell_width, channels, spacing }) = grid {
        positive("surroundings.cell_width", *cell_width)?;
        positive("surroundings.spacing", *spacing)?;
        let valid = GridOptions::valid_channels(channels);
        let (name, found) = ("surroundings.channels", format!("{channels:?}"));
        require(valid, name, &found, GridOptions::CHANNELS)?;
    }
    rules::check(file, description)?;
    require(domain.is_valid(), "domain", &domain.to_string(), "finite corners with lower < upper")?;
    check_normalization(file, &description.normalization)
}

fn check_stiffness(file: &Path, description: &Description) -> Result<(), CheckpointError> {
    let Description { stiffness, stiffness_knots: knots, assumed_stiffness, .. } = description;
    if !valid_knots(knots, *stiffness) {
        return Err(field(file, "stiffness_knots", format!("{knots:?}"), VALID_KNOTS));
    }
    match assumed_stiffness {
        Some(assumed) if !valid_assumption(*assumed, *stiffness) => {
            Err(field(file, "assumed_stiffness", assumed.to_string(), VALID_ASSUMPTION))
        }
        _ => Ok(()),
    }
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

pub(crate) fn field(
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
