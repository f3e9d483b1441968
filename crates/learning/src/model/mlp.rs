//! The core without recurrence: a linear layer and an activation, the paper's baseline.

use burn::tensor::{Tensor, activation};

use super::linear::Linear;
use eddy_inference::checkpoint::Activation;

/// A layer.
#[derive(Clone, Debug)]
pub(crate) struct Mlp {
    pub(crate) linear: Linear,
    pub(crate) activation: Activation,
}

impl Mlp {
    /// `[.., I]` to `[.., H]`.
    pub(crate) fn forward<const D: usize>(&self, input: Tensor<D>) -> Tensor<D> {
        activate(self.activation, self.linear.forward(input))
    }
}

/// Applies an activation function elementwise.
pub(crate) fn activate<const D: usize>(kind: Activation, signal: Tensor<D>) -> Tensor<D> {
    match kind {
        Activation::Sigmoid => activation::sigmoid(signal),
        Activation::Tanh => activation::tanh(signal),
        Activation::Relu => activation::relu(signal),
        Activation::Elu => activation::elu(signal, 1.0),
    }
}
