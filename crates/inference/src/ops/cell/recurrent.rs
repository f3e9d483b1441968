//! Cells whose sums depend on the last output, frame by frame: states, and gradients. The rows of a frame are independent.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::{Cell, MAX_SUMS};
use crate::kernels::{
    matrix::Matrix,
    packed::{Recurrent, is_zero, recurrent_gradients},
    vectors::{lanes, load, store},
};

/// The recurrent part of a layer with R rows, width H, G gates, and a state of S numbers for each unit: the outputs of a row, then
/// its cells.
#[derive(Clone, Copy, Debug)]
pub struct Layer<'a, C> {
    /// Its cell.
    pub cell: C,
    /// Products of the inputs with W_ih, plus b_ih, `[T, R, G H]`.
    pub inputs: &'a [f32],
    /// W_hh, `[H, G H]`.
    pub weight: &'a [f32],
    /// b_hh, `[G H]`.
    pub bias: &'a [f32],
    /// The state before the first frame, `[R, S H]`.
    pub initial: &'a [f32],
}

/// Results of all frames.
#[derive(Clone, Debug)]
pub struct States {
    /// `[T, R, S H]`.
    pub states: Vec<f32>,
    /// What the gradients need.
    pub kept: Kept,
}

/// What the gradients need, `[T, R, G H]`.
#[derive(Clone, Debug)]
pub struct Kept {
    /// Activated gates.
    gates: Vec<f32>,
    /// Products of the last outputs with W_hh, plus b_hh; empty without a split gate.
    products: Vec<f32>,
}

/// Gradients of the layer.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// By the products of the inputs, `[T, R, G H]`.
    pub inputs: Vec<f32>,
    /// By W_hh, `[H, G H]`.
    pub weight: Vec<f32>,
    /// By b_hh, `[G H]`.
    pub bias: Vec<f32>,
    /// By the state before the first frame, `[R, S H]`.
    pub initial: Vec<f32>,
}

impl<C: Cell> Layer<'_, C> {
    /// H, and numbers in a row of states and of sums.
    fn widths(&self) -> [usize; 3] {
        let width = self.bias.len() / C::CORE.gates();
        [width, C::CORE.states() * width, self.bias.len()]
    }

    /// R.
    fn rows(&self) -> usize {
        self.initial.len() / self.widths()[1]
    }

    /// The state before frame `t`, `[R, S H]`.
    fn before<'a>(&'a self, states: &'a [f32], t: usize) -> &'a [f32] {
        let frame = self.initial.len();
        match t {
            0 => self.initial,
            _ => &states[(t - 1) * frame..t * frame],
        }
    }

    /// The states.
    pub fn forward(&self) -> States {
        let ([width, state_width, sum_width], rows) = (self.widths(), self.rows());
        let frame = rows * sum_width;
        let mut gates = self.inputs.to_vec();
        let mut products = vec![0.0; gates.len()];
        for row in products.chunks_exact_mut(sum_width) {
            row.copy_from_slice(self.bias);
        }
        let mut states = vec![0.0; gates.len() / sum_width * state_width];
        let weight =
            Recurrent::new(Matrix::new(self.weight, width, sum_width), gates.len() / frame);
        let all = gates.chunks_exact_mut(frame).zip(products.chunks_exact_mut(frame));
        for (t, (gates, products)) in all.enumerate() {
            let (earlier, now) = states.split_at_mut(t * rows * state_width);
            let before = self.before(earlier, t);
            if t > 0 || !is_zero(before) {
                let outputs = Matrix::with_stride(before, rows, width, state_width);
                weight.add_product(outputs, products);
            }
            gates
                .par_chunks_exact_mut(sum_width)
                .zip(products.par_chunks_exact(sum_width))
                .zip(before.par_chunks_exact(state_width))
                .zip(now[..rows * state_width].par_chunks_exact_mut(state_width))
                .for_each(|(((gates, products), before), state)| {
                    let cell = self.cell;
                    Arch::new().dispatch(Forward { cell, gates, products, before, state });
                });
        }
        let products = if is_split::<C>() { products } else { Vec::new() };
        States { states, kept: Kept { gates, products } }
    }

    /// The gradients from `gradient`, that by the `states`, `[T, R, S H]`. `states` and `kept` are the results of
    /// [`Layer::forward`]. The gradient by the state before the first frame is computed only if `by_initial`.
    pub fn backward(
        &self,
        states: &[f32],
        kept: &Kept,
        gradient: &[f32],
        by_initial: bool,
    ) -> Gradients {
        let ([width, state_width, sum_width], rows) = (self.widths(), self.rows());
        let frame = rows * sum_width;
        let mut inputs = vec![0.0; self.inputs.len()];
        let mut products = vec![0.0; self.inputs.len()];
        // By the last state: directly, and by the output through the products.
        let (mut direct, mut through) = (vec![0.0; rows * state_width], vec![0.0; rows * width]);
        let weight = Matrix::new(self.weight, width, sum_width).transposed();
        let weight = Recurrent::new(weight, inputs.len() / frame);
        for t in (0..inputs.len() / frame).rev() {
            let now = t * frame..(t + 1) * frame;
            let before = self.before(states, t);
            let products = &mut products[now.clone()];
            inputs[now]
                .par_chunks_exact_mut(sum_width)
                .zip(products.par_chunks_exact_mut(sum_width))
                .zip(direct.par_chunks_exact_mut(state_width))
                .zip(through.par_chunks_exact(width))
                .enumerate()
                .for_each(|(number, (((by_inputs, by_products), direct), through))| {
                    let here = t * rows + number;
                    Arch::new().dispatch(Backward {
                        cell: self.cell,
                        gates: row(&kept.gates, here, sum_width),
                        products: match is_split::<C>() {
                            true => row(&kept.products, here, sum_width),
                            false => &[],
                        },
                        states: [row(before, number, state_width), row(states, here, state_width)],
                        gradient: row(gradient, here, state_width),
                        through,
                        direct,
                        by_inputs,
                        by_products,
                    });
                });
            if t > 0 || by_initial {
                through.fill(0.0);
                weight.add_product(Matrix::new(products, rows, sum_width), &mut through);
            }
        }
        let sizes = [rows, width, sum_width];
        let [weight, bias] =
            recurrent_gradients(states, self.initial, state_width, &products, sizes);
        for (direct, through) in direct.chunks_exact_mut(state_width).zip(through.chunks(width)) {
            direct.iter_mut().zip(through).for_each(|(direct, through)| *direct += through);
        }
        Gradients { inputs, weight, bias, initial: direct }
    }
}

