//! minLSTM: f = sigmoid(W_f x), i = sigmoid(W_i x), c = W_h x, f' = f / (f + i), i' = i / (f + i),
//! h_t = f' h_{t-1} + i' c (Feng et al. 2024, section 3.2). There is no output gate and no separate
//! cell. The log form has g(c) in the place of c; without normalised gates f' = f and i' = i.

use burn::tensor::{Tensor, activation::sigmoid};

use super::{layers::Linear, scan::candidate};
use crate::checkpoint::Form;

/// One minLSTM layer.
#[derive(Clone, Debug)]
pub(crate) struct MinLstm {
    pub(crate) forget_gate: Linear,
    pub(crate) input_gate: Linear,
    pub(crate) candidate: Linear,
    pub(crate) form: Form,
    pub(crate) normalize_gates: bool,
}

/// Keeps f + i from zero where both gates are shut as far as f32 goes.
pub(crate) const LEAST_SUM: f32 = 1e-12;

impl MinLstm {
    /// a = f', b = i' c. Normalised, f' is 1 - i', so that a + i' is 1 whatever the rounding.
    pub(crate) fn coefficients<const D: usize>(&self, input: Tensor<D>) -> (Tensor<D>, Tensor<D>) {
        let forget = sigmoid(self.forget_gate.forward(input.clone()));
        let update = sigmoid(self.input_gate.forward(input.clone()));
        let candidate = candidate(self.form, self.candidate.forward(input));
        if !self.normalize_gates {
            return (forget, update * candidate);
        }
        let update = update.clone() / (forget + update).add_scalar(LEAST_SUM);
        (1.0 - update.clone(), update * candidate)
    }
}
