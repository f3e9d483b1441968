//! GRU as in PyTorch: with (i_r, i_z, i_n) = W_ih x + b_ih and (h_r, h_z, h_n) = W_hh h + b_hh,
//! r = sigmoid(i_r + h_r), z = sigmoid(i_z + h_z), n = tanh(i_n + r h_n), h_t = (1 - z) n + z h_{t-1}
//! (Cho et al. 2014).

use burn::tensor::{
    Tensor,
    activation::{sigmoid, tanh},
};

use super::{fused, fused_layers, linear::Linear, state::at};

/// A GRU layer.
#[derive(Clone, Debug)]
pub(crate) struct Gru {
    pub(crate) ih: Linear,
    pub(crate) hh: Linear,
}

impl Gru {
    /// All states, `[T, R, H]`, for the inputs, `[T, R, I]`, from the previous state (zero if none).
    pub(crate) fn observe(&self, input: Tensor<3>, carried: Option<Tensor<2>>) -> Tensor<3> {
        let inputs = self.ih.forward(input); // [T, R, 3 H]
        if fused::runs_on(&inputs.device()) {
            let [_, rows, gates] = inputs.dims();
            let Linear { weight, bias } = self.hh.clone();
            let zero = || Tensor::zeros([rows, gates / 3], &inputs.device());
            return fused_layers::gru(inputs.clone(), weight, bias, carried.unwrap_or_else(zero));
        }
        let mut hidden = carried;
        let mut states = Vec::new();
        for t in 0..inputs.dims()[0] {
            let state = self.cell(at(&inputs, t), hidden);
            hidden = Some(state.clone());
            states.push(state);
        }
        Tensor::stack(states, 0)
    }

    /// The next state, `[R, H]`, for the input, `[R, I]`.
    pub(crate) fn step(&self, input: Tensor<2>, carried: Option<Tensor<2>>) -> Tensor<2> {
        self.cell(self.ih.forward(input), carried)
    }

    /// `inputs` is `[R, 3 H]`.
    fn cell(&self, inputs: Tensor<2>, carried: Option<Tensor<2>>) -> Tensor<2> {
        let [rows, gates] = inputs.dims();
        let width = gates / 3;
        let hidden = carried.unwrap_or_else(|| Tensor::zeros([rows, width], &inputs.device()));
        let recurrent = self.hh.forward(hidden.clone());
        let gate = |from: &Tensor<2>, gate: usize| {
            from.clone().slice([0..rows, gate * width..(gate + 1) * width])
        };
        let reset = sigmoid(gate(&inputs, 0) + gate(&recurrent, 0));
        let update = sigmoid(gate(&inputs, 1) + gate(&recurrent, 1));
        let candidate = tanh(gate(&inputs, 2) + reset * gate(&recurrent, 2));
        candidate.clone() + update * (hidden - candidate)
    }
}
