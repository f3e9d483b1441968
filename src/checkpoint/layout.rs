//! Names and shapes of a network's tensors, derived from its description.
//!
//! Every layer is linear with a bias, stored as PyTorch does: `NAME.weight` `[out, in]`,
//! `NAME.bias` `[out]`. `F` is the number of input features, `E`, `H` the widths of encoder and hidden
//! state, `l` counts the recurrent layers from 0.
//!
//! | layer | widths |
//! |---|---|
//! | `encoder.0` | F -> E |
//! | `encoder.1` | E -> H |
//! | `core.l.gate`, `core.l.candidate` (minGRU) | H -> H |
//! | `core.l.forget_gate`, `core.l.input_gate`, `core.l.candidate` (minLSTM) | H -> H |
//! | `mixer` | H -> H |
//! | `decoder` | H -> 2 N (frame model), H -> 4 (particle model) |

use std::{collections::BTreeMap, path::Path};

use super::{Architecture, CheckpointError, Core, Description, Weights};
use crate::frame::Material;

/// Input features of the frame model: x, y, vx, vy and the material, one-hot.
pub(crate) const FRAME_FEATURES: usize = 4 + Material::COUNT;

/// Input features of the particle model; `model/features.rs` says which.
pub(crate) const PARTICLE_FEATURES: usize = 16 + Material::COUNT;

/// The linear layers of a network with their widths: name, in, out.
pub(crate) fn linear_layers(description: &Description) -> Vec<(String, usize, usize)> {
    let sizes = &description.sizes;
    let hidden = sizes.hidden;
    let (features, outputs) = match description.architecture {
        Architecture::Frame => (FRAME_FEATURES, 2 * sizes.particles.unwrap_or(0)),
        Architecture::Particle => (PARTICLE_FEATURES, 4),
    };
    let mut layers = vec![
        ("encoder.0".to_owned(), features, sizes.encoder),
        ("encoder.1".to_owned(), sizes.encoder, hidden),
    ];
    let parts: &[&str] = match description.core {
        Core::MinGru => &["gate", "candidate"],
        Core::MinLstm => &["forget_gate", "input_gate", "candidate"],
    };
    for layer in 0..sizes.layers {
        layers.extend(parts.iter().map(|part| (format!("core.{layer}.{part}"), hidden, hidden)));
    }
    layers.push(("mixer".to_owned(), hidden, hidden));
    layers.push(("decoder".to_owned(), hidden, outputs));
    layers
}

/// Name and shape of every tensor of the network.
pub fn tensor_shapes(description: &Description) -> BTreeMap<String, Vec<usize>> {
    linear_layers(description)
        .into_iter()
        .flat_map(|(name, input, output)| {
            [
                (format!("{name}.weight"), vec![output, input]),
                (format!("{name}.bias"), vec![output]),
            ]
        })
        .collect()
}

/// Checks that the tensors are exactly those of the network, and finite.
pub(super) fn check(
    file: &Path,
    description: &Description,
    tensors: &BTreeMap<String, Weights>,
) -> Result<(), CheckpointError> {
    let file = || file.to_owned();
    let shapes = tensor_shapes(description);
    for (tensor, expected) in &shapes {
        let (tensor, expected) = (tensor.clone(), expected.clone());
        let Some(found) = tensors.get(&tensor) else {
            return Err(CheckpointError::Missing { file: file(), tensor, expected });
        };
        if found.shape != expected || found.values.len() != expected.iter().product::<usize>() {
            let found = found.shape.clone();
            return Err(CheckpointError::Shape { file: file(), tensor, found, expected });
        }
        if let Some(index) = found.values.iter().position(|value| !value.is_finite()) {
            let found = found.values[index];
            return Err(CheckpointError::NotFinite { file: file(), tensor, index, found });
        }
    }
    match tensors.iter().find(|(name, _)| !shapes.contains_key(*name)) {
        None => Ok(()),
        Some((tensor, weights)) => Err(CheckpointError::Unexpected {
            file: file(),
            tensor: tensor.clone(),
            found: weights.shape.clone(),
        }),
    }
}
