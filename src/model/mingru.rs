//! minGRU: z = sigmoid(W_z x), c = W_h x, h_t = (1 - z) h_{t-1} + z c
//! (Feng et al. 2024, section 3.1; the paper's Fig. 6). The log form has g(c) in the place of c.

use burn::tensor::{Tensor, activation::sigmoid};

use super::{layers::Linear, scan::candidate};
use crate::checkpoint::Form;

/// One minGRU layer.
#[derive(Clone, Debug)]
pub(crate) struct MinGru {
    pub(crate) gate: Linear,
    pub(crate) candidate: Linear,
    pub(crate) form: Form,
}

impl MinGru {
    /// a = 1 - z, b = z c.
    pub(crate) fn coefficients<const D: usize>(&self, input: Tensor<D>) -> (Tensor<D>, Tensor<D>) {
        let update = sigmoid(self.gate.forward(input.clone()));
        let candidate = candidate(self.form, self.candidate.forward(input));
        (1.0 - update.clone(), update * candidate)
    }
}
