//! minLSTM, plain form with normalised gates: f = sigmoid(W_f x), i = sigmoid(W_i x), c = W_h x,
//! f' = f / (f + i), i' = i / (f + i), h_t = f' h_{t-1} + i' c
//! (Feng et al. 2024, section 3.2). There is no output gate and no separate cell.

use burn::{
    module::Module,
    nn::Linear,
    tensor::{Tensor, activation::sigmoid},
};

/// One minLSTM layer.
#[derive(Module, Debug)]
pub(crate) struct MinLstm {
    pub(crate) forget_gate: Linear,
    pub(crate) input_gate: Linear,
    pub(crate) candidate: Linear,
}

/// Keeps f + i from zero where both gates are shut as far as f32 goes.
const LEAST_SUM: f32 = 1e-12;

impl MinLstm {
    /// a = f', b = i' c; f' is 1 - i', so that a + i' is 1 whatever the rounding.
    pub(crate) fn coefficients<const D: usize>(&self, input: Tensor<D>) -> (Tensor<D>, Tensor<D>) {
        let forget = sigmoid(self.forget_gate.forward(input.clone()));
        let update = sigmoid(self.input_gate.forward(input.clone()));
        let candidate = self.candidate.forward(input);
        let update = update.clone() / (forget + update).add_scalar(LEAST_SUM);
        (1.0 - update.clone(), update * candidate)
    }
}
