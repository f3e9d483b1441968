//! The cells of the core over tensors. This is their definition: everything else is tested against it. `ops::cell` of
//! `eddy-inference` has the equations.

use burn::tensor::{
    Tensor,
    activation::{elu, relu, sigmoid, tanh},
};

use super::{linear::Linear, scan::scan, state::at};
use eddy_inference::{
    checkpoint::Activation,
    ops::cell::{AnyCell, Form, MIN_GATE_SUM, MinGru, MinLstm},
};

/// The outputs of a layer over T frames, `[T, R, H]`, and its state after the last one, `[R, S H]`: the output, and the cell of an
/// LSTM. `sums` are those of the layer's parts that read its input, `[T, R, H]` of each gate; `recurrent` is the part that reads the
/// last output; `state` that before the first frame.
pub(crate) fn cell(
    cell: AnyCell,
    mut sums: Vec<Tensor<3>>,
    recurrent: Option<&Linear>,
    state: Tensor<2>,
) -> (Tensor<3>, Tensor<2>) {
    let frame_by_frame = |next, sums| {
        let recurrent = recurrent.expect("this core has the part that `Core` names");
        frame_by_frame(next, recurrent, sums, state.clone())
    };
    let output = match cell {
        AnyCell::Mlp(cell) => activate(cell.activation, sums.remove(0)),
        AnyCell::MinGru(cell) => {
            let (a, b) = mingru(cell, sums);
            scan(a, b, Some(state))
        }
        AnyCell::MinLstm(cell) => {
            let (a, b) = minlstm(cell, sums);
            scan(a, b, Some(state))
        }
        AnyCell::Gru(_) => return frame_by_frame(gru, &sums[0]),
        AnyCell::Lstm(_) => return frame_by_frame(lstm, &sums[0]),
    };
    let last = at(&output, output.dims()[0] - 1);
    (output, last)
}

/// The state of an LSTM or GRU.
struct LayerState {
    /// Its last output, `[R, H]`.
    hidden: Tensor<2>,
    /// The cell of an LSTM, `[R, H]`; a GRU does not read it.
    cell: Tensor<2>,
}

fn frame_by_frame(
    next: fn(Tensor<2>, Tensor<2>, LayerState) -> LayerState,
    recurrent: &Linear,
    sums: &Tensor<3>,
    state: Tensor<2>,
) -> (Tensor<3>, Tensor<2>) {
    let ([rows, columns], [width, _]) = (state.dims(), recurrent.weight.dims());
    let part = |columns| state.clone().slice([0..rows, columns]);
    let mut state = LayerState { hidden: part(0..width), cell: part(columns - width..columns) };
    let mut outputs = Vec::new();
    for t in 0..sums.dims()[0] {
        let products = recurrent.forward(state.hidden.clone());
        state = next(at(sums, t), products, state);
        outputs.push(state.hidden.clone());
    }
    let last = match columns > width {
        true => Tensor::cat(vec![state.hidden, state.cell], 1),
        false => state.hidden,
    };
    (Tensor::stack(outputs, 0), last)
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
    LayerState { hidden: candidate.clone() + update * (last.hidden - candidate), ..last }
}

/// From the sums of the input and of the last output, `[R, 4 H]` each, and the last state.
fn lstm(input: Tensor<2>, recurrent: Tensor<2>, last: LayerState) -> LayerState {
    let [i, f, g, o] = gates(input + recurrent);
    let cell = sigmoid(f) * last.cell + sigmoid(i) * tanh(g);
    LayerState { hidden: sigmoid(o) * tanh(cell.clone()), cell }
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
