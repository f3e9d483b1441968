//! The recurrent cells as fused operations.

use burn::tensor::Tensor;

use super::super::{
    fused::{Operation, apply, input},
    linear::Linear,
    state::{LayerState, at},
};
use eddy_inference::{
    ops::cell::{
        AnyCell, Cell, parallel,
        recurrent::{Gradients, Kept, Layer, States},
    },
    with_cell,
};

/// The outputs, `[T, R, H]`, of a layer of the core and its state after the last frame, from its sums of the inputs, `[T, R, H]`
/// for each of its parts, the part that reads its last output, if it has one, and the state before the first frame (zero if
/// none).
pub(crate) fn cells(
    cell: AnyCell,
    sums: Vec<Tensor<3>>,
    recurrent: Option<&Linear>,
    carried: Option<LayerState>,
) -> (Tensor<3>, LayerState) {
    with_cell!(cell, |cell, _| layer(cell, sums, recurrent, carried))
}

fn layer<C: Cell>(
    cell: C,
    sums: Vec<Tensor<3>>,
    recurrent: Option<&Linear>,
    carried: Option<LayerState>,
) -> (Tensor<3>, LayerState) {
    let [frames, rows, columns] = sums[0].dims();
    let numbers = C::CORE.states();
    let width = recurrent.map_or(columns, |part| part.weight.dims()[0]);
    let zero = || Tensor::zeros([rows, width], &sums[0].device());
    let (hidden, last) = match carried.filter(|_| C::CORE.remembers()) {
        None => (zero(), None),
        Some(LayerState { hidden, cell }) => (hidden, cell),
    };
    let initial = match numbers {
        1 => hidden,
        _ => Tensor::cat(vec![hidden, last.unwrap_or_else(zero)], 1),
    }; // [R, S H]
    let initial = input(initial);
    let shape = [frames, rows, numbers * width];
    let mut sums = sums.into_iter().map(input).collect::<Vec<_>>();
    let states = match recurrent {
        // Constant, so that `Gated` is compiled only for cells with a recurrent part.
        Some(Linear { weight, bias }) if const { C::CORE.recurrent_part().is_some() } => {
            let [weight, bias] = [input(weight.clone()), input(bias.clone())];
            apply(Gated(cell), [sums.remove(0), weight, bias, initial], shape)
        }
        _ => {
            sums.push(initial);
            let reason = "a core has one to three parts that read its input";
            match sums.len() {
                2 => apply::<2, 3, _>(Ungated(cell), sums.try_into().expect(reason), shape),
                3 => apply::<3, 3, _>(Ungated(cell), sums.try_into().expect(reason), shape),
                _ => apply::<4, 3, _>(Ungated(cell), sums.try_into().expect(reason), shape),
            }
        }
    }; // [T, R, S H]
    let state = at(&states, frames - 1);
    if numbers == 1 {
        return (states, LayerState { hidden: state, cell: None });
    }
    let part = |number: usize| state.clone().slice([0..rows, number * width..(number + 1) * width]);
    let state = LayerState { hidden: part(0), cell: Some(part(1)) };
    (states.slice([0..frames, 0..rows, 0..width]), state)
}

/// A cell whose sums do not depend on the state: sums of its parts, `[T, R, H]`, and last state, `[R, H]`, to `[T, R, H]`.
#[derive(Clone, Copy, Debug)]
struct Ungated<C>(C);

impl<const N: usize, C: Cell> Operation<N> for Ungated<C> {
    type Kept = ();

    fn forward(&self, inputs: [&[f32]; N]) -> (Vec<f32>, ()) {
        let [sums @ .., initial] = inputs.as_slice() else { unreachable!("an input is the state") };
        (parallel::forward(self.0, sums, initial), ())
    }

    fn backward(
        &self,
        inputs: [&[f32]; N],
        states: &[f32],
        (): (),
        gradient: &[f32],
        _wanted: [bool; N],
    ) -> [Vec<f32>; N] {
        let [sums @ .., initial] = inputs.as_slice() else { unreachable!("an input is the state") };
        let all = parallel::backward(self.0, sums, initial, states, gradient);
        all.try_into().expect("a gradient for each input")
    }
}

/// A cell whose sums depend on its last output: products of the inputs, `[T, R, G H]`, recurrent weights, `[H, G H]`, bias, `[G H]`, and
/// last state, `[R, S H]`, to `[T, R, S H]`.
#[derive(Clone, Copy, Debug)]
struct Gated<C>(C);

impl<C: Cell> Operation<4> for Gated<C> {
    type Kept = Kept;

    fn forward(&self, [inputs, weight, bias, initial]: [&[f32]; 4]) -> (Vec<f32>, Kept) {
        let layer = Layer { cell: self.0, inputs, weight, bias, initial };
        let States { states, kept } = layer.forward();
        (states, kept)
    }

    fn backward(
        &self,
        [inputs, weight, bias, initial]: [&[f32]; 4],
        states: &[f32],
        kept: Kept,
        gradient: &[f32],
        [_, _, _, by_initial]: [bool; 4],
    ) -> [Vec<f32>; 4] {
        let layer = Layer { cell: self.0, inputs, weight, bias, initial };
        let Gradients { inputs, weight, bias, initial } =
            layer.backward(states, &kept, gradient, by_initial);
        [inputs, weight, bias, initial]
    }
}
