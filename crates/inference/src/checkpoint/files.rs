//! The two files on disk, which are replaced together.
//!
//! Two renames are not atomic. The new pair is therefore first written beside the old one, weights before description, with
//! the suffix `.new`; then the weights are renamed, then the description. After a crash, one of three states is found:
//!
//! | `model.safetensors.new` | `model.toml.new` | state |
//! |---|---|---|
//! | any | absent | the old pair is valid |
//! | present | present | the old pair is valid |
//! | absent | present | the weights are already new: `model.toml.new` belongs to them |

use std::{
    collections::BTreeMap,
    fs, io,
    path::{Path, PathBuf},
};

use half::f16;
use safetensors::{
    SafeTensors,
    tensor::{Dtype, TensorView},
};

use super::{CheckpointError, WeightFormat, Weights};
use eddy_settings::{atomic, near};

/// Name of the description within the directory.
pub const DESCRIPTION_FILE: &str = "model.toml";
/// Name of the weights within the directory.
pub const WEIGHTS_FILE: &str = "model.safetensors";
/// Checkpoints that were shipped before one was for every stiffness.
const REPLACED: [&str; 2] = ["particle-mingru-stiff", "particle-mingru-conditioned"];

/// The temporary names of the new pair, weights first.
fn incoming(directory: &Path) -> [PathBuf; 2] {
    [WEIGHTS_FILE, DESCRIPTION_FILE].map(|name| directory.join(format!("{name}.new")))
}

/// Whether a writer was interrupted between the two renames.
fn half_renamed(directory: &Path) -> bool {
    let [weights, description] = incoming(directory);
    description.exists() && !weights.exists()
}

/// Replaces both files.
pub(super) fn write(
    directory: &Path,
    description: &str,
    weights: &[u8],
) -> Result<(), CheckpointError> {
    let attempt = |file: &Path, result: io::Result<()>| {
        result.map_err(|reason| CheckpointError::Write { file: file.to_owned(), reason })
    };
    attempt(directory, fs::create_dir_all(directory))?;
    let [new_weights, new_description] = incoming(directory);
    let [old_weights, old_description] =
        [WEIGHTS_FILE, DESCRIPTION_FILE].map(|name| directory.join(name));
    if half_renamed(directory) {
        attempt(&old_description, atomic::rename(&new_description, &old_description))?;
    }
    attempt(&new_weights, atomic::write_synced(&new_weights, weights))?;
    attempt(&new_description, atomic::write_synced(&new_description, description.as_bytes()))?;
    attempt(&old_weights, atomic::rename(&new_weights, &old_weights))?;
    attempt(&old_description, atomic::rename(&new_description, &old_description))
}

/// Reads both files: the description's text, the weights' bytes.
pub(super) fn read(directory: &Path) -> Result<(String, Vec<u8>), CheckpointError> {
    let [_, new_description] = incoming(directory);
    let description =
        if half_renamed(directory) { new_description } else { directory.join(DESCRIPTION_FILE) };
    let weights = directory.join(WEIGHTS_FILE);
    let failed = |file: &Path, reason| CheckpointError::Read {
        file: file.to_owned(),
        reason: near::in_folder(file, reason),
    };
    let has_name = |name: &&str| directory.ends_with(name);
    if !directory.exists() && REPLACED.iter().any(has_name) {
        return Err(CheckpointError::Replaced { directory: directory.to_owned() });
    }
    let is_name = directory.components().count() == 1 && !directory.exists();
    if is_name || directory.is_dir() && !description.exists() {
        return Err(CheckpointError::NoCheckpoint { directory: directory.to_owned() });
    }
    let text = fs::read_to_string(&description).map_err(|reason| failed(&description, reason))?;
    let bytes = fs::read(&weights).map_err(|reason| failed(&weights, reason))?;
    Ok((text, bytes))
}

/// The number type of a format.
fn dtype(format: WeightFormat) -> Dtype {
    match format {
        WeightFormat::F32 => Dtype::F32,
        WeightFormat::F16 => Dtype::F16,
    }
}

/// The bytes of a safetensors file.
pub fn render_weights(tensors: &BTreeMap<String, Weights>, format: WeightFormat) -> Vec<u8> {
    let bytes = |Weights { values, .. }: &Weights| -> Vec<u8> {
        let values = values.iter();
        match format {
            WeightFormat::F32 => values.flat_map(|value| value.to_le_bytes()).collect(),
            WeightFormat::F16 => {
                values.flat_map(|&value| f16::from_f32(value).to_le_bytes()).collect()
            }
        }
    };
    let bytes: Vec<Vec<u8>> = tensors.values().map(bytes).collect();
    let views = tensors.iter().zip(&bytes).map(|((name, weights), bytes)| {
        let view = TensorView::new(dtype(format), weights.shape.clone(), bytes)
            .expect("the bytes of as many numbers as the checked shape holds");
        (name, view)
    });
    safetensors::serialize(views, None).expect("names and shapes are all JSON")
}

/// The tensors in the bytes of a safetensors file of a format; errors name `file` and the first tensor, by name, of another type.
pub fn parse_weights(
    file: &Path,
    bytes: &[u8],
    format: WeightFormat,
) -> Result<BTreeMap<String, Weights>, CheckpointError> {
    let parsed = SafeTensors::deserialize(bytes).map_err(|error| CheckpointError::Corrupt {
        file: file.to_owned(),
        found: error.to_string(),
    })?;
    let mut tensors = BTreeMap::new();
    // By name, as the library's own order is another in each run.
    for (name, view) in parsed.iter().collect::<BTreeMap<_, _>>() {
        if view.dtype() != dtype(format) {
            return Err(CheckpointError::NumberType {
                file: file.to_owned(),
                tensor: name.to_owned(),
                found: format!("{:?}", view.dtype()),
                expected: format!("{:?}", dtype(format)),
            });
        }
        let values = match format {
            WeightFormat::F32 => {
                let (numbers, _) = view.data().as_chunks();
                numbers.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect()
            }
            WeightFormat::F16 => {
                let (numbers, _) = view.data().as_chunks();
                numbers.iter().map(|&bytes| f16::from_le_bytes(bytes).to_f32()).collect()
            }
        };
        let weights = Weights { shape: view.shape().to_vec(), values };
        tensors.insert(name.to_owned(), weights);
    }
    Ok(tensors)
}
