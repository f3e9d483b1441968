//! Linear layers, and the cells of the core.

use super::{Backward, Kept, Operate, exactly};
use eddy_inference::{
    checkpoint::Activation,
    kernels::activation::gradient_before,
    ops::{
        cell::{AnyCell, Cell, parallel, recurrent},
        linear::Linear,
    },
    with_cell,
};

/// A linear layer on the rows of one list or of two side by side.
pub(super) struct LinearOperation {
    pub(super) activation: Option<Activation>,
    /// Numbers in a row of the first list.
    pub(super) width: usize,
}

impl LinearOperation {
    /// The parts of the layer for each list. The activation follows the last one.
    fn parts<'a>(&self, lists: usize, weight: &'a [f32], bias: &'a [f32]) -> Vec<Linear<'a>> {
        let (first, second) = weight.split_at(self.width * bias.len());
        let of = |weight, activation| Linear { weight, bias, activation };
        match lists {
            1 => vec![of(first, self.activation)],
            _ => vec![of(first, None), of(second, self.activation)],
        }
    }
}

impl Operate for LinearOperation {
    fn forward(&self, read: &[&[f32]]) -> (Vec<f32>, Kept) {
        let [lists @ .., weight, bias] = read else { unreachable!("a layer has weights") };
        let parts = self.parts(lists.len(), weight, bias);
        let mut output = parts[0].forward(lists[0]);
        for (part, list) in parts.iter().zip(lists).skip(1) {
            part.add(list, &mut output);
        }
        (output, Kept::NOTHING)
    }

    fn backward(&self, of: &Backward<'_>) -> Vec<Vec<f32>> {
        let &Backward { read, written: output, gradient, wanted, .. } = of;
        let [lists @ .., weight, bias] = read else { unreachable!("a layer has weights") };
        let gradient = gradient_before(self.activation, output, gradient);
        let (mut by_lists, mut by_weight, mut by_bias) = (Vec::new(), Vec::new(), Vec::new());
        for (number, part) in self.parts(lists.len(), weight, bias).into_iter().enumerate() {
            let part = Linear { activation: None, ..part };
            let by = part.backward(lists[number], output, &gradient, wanted[number], true);
            by_lists.push(by.input);
            match number {
                0 => by_weight = by.weight,
                _ => by_weight.extend(by.weight),
            }
            by_bias = by.bias;
        }
        by_lists.extend([by_weight, by_bias]);
        by_lists
    }
}

/// A cell of the core; keeps its states, `[T, R, S H]`, of which its list has the outputs.
pub(super) struct CellOperation<'a> {
    pub(super) cell: AnyCell,
    /// H.
    pub(super) width: usize,
    /// Factors of dropout, `[T R, H]`.
    pub(super) mask: Option<&'a [f32]>,
    /// For the gradient: that by the state after the last frame, `[R, S H]`.
    pub(super) after: &'a [f32],
}

impl CellOperation<'_> {
    fn masked(&self, mut outputs: Vec<f32>) -> Vec<f32> {
        for (output, factor) in outputs.iter_mut().zip(self.mask.unwrap_or_default()) {
            *output *= factor;
        }
        outputs
    }
}

impl Operate for CellOperation<'_> {
    fn forward(&self, read: &[&[f32]]) -> (Vec<f32>, Kept) {
        let kept = with_cell!(self.cell, |cell, _| states(cell, read));
        let columns = with_cell!(self.cell, |cell, _| state_width(cell, self.width));
        let outputs = match columns > self.width {
            true => {
                let rows = kept.numbers().chunks_exact(columns);
                rows.flat_map(|row| &row[..self.width]).copied().collect()
            }
            false => kept.numbers().to_vec(),
        };
        (self.masked(outputs), kept)
    }

    fn backward(&self, of: &Backward<'_>) -> Vec<Vec<f32>> {
        let &Backward { read, kept, gradient, .. } = of;
        let columns = with_cell!(self.cell, |cell, _| state_width(cell, self.width));
        let mut by_states = self.masked(gradient.to_vec());
        if columns > self.width {
            let mut rows = vec![0.0; kept.numbers().len()];
            for (row, by) in rows.chunks_exact_mut(columns).zip(by_states.chunks(self.width)) {
                row[..self.width].copy_from_slice(by);
            }
            by_states = rows;
        }
        by_states.resize(kept.numbers().len(), 0.0); // without a gradient by its outputs
        let last = by_states.len() - self.after.len();
        by_states[last..].iter_mut().zip(self.after).for_each(|(by, after)| *by += after);
        with_cell!(self.cell, |cell, _| gradients(cell, read, kept, &by_states))
    }
}

/// Numbers in a row of states, S H.
fn state_width<C: Cell>(_: C, width: usize) -> usize {
    C::CORE.states() * width
}

/// The states of all frames, from sums, the recurrent part if there is one, and the state before the first frame.
fn states<C: Cell>(cell: C, read: &[&[f32]]) -> Kept {
    if const { C::CORE.recurrent_part().is_some() } {
        let [inputs, weight, bias, initial] = exactly(read);
        return Kept::States(recurrent::Layer { cell, inputs, weight, bias, initial }.forward());
    }
    let [sums @ .., initial] = read else { unreachable!("a cell reads its last state") };
    Kept::Numbers(parallel::forward(cell, sums, initial))
}

/// The gradients by what [`states`] reads, from those by the states.
fn gradients<C: Cell>(cell: C, read: &[&[f32]], kept: &Kept, gradient: &[f32]) -> Vec<Vec<f32>> {
    if let Kept::States(recurrent::States { states, kept }) = kept {
        let [inputs, weight, bias, initial] = exactly(read);
        let layer = recurrent::Layer { cell, inputs, weight, bias, initial };
        let by = layer.backward(states, kept, gradient, true);
        return vec![by.inputs, by.weight, by.bias, by.initial];
    }
    let [sums @ .., initial] = read else { unreachable!("a cell reads its last state") };
    parallel::backward(cell, sums, initial, kept.numbers(), gradient)
}
