//! Names and shapes of a network's tensors, derived from its description.
//!
//! Every layer is linear with a bias and stored as in PyTorch: `NAME.weight` `[out, in]`, `NAME.bias` `[out]`. F is the
//! number of input features, E and H are the widths of encoder and hidden state, and l is the recurrent layer, from 0.
//!
//! | layer | widths |
//! |---|---|
//! | `encoder.0` | F -> E |
//! | `encoder.1` | E -> H (frame model), E -> C0 (particle model) |
//! | `grid.*` (particle model) | see below |
//! | `context` (particle model) | F + C0 -> H |
//! | `core.l.linear` (MLP) | H -> H |
//! | `core.l.gate`, `core.l.candidate` (minGRU) | H -> H |
//! | `core.l.forget_gate`, `core.l.input_gate`, `core.l.candidate` (minLSTM) | H -> H |
//! | `core.*_ih_ll`, `core.*_hh_ll` (GRU; gates r, z, n) | H -> 3 H |
//! | `core.*_ih_ll`, `core.*_hh_ll` (LSTM; gates i, f, g, o) | H -> 4 H |
//! | `mixer` | H -> H |
//! | `decoder` | H -> 2 N (frame model), H -> 4 (particle model) |
//!
//! GRU and LSTM have PyTorch's names for stacked layers: `core.weight_ih_l0`, `core.bias_ih_l0` and so on. With mean and
//! maximum pooling, the first layer of the core has 2 H inputs.
//!
//! The particle model's grid has two to four levels with C0, C1, .. channels; level m is the coarsest. A convolution is a
//! linear layer on the concatenated rows of the nodes around a node, row by row from the lower left:
//!
//! | layer, in this order | widths |
//! |---|---|
//! | `grid.0.a`, `grid.0.b` | 9 (C0 + 5) -> C0, 9 C0 -> C0 |
//! | `grid.l.down`, `grid.l.a`, for l = 1 to m | 4 C(l-1) -> Cl, 9 Cl -> Cl |
//! | `grid.m.b` | 9 Cm -> Cm |
//! | `grid.l.up`, `grid.l.b`, for l = m - 1 to 0 (`grid.0.c` instead of `grid.0.b`) | C(l+1) -> 4 Cl (one map per child, with a shared bias), 9 Cl -> Cl |

use std::{collections::BTreeMap, path::Path};

use super::{
    CheckpointError, Description, MaterialInput, Weights,
    plan::{LinearLayer, Plan},
};

/// Number of input features of the frame model: x, y, vx, vy and the material.
pub fn frame_features(description: &Description) -> usize {
    match description.frame.material {
        MaterialInput::OneHot => 4 + description.material_inputs,
        MaterialInput::Scalar => 5,
    }
}

/// Number of input features of the particle model, which [`features`](crate::ops::features) lists; the stiffness of the stream, if the
/// network is conditioned on it, is the last.
pub fn particle_features(description: &Description) -> usize {
    19 + description.material_inputs + usize::from(description.stiffness)
}

/// Inputs of a node beside the channels: its mass, and its proximity to each wall.
pub const NODE_FEATURES: usize = 5;

/// Names of weight and bias of a layer outside the core.
pub fn names(layer: &str) -> [String; 2] {
    ["weight", "bias"].map(|tensor| format!("{layer}.{tensor}"))
}

/// Whether a weight is that of a hidden layer: neither of the first one, which reads the features, nor of the decoder.
pub fn is_hidden(weight: &str) -> bool {
    !["encoder.0.weight", "decoder.weight"].contains(&weight)
}

/// Name and shape of every tensor of the network, with the stiffnesses first if it has weights for several.
pub fn tensor_shapes(description: &Description) -> BTreeMap<String, Vec<usize>> {
    let knots = description.stiffness_knots.len();
    let shape = |axes: &[usize]| {
        (knots > 0).then_some(knots).into_iter().chain(axes.iter().copied()).collect()
    };
    Plan::new(description)
        .layers
        .into_iter()
        .flat_map(|LinearLayer { weight, bias, input, output, sharing }| {
            [(weight, shape(&[output, input])), (bias, shape(&[output / sharing]))]
        })
        .collect()
}

/// Checks that the tensors are exactly those of the network and finite.
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
        let rounded = |&value: &f32| description.weights.rounded(value);
        if let Some(index) = found.values.iter().position(|value| rounded(value) != *value) {
            let (found, expected) = (found.values[index], rounded(&found.values[index]));
            return Err(CheckpointError::NotRounded {
                file: file(),
                tensor,
                index,
                found,
                expected,
            });
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
