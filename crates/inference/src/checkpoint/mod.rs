//! Checkpoints: a trained network on disk, readable without the library that trained it.
//!
//! A checkpoint is a directory with two files, and a third one if it was calibrated:
//!
//! 1. `model.toml`, the [`Description`]: network (`network`), training data, normalisation (`description`), the rules
//!    that correct its predictions (`rules`).
//! 2. `model.safetensors`, the weights: f32, or f16 if the description says so, in PyTorch's layout `[out, in]` (`[stiffnesses, out,
//!    in]` if there are some for several stiffnesses), with the names
//!    and shapes that [`layout`] derives from the description.
//! 3. `error_model.toml`, the [`ErrorModel`]. It changes no prediction and is not covered by the digest.
//!
//! [`plan`] lists what the described network computes, in order; [`grid`] has the particle model's layers on its grid.
//! `knots` interpolates weights for several stiffnesses. `initial` draws the weights of an untrained network. `files` replaces both
//! files so that a crash between any two system calls leaves a complete checkpoint, the old one or the new one.

mod description;
mod error;
mod files;
mod fingerprints;
pub mod grid;
mod initial;
mod knots;
pub mod layout;
mod network;
pub mod plan;
mod rules;

pub(crate) use description::field;
pub use description::{
    Description, FORMAT_VERSION, MATERIAL_INPUTS, Normalization, TrainingSummary,
};
pub use error::CheckpointError;
pub use files::{DESCRIPTION_FILE, WEIGHTS_FILE};
pub use files::{parse_weights, render_weights};
pub use fingerprints::Fingerprints;
pub use initial::initial_weights;
pub use knots::{
    MOST_KNOTS, VALID_ASSUMPTION, VALID_KNOTS, knot_shares, mix, tensors_of_knot, tensors_of_knots,
    valid_assumption, valid_knots,
};
pub use layout::tensor_shapes;
pub use network::{
    Activation, Architecture, FeatureScaling, FrameOptions, FrameOutput, GridOptions,
    MaterialInput, Pooling, Sizes, WeightFormat,
};

pub use crate::ops::{
    cell::{Core, Form},
    rules::{
        AreaRule, ElasticRule, FlightRule, RestRule, Rule, Rules, ShapeRule, elastic::JELLY_MODULUS,
    },
};

use std::{collections::BTreeMap, path::Path};

use sha2::{Digest, Sha256};

use crate::error_model::{self, ERROR_MODEL_FILE, ErrorModel};

/// The name of [`Checkpoint::shipped`].
const SHIPPED_NAME: &str = "particle-mingru";

/// A trained network.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// Everything but the weights.
    pub description: Description,
    /// The weights by name, as [`tensor_shapes`] lists them.
    pub tensors: BTreeMap<String, Weights>,
    /// Estimates of its error, if it was calibrated.
    pub error_model: Option<ErrorModel>,
}

/// One tensor of weights.
#[derive(Clone, Debug, PartialEq)]
pub struct Weights {
    /// Length of each axis: `[out, in]` for the matrix of a linear layer, after the stiffnesses if there are weights for several.
    pub shape: Vec<usize>,
    /// The values, last axis fastest.
    pub values: Vec<f32>,
}

impl Checkpoint {
    /// A checkpoint that was not calibrated.
    pub fn new(description: Description, tensors: BTreeMap<String, Weights>) -> Self {
        Self { description, tensors, error_model: None }
    }

    /// The same network, not calibrated, with its weights rounded to a number type.
    pub fn with_weights(&self, format: WeightFormat) -> Self {
        let description = Description { weights: format, ..self.description.clone() };
        let mut tensors = self.tensors.clone();
        for value in tensors.values_mut().flat_map(|weights| &mut weights.values) {
            *value = format.rounded(*value);
        }
        Self::new(description, tensors)
    }

    /// Writes the checkpoint to `directory`, which is created if necessary. An existing checkpoint is replaced atomically: a
    /// crash leaves the old one or the new one. The error model is written afterwards; without one, that of an earlier checkpoint
    /// stays and is not used, since it names its checkpoint.
    ///
    /// # Errors
    /// [`CheckpointError::Write`] if a file cannot be written, and the errors of [`Checkpoint::check`].
    pub fn save(&self, directory: &Path) -> Result<(), CheckpointError> {
        self.check(directory)?;
        files::write(directory, &self.render_description(), &self.render_weights())?;
        self.error_model.as_ref().map_or(Ok(()), |model| model.save(directory))
    }

