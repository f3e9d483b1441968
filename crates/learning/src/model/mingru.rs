//! minGRU: z = sigmoid(W_z x), c = W_h x, h_t = (1 - z) h_{t-1} + z c
//! (Feng et al. 2024, section 3.1; the paper's Fig. 6). The log form has g(c) instead of c.

use burn::tensor::{Tensor, activation::sigmoid};

use super::{
    fused, fused_layers,
    linear::Linear,
    scan::{candidate, scan},
};
use eddy_inference::{checkpoint::Form, kernels::minimal::Minimal};

/// A minGRU layer.
#[derive(Clone, Debug)]
pub(crate) struct MinGru {
    pub(crate) gate: Linear,
    pub(crate) candidate: Linear,
    pub(crate) form: Form,
}

impl MinGru {
    /// All states, `[T, R, H]`, for the inputs, `[T, R, I]`, from the previous state (zero if none).
    pub(crate) fn observe(&self, input: Tensor<3>, carried: Option<Tensor<2>>) -> Tensor<3> {
        if !fused::runs_on(&self.gate.weight.device()) {
            let (a, b) = self.coefficients(input);
            return scan(a, b, carried);
        }
        let gate = self.gate.forward(input.clone());
        let candidate = self.candidate.forward(input);
        let [_, rows, width] = gate.dims();
        let carried = carried.unwrap_or_else(|| Tensor::zeros([rows, width], &gate.device()));
        let kind = Minimal { log: self.form == Form::Log, normalize: false };
        fused_layers::mingru(kind, gate, candidate, carried)
    }

    /// a = 1 - z, b = z c.
    pub(crate) fn coefficients<const D: usize>(&self, input: Tensor<D>) -> (Tensor<D>, Tensor<D>) {
        let update = sigmoid(self.gate.forward(input.clone()));
        let candidate = candidate(self.form, self.candidate.forward(input));
        (1.0 - update.clone(), update * candidate)
    }
}
