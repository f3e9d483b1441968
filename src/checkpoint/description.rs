//! `model.toml`: what a network is, what it saw, how its numbers are scaled.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::CheckpointError;
use crate::frame::{Domain, Material};

/// Version of the checkpoint format. It goes up when a file of the old form would be misread.
pub const FORMAT_VERSION: u32 = 1;

/// Which network.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, clap::ValueEnum,
)]
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

/// Which recurrent core.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, clap::ValueEnum,
)]
#[serde(rename_all = "lowercase")]
pub enum Core {
    /// One gate, one candidate (Feng et al. 2024, section 3.1).
    #[default]
    #[value(name = "mingru")]
    MinGru,
    /// Forget gate, input gate, candidate; the gates normalised (Feng et al. 2024, section 3.2).
    #[value(name = "minlstm")]
    MinLstm,
}

impl Core {
    /// The word in files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::MinGru => "mingru",
            Self::MinLstm => "minlstm",
        }
    }
}

/// Which form of the recurrence.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Form {
    /// Candidates enter as they are (the paper's Fig. 6).
    #[default]
    Plain,
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

/// How the weights came about.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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
    /// The box that holds the particles.
    pub domain: Domain,
    /// Scale of the numbers.
    pub normalization: Normalization,
    /// How the weights came about.
    pub training: TrainingSummary,
}

/// The text of `model.toml`.
pub(super) fn render(description: &Description) -> String {
    toml::to_string(description).expect("numbers, words and tables of them are all TOML")
}

/// Reads `model.toml`. The version goes first, so that a file of a later format is refused for that
/// and not for a key this version does not know.
pub(super) fn parse(file: &Path, text: &str) -> Result<Description, CheckpointError> {
    let syntax = |error: toml::de::Error| CheckpointError::Description {
        file: file.to_owned(),
        reason: error.to_string().trim_end().to_owned(),
    };
    let table: toml::Table = text.parse().map_err(syntax)?;
    let version = table.get("format_version").and_then(toml::Value::as_integer);
    if version != Some(i64::from(FORMAT_VERSION)) {
        let found = table.get("format_version").map_or("nothing".to_owned(), ToString::to_string);
        return Err(field(file, "format_version", found, FORMAT_VERSION.to_string()));
    }
    toml::from_str(text).map_err(syntax)
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

fn field(
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