    /// Reads the checkpoint in `directory`.
    ///
    /// # Errors
    /// [`CheckpointError`]: a file cannot be read or is damaged, the format version is not supported, a key of the description
    /// is unknown or missing, or the weights do not match the description.
    pub fn load(directory: &Path) -> Result<Self, CheckpointError> {
        let error_model = error_model::load(directory)?;
        Ok(Self { error_model, ..Self::load_uncalibrated(directory)? })
    }

    /// Reads the checkpoint in `directory` without its error model.
    ///
    /// # Errors
    /// As [`Checkpoint::load`].
    pub fn load_uncalibrated(directory: &Path) -> Result<Self, CheckpointError> {
        let (description, weights) = files::read(directory)?;
        Self::parse(directory, &description, &weights)
    }

    /// The particle model that is built into this program; its card in `checkpoints` describes its training.
    ///
    /// # Errors
    /// As [`Checkpoint::load`], but only in a broken build: a test loads it.
    pub fn shipped() -> Result<Self, CheckpointError> {
        let directory = Path::new("checkpoints/particle-mingru");
        let checkpoint = Self::parse(
            directory,
            include_str!("../../checkpoints/particle-mingru/model.toml"),
            include_bytes!("../../checkpoints/particle-mingru/model.safetensors"),
        )?;
        let error_model = error_model::parse(
            &directory.join(ERROR_MODEL_FILE),
            include_str!("../../checkpoints/particle-mingru/error_model.toml"),
        )?;
        Ok(Self { error_model: Some(error_model), ..checkpoint })
    }

    /// The checkpoint at `path`; [`Checkpoint::shipped`] by default, and by its name where there is no such directory.
    ///
    /// # Errors
    /// As [`Checkpoint::load`].
    pub fn load_or_shipped(path: Option<&Path>) -> Result<Self, CheckpointError> {
        match path {
            Some(path) if path != Path::new(SHIPPED_NAME) || path.exists() => Self::load(path),
            _ => Self::shipped(),
        }
    }

    /// Parses the contents of the first two files; errors name `directory`.
    ///
    /// # Errors
    /// As [`Checkpoint::load`].
    pub fn parse(
        directory: &Path,
        description: &str,
        weights: &[u8],
    ) -> Result<Self, CheckpointError> {
        let description = description::parse(&directory.join(DESCRIPTION_FILE), description)?;
        let tensors = parse_weights(&directory.join(WEIGHTS_FILE), weights, description.weights)?;
        let checkpoint = Self::new(description, tensors);
        checkpoint.check(directory)?;
        Ok(checkpoint)
    }

    /// Checks the values of the description, and that the weights match it: no tensor is missing or unexpected, and each is
    /// finite, of the described number type, and has its shape. Errors name `directory`.
    ///
    /// # Errors
    /// [`CheckpointError::Field`], [`CheckpointError::Missing`], [`CheckpointError::Unexpected`],
    /// [`CheckpointError::Shape`], [`CheckpointError::NotFinite`], [`CheckpointError::NotRounded`].
    pub fn check(&self, directory: &Path) -> Result<(), CheckpointError> {
        description::check(&directory.join(DESCRIPTION_FILE), &self.description)?;
        layout::check(&directory.join(WEIGHTS_FILE), &self.description, &self.tensors)
    }

    /// SHA-256, hexadecimal, of description and weights as [`Checkpoint::save`] writes them (`cat model.toml model.safetensors | sha256sum`).
    /// It is not cached and reads all weights.
    pub fn digest(&self) -> String {
        let mut hash = Sha256::new();
        hash.update(self.render_description());
        hash.update(self.render_weights());
        format!("{:x}", hash.finalize())
    }

    /// The first twelve digits of [`Checkpoint::digest`], for display.
    pub fn short_digest(&self) -> String {
        let mut digest = self.digest();
        digest.truncate(12);
        digest
    }

    /// Number of trainable parameters.
    pub fn parameters(&self) -> usize {
        self.tensors.values().map(|weights| weights.values.len()).sum()
    }

    fn render_description(&self) -> String {
        description::render(&self.description)
    }

    fn render_weights(&self) -> Vec<u8> {
        render_weights(&self.tensors, self.description.weights)
    }
}

#[cfg(test)]
mod tests;
