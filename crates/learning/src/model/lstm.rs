//! LSTM as in PyTorch: (i, f, g, o) = W_ih x + b_ih + W_hh h + b_hh,
//! c_t = sigmoid(f) c_{t-1} + sigmoid(i) tanh(g), h_t = sigmoid(o) tanh(c_t)
//! (Hochreiter and Schmidhuber 1997, with the forget gate of Gers et al. 2000).

use burn::tensor::{
    Tensor,
    activation::{sigmoid, tanh},
};

use super::{
    fused, fused_layers,
    linear::Linear,
    state::{LayerState, at},
};

/// An LSTM layer.
#[derive(Clone, Debug)]
pub(crate) struct Lstm {
    pub(crate) ih: Linear,
    pub(crate) hh: Linear,
}

impl Lstm {
    /// All outputs, `[T, R, H]`, for the inputs, `[T, R, I]`, and the state after the last frame, from the previous state (zero
    /// if none).
    pub(crate) fn observe(
        &self,
        input: Tensor<3>,
        carried: Option<LayerState>,
    ) -> (Tensor<3>, LayerState) {
        let inputs = self.ih.forward(input); // [T, R, 4 H]
        if fused::runs_on(&inputs.device()) {
            return self.observe_fused(inputs, carried);
        }
        let mut state = self.cell(at(&inputs, 0), carried);
        let mut outputs = vec![state.hidden.clone()];
        for t in 1..inputs.dims()[0] {
            state = self.cell(at(&inputs, t), Some(state));
            outputs.push(state.hidden.clone());
        }
        (Tensor::stack(outputs, 0), state)
    }

    fn observe_fused(
        &self,
        inputs: Tensor<3>,
        carried: Option<LayerState>,
    ) -> (Tensor<3>, LayerState) {
        let [frames, rows, gates] = inputs.dims();
        let width = gates / 4;
        let before = self.before(rows, width, carried);
        let Linear { weight, bias } = self.hh.clone();
        let states = fused_layers::lstm(inputs, weight, bias, before); // [T, R, 2 H]
        let last = at(&states, frames - 1);
        let state = LayerState {
            hidden: last.clone().slice([0..rows, 0..width]),
            cell: Some(last.slice([0..rows, width..2 * width])),
        };
        (states.slice([0..frames, 0..rows, 0..width]), state)
    }

    /// Output and cell before the first frame (zero if none).
    fn before(&self, rows: usize, width: usize, carried: Option<LayerState>) -> [Tensor<2>; 2] {
        let zero = || Tensor::zeros([rows, width], &self.hh.weight.device());
        match carried {
            None => [zero(), zero()],
            Some(LayerState { hidden, cell }) => [hidden, cell.unwrap_or_else(zero)],
        }
    }

    /// The next state for the input, `[R, I]`.
    pub(crate) fn step(&self, input: Tensor<2>, carried: Option<LayerState>) -> LayerState {
        self.cell(self.ih.forward(input), carried)
    }

    /// `inputs` is `[R, 4 H]`.
    fn cell(&self, inputs: Tensor<2>, carried: Option<LayerState>) -> LayerState {
        let [rows, gates] = inputs.dims();
        let width = gates / 4;
        let [hidden, cell] = self.before(rows, width, carried);
        let sums = inputs + self.hh.forward(hidden);
        let gate = |gate: usize| sums.clone().slice([0..rows, gate * width..(gate + 1) * width]);
        let cell = sigmoid(gate(1)) * cell + sigmoid(gate(0)) * tanh(gate(2));
        LayerState { hidden: sigmoid(gate(3)) * tanh(cell.clone()), cell: Some(cell) }
    }
}
