//! The layers of the core. This is their definition: everything else is tested against it. `ops::cell` of `eddy-inference` has the
//! equations.

use burn::tensor::{
    Tensor,
    activation::{elu, relu, sigmoid, tanh},
};

use super::{
    fused, fused_layers,
    linear::Linear,
    scan::scan,
    state::{LayerState, at},
};
use eddy_inference::{
    checkpoint::{Activation, Description},
    ops::cell::{AnyCell, Form, MIN_GATE_SUM, MinGru, MinLstm},
};

/// A layer of the core.
#[derive(Clone, Debug)]
pub(crate) struct RecurrentLayer {
    cell: AnyCell,
    /// The linear parts that read the input.
    input: Vec<Linear>,
    /// The one that reads the last output.
    recurrent: Option<Linear>,
}

impl RecurrentLayer {
    /// A layer of the described core; `linear` creates its parts by name.
    pub(crate) fn new(description: &Description, linear: impl Fn(&str) -> Linear) -> Self {
        let core = description.core;
        Self {
            cell: AnyCell::new(description),
            input: core.input_parts().iter().map(|(part, _)| linear(part)).collect(),
            recurrent: core.recurrent_part().map(linear),
        }
    }

    /// Its linear parts, those that read the input first.
    pub(crate) fn parts(&self) -> impl Iterator<Item = &Linear> {
        self.input.iter().chain(&self.recurrent)
    }

    /// As [`RecurrentLayer::parts`], to change them.
    pub(crate) fn parts_mut(&mut self) -> impl Iterator<Item = &mut Linear> {
        self.input.iter_mut().chain(&mut self.recurrent)
    }

    /// All outputs, `[T, R, H]`, for the inputs, `[T, R, I]`, and the state after the last frame, from the state before the
    /// first (zero if none).
    pub(crate) fn observe(
        &self,
        input: Tensor<3>,
        carried: Option<LayerState>,
    ) -> (Tensor<3>, LayerState) {
        let mut sums: Vec<_> = self.input.iter().map(|part| part.forward(input.clone())).collect();
        if fused::runs_on(&input.device()) {
            return fused_layers::cells(self.cell, sums, self.recurrent.as_ref(), carried);
        }
        let last = carried.as_ref().map(|state| state.hidden.clone());
        let output = match self.cell {
            AnyCell::Mlp(cell) => activate(cell.activation, sums.remove(0)),
            AnyCell::MinGru(cell) => {
                let (a, b) = mingru(cell, sums);
                scan(a, b, last)
            }
            AnyCell::MinLstm(cell) => {
                let (a, b) = minlstm(cell, sums);
                scan(a, b, last)
            }
            AnyCell::Gru(_) => return self.frame_by_frame(gru, &sums[0], carried),
            AnyCell::Lstm(_) => return self.frame_by_frame(lstm, &sums[0], carried),
        };
        let hidden = at(&output, output.dims()[0] - 1);
        (output, LayerState { hidden, cell: None })
    }

    /// The next state, which includes the output, `[R, H]`, for the input, `[R, I]`, from the previous state (zero if none).
    pub(crate) fn step(&self, input: Tensor<2>, carried: Option<LayerState>) -> LayerState {
        self.observe(input.unsqueeze(), carried).1
    }

    /// All outputs, `[T, R, H]`, and the last state, from the sums of the inputs, `[T, R, G H]`.
    fn frame_by_frame(
        &self,
        next: fn(Tensor<2>, Tensor<2>, LayerState) -> LayerState,
        sums: &Tensor<3>,
        carried: Option<LayerState>,
    ) -> (Tensor<3>, LayerState) {
        let recurrent = self.recurrent.as_ref().expect("this core has the part that `Core` names");
        let [frames, rows, _] = sums.dims();
        let width = recurrent.weight.dims()[0];
        let mut state = carried.unwrap_or_else(|| LayerState {
            hidden: Tensor::zeros([rows, width], &sums.device()),
            cell: None,
        });
        let mut outputs = Vec::with_capacity(frames);
        for t in 0..frames {
            let products = recurrent.forward(state.hidden.clone());
            state = next(at(sums, t), products, state);
            outputs.push(state.hidden.clone());
        }
        (Tensor::stack(outputs, 0), state)
    }
}

