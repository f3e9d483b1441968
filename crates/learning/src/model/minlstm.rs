//! minLSTM: f = sigmoid(W_f x), i = sigmoid(W_i x), c = W_h x, f' = f / (f + i), i' = i / (f + i),
//! h_t = f' h_{t-1} + i' c (Feng et al. 2024, section 3.2). There is no output gate and no separate
//! cell. The log form has g(c) instead of c; without normalised gates f' = f and i' = i.

use burn::tensor::{Tensor, activation::sigmoid};

use super::{
    fused, fused_layers,
    linear::Linear,
    scan::{candidate, scan},
};
use eddy_inference::{
    checkpoint::Form,
    kernels::minimal::{MIN_GATE_SUM, Minimal},
};

/// A minLSTM layer.
#[derive(Clone, Debug)]
pub(crate) struct MinLstm {
    pub(crate) forget_gate: Linear,
    pub(crate) input_gate: Linear,
    pub(crate) candidate: Linear,
    pub(crate) form: Form,
    pub(crate) normalize_gates: bool,
}

impl MinLstm {
    /// All states, `[T, R, H]`, for the inputs, `[T, R, I]`, from the previous state (zero if none).
    pub(crate) fn observe(&self, input: Tensor<3>, carried: Option<Tensor<2>>) -> Tensor<3> {
        if !fused::runs_on(&self.candidate.weight.device()) {
            let (a, b) = self.coefficients(input);
            return scan(a, b, carried);
        }
        let gates = [&self.forget_gate, &self.input_gate].map(|gate| gate.forward(input.clone()));
        let candidate = self.candidate.forward(input);
        let [_, rows, width] = candidate.dims();
        let carried = carried.unwrap_or_else(|| Tensor::zeros([rows, width], &candidate.device()));
        let kind = Minimal { log: self.form == Form::Log, normalize: self.normalize_gates };
        fused_layers::minlstm(kind, gates, candidate, carried)
    }

    /// a = f', b = i' c. Normalised, f' is 1 - i', so that a + i' is exactly 1.
    pub(crate) fn coefficients<const D: usize>(&self, input: Tensor<D>) -> (Tensor<D>, Tensor<D>) {
        let forget = sigmoid(self.forget_gate.forward(input.clone()));
        let update = sigmoid(self.input_gate.forward(input.clone()));
        let candidate = candidate(self.form, self.candidate.forward(input));
        if !self.normalize_gates {
            return (forget, update * candidate);
        }
        let update = update.clone() / (forget + update).add_scalar(MIN_GATE_SUM);
        (1.0 - update.clone(), update * candidate)
    }
}
