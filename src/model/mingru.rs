//! minGRU, plain form: z = sigmoid(W_z x), c = W_h x, h_t = (1 - z) h_{t-1} + z c
//! (Feng et al. 2024, section 3.1; the paper's Fig. 6).

use burn::{
    module::Module,
    nn::Linear,
    tensor::{Tensor, activation::sigmoid},
};

/// One minGRU layer.
#[derive(Module, Debug)]
pub(crate) struct MinGru {
    pub(crate) gate: Linear,
    pub(crate) candidate: Linear,
}

impl MinGru {
    /// a = 1 - z, b = z c.
    pub(crate) fn coefficients<const D: usize>(&self, input: Tensor<D>) -> (Tensor<D>, Tensor<D>) {
        let update = sigmoid(self.gate.forward(input.clone()));
        let candidate = self.candidate.forward(input);
        (1.0 - update.clone(), update * candidate)
    }
}