/// a = 1 - s(z), b = s(z) g(c) of h' = a h + b, from z and c.
fn mingru(MinGru { form }: MinGru, sums: Vec<Tensor<3>>) -> (Tensor<3>, Tensor<3>) {
    let [gate, c] = parts(sums);
    let update = sigmoid(gate);
    (1.0 - update.clone(), update * candidate(form, c))
}

/// a = s(f), b = s(i) g(c) of h' = a h + b, from f, i and c. Normalised, a is 1 - u with u = s(i) / (s(f) + s(i)), so that a + u is
/// exactly 1.
fn minlstm(MinLstm { form, normalize }: MinLstm, sums: Vec<Tensor<3>>) -> (Tensor<3>, Tensor<3>) {
    let [forget, input, c] = parts(sums);
    let (forget, update) = (sigmoid(forget), sigmoid(input));
    let candidate = candidate(form, c);
    if !normalize {
        return (forget, update * candidate);
    }
    let update = update.clone() / (forget + update).add_scalar(MIN_GATE_SUM);
    (1.0 - update.clone(), update * candidate)
}

/// From the sums of the input and of the last output, `[R, 3 H]` each, and the last state.
fn gru(input: Tensor<2>, recurrent: Tensor<2>, last: LayerState) -> LayerState {
    let [[r, z, n], [of_r, of_z, of_n]] = [input, recurrent].map(gates);
    let update = sigmoid(z + of_z);
    let candidate = tanh(n + sigmoid(r + of_r) * of_n);
    LayerState { hidden: candidate.clone() + update * (last.hidden - candidate), cell: None }
}

/// From the sums of the input and of the last output, `[R, 4 H]` each, and the last state.
fn lstm(input: Tensor<2>, recurrent: Tensor<2>, last: LayerState) -> LayerState {
    let [i, f, g, o] = gates(input + recurrent);
    let entering = sigmoid(i) * tanh(g);
    let cell = match last.cell {
        Some(cell) => sigmoid(f) * cell + entering,
        None => entering,
    };
    LayerState { hidden: sigmoid(o) * tanh(cell.clone()), cell: Some(cell) }
}

/// The candidate as it enters the state: c, or in the log form g(c) = c + 1/2 for c >= 0 and s(c) below. The recurrence is
/// computed directly in that form too: with 0 <= a <= 1 it cannot overflow, and a zero state needs no logarithm.
pub(crate) fn candidate(form: Form, c: Tensor<3>) -> Tensor<3> {
    match form {
        Form::Plain => c,
        // s(min(c, 0)) is 1/2 for c >= 0.
        Form::Log => relu(c.clone()) + sigmoid(c.clamp_max(0.0)),
    }
}

/// Applies an activation function elementwise.
pub(crate) fn activate<const D: usize>(kind: Activation, signal: Tensor<D>) -> Tensor<D> {
    match kind {
        Activation::Sigmoid => sigmoid(signal),
        Activation::Tanh => tanh(signal),
        Activation::Relu => relu(signal),
        Activation::Elu => elu(signal, 1.0),
    }
}

/// The outputs of a layer's parts.
fn parts<const G: usize>(sums: Vec<Tensor<3>>) -> [Tensor<3>; G] {
    sums.try_into().expect("a core has the parts that `Core` names")
}

/// `[R, G H]` as G gates, `[R, H]`.
fn gates<const G: usize>(sums: Tensor<2>) -> [Tensor<2>; G] {
    let [rows, width] = sums.dims();
    let width = width / G;
    std::array::from_fn(|gate| sums.clone().slice([0..rows, gate * width..(gate + 1) * width]))
}