/// Whether a gate has a sum of its own for the last output.
fn is_split<C: Cell>() -> bool {
    C::CORE.split_gate().is_some()
}

/// A row of a list.
fn row(list: &[f32], number: usize, width: usize) -> &[f32] {
    &list[number * width..(number + 1) * width]
}

/// A row of a frame.
struct Forward<'a, C> {
    cell: C,
    /// In: products of the inputs; out: activated gates.
    gates: &'a mut [f32],
    products: &'a [f32],
    before: &'a [f32],
    state: &'a mut [f32],
}

impl<C: Cell> WithSimd for Forward<'_, C> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { cell, gates, products, before, state } = self;
        let [count, states] = const { [C::CORE.gates(), C::CORE.states()] };
        let width = gates.len() / count;
        for vector in 0..width.div_ceil(S::F32_LANES) {
            let part = |part| lanes::<S>(part, vector, width);
            let mut sums = [simd.splat_f32s(0.0); MAX_SUMS];
            for gate in 0..count {
                let product = load(simd, products, part(gate));
                sums[gate] = load(simd, gates, part(gate));
                if C::CORE.split_gate() == Some(gate) {
                    sums[count] = product;
                } else {
                    sums[gate] = simd.add_f32s(sums[gate], product);
                }
            }
            let mut next = [simd.splat_f32s(0.0); 2];
            for (number, next) in next.iter_mut().enumerate().take(states) {
                *next = load(simd, before, part(number));
            }
            cell.next(simd, &mut sums, &mut next);
            for (gate, &sum) in sums.iter().enumerate().take(count) {
                store(simd, gates, part(gate), sum);
            }
            for (number, &next) in next.iter().enumerate().take(states) {
                store(simd, state, part(number), next);
            }
        }
    }
}

/// A row of a frame.
struct Backward<'a, C> {
    cell: C,
    gates: &'a [f32],
    products: &'a [f32],
    /// Before and after the frame.
    states: [&'a [f32]; 2],
    gradient: &'a [f32],
    /// By the output, through the products of the next frame.
    through: &'a [f32],
    /// In: by the state, directly from the next frame; out: by the last state.
    direct: &'a mut [f32],
    by_inputs: &'a mut [f32],
    by_products: &'a mut [f32],
}

impl<C: Cell> WithSimd for Backward<'_, C> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { cell, gates, products, states: [last, new], .. } = self;
        let Self { gradient, through, direct, by_inputs, by_products, .. } = self;
        let [count, states] = const { [C::CORE.gates(), C::CORE.states()] };
        let width = through.len();
        for vector in 0..width.div_ceil(S::F32_LANES) {
            let part = |part| lanes::<S>(part, vector, width);
            let zero = simd.splat_f32s(0.0);
            let (mut sums, mut before, mut after, mut by) =
                ([zero; MAX_SUMS], [zero; 2], [zero; 2], [zero; 2]);
            for gate in 0..count {
                sums[gate] = load(simd, gates, part(gate));
                if C::CORE.split_gate() == Some(gate) {
                    sums[count] = load(simd, products, part(gate));
                }
            }
            for number in 0..states {
                before[number] = load(simd, last, part(number));
                after[number] = load(simd, new, part(number));
                by[number] = load(simd, direct, part(number));
                if number == 0 {
                    by[0] = simd.add_f32s(by[0], load(simd, through, part(0)));
                }
                by[number] = simd.add_f32s(by[number], load(simd, gradient, part(number)));
            }
            cell.gradient(simd, &mut sums, before, after, &mut by);
            for gate in 0..count {
                store(simd, by_inputs, part(gate), sums[gate]);
                let is_split = C::CORE.split_gate() == Some(gate);
                store(simd, by_products, part(gate), sums[if is_split { count } else { gate }]);
            }
            for (number, &by) in by.iter().enumerate().take(states) {
                store(simd, direct, part(number), by);
            }
        }
    }
}
