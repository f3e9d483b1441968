//! An LSTM layer frame by frame: values and gradients. The equations are those of `model/lstm.rs` in `eddy-learning`, which uses tensor operations.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::{
    math::{sigmoid, tanh},
    matrix::Matrix,
    packed::{Recurrent, is_zero, recurrent_gradients},
    vectors::{parts, parts_mut, zip},
};

/// Gates of a cell.
const GATES: usize = 4;

/// The recurrent part of a layer with R rows and width H.
#[derive(Clone, Copy, Debug)]
pub struct Lstm<'a> {
    /// Products of the inputs with W_ih, plus b_ih, `[T, R, 4 H]`: gates i, f, g, o.
    pub inputs: &'a [f32],
    /// W_hh, `[H, 4 H]`.
    pub weight: &'a [f32],
    /// b_hh, `[4 H]`.
    pub bias: &'a [f32],
    /// The output before the first frame, `[R, H]`.
    pub hidden: &'a [f32],
    /// The cell before the first frame, `[R, H]`.
    pub cell: &'a [f32],
}

/// Results of all frames.
#[derive(Clone, Debug)]
pub struct States {
    /// `[T, R, 2 H]`: output, cell.
    pub states: Vec<f32>,
    /// Activated gates, `[T, R, 4 H]`.
    pub gates: Vec<f32>,
}

/// Gradients of the layer.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// By the products of the inputs, `[T, R, 4 H]`.
    pub inputs: Vec<f32>,
    /// By W_hh, `[H, 4 H]`.
    pub weight: Vec<f32>,
    /// By b_hh, `[4 H]`.
    pub bias: Vec<f32>,
    /// By the output before the first frame, `[R, H]`.
    pub hidden: Vec<f32>,
    /// By the cell before the first frame, `[R, H]`.
    pub cell: Vec<f32>,
}

impl Lstm<'_> {
    fn width(&self) -> usize {
        self.bias.len() / GATES
    }

    /// Outputs and cells.
    pub fn forward(&self) -> States {
        let width = self.width();
        let rows = self.hidden.len() / width;
        let frame = rows * GATES * width;
        let mut gates = self.inputs.to_vec();
        for row in gates.chunks_exact_mut(GATES * width) {
            row.iter_mut().zip(self.bias).for_each(|(sum, bias)| *sum += bias);
        }
        let mut states = vec![0.0; self.inputs.len() / 2];
        let weight =
            Recurrent::new(Matrix::new(self.weight, width, GATES * width), gates.len() / frame);
        for (t, gates) in gates.chunks_exact_mut(frame).enumerate() {
            let (earlier, now) = states.split_at_mut(t * frame / 2);
            let before = earlier.len().checked_sub(frame / 2).map(|start| &earlier[start..]);
            let hidden = match before {
                None => Matrix::new(self.hidden, rows, width),
                Some(before) => Matrix::with_stride(before, rows, width, 2 * width),
            };
            if t > 0 || !is_zero(self.hidden) {
                weight.add_product(hidden, gates);
            }
            gates
                .par_chunks_exact_mut(GATES * width)
                .zip(now[..frame / 2].par_chunks_exact_mut(2 * width))
                .enumerate()
                .for_each(|(row, (gates, state))| {
                    let cell = match before {
                        None => &self.cell[row * width..(row + 1) * width],
                        Some(before) => &before[(2 * row + 1) * width..2 * (row + 1) * width],
                    };
                    let (output, next) = state.split_at_mut(width);
                    Arch::new().dispatch(Forward { gates, cell, output, next });
                });
        }
        States { states, gates }
    }

    /// The gradients from `gradient`, that by the `states`, `[T, R, 2 H]`. `states` and `gates` are the results of `forward`.
    /// The gradients by output and cell before the first frame are computed only if `by_start`.
    pub fn backward(
        &self,
        states: &[f32],
        gates: &[f32],
        gradient: &[f32],
        by_start: bool,
    ) -> Gradients {
        let width = self.width();
        let rows = self.hidden.len() / width;
        let frame = rows * GATES * width;
        let mut inputs = vec![0.0; self.inputs.len()];
        let (mut hidden, mut cell) = (vec![0.0; rows * width], vec![0.0; rows * width]);
        let weight = Matrix::new(self.weight, width, GATES * width).transposed();
        let weight = Recurrent::new(weight, inputs.len() / frame);
        for t in (0..inputs.len() / frame).rev() {
            let states = |t: usize| &states[t * frame / 2..(t + 1) * frame / 2];
            let sums = &mut inputs[t * frame..(t + 1) * frame];
            sums.par_chunks_exact_mut(GATES * width)
                .zip(cell.par_chunks_exact_mut(width))
                .zip(hidden.par_chunks_exact(width))
                .enumerate()
                .for_each(|(row, ((sums, by_cell), by_hidden))| {
                    let second = (2 * row + 1) * width..2 * (row + 1) * width;
                    let before = match t {
                        0 => &self.cell[row * width..(row + 1) * width],
                        _ => &states(t - 1)[second.clone()],
                    };
                    let start = (t * rows + row) * GATES * width;
                    let from = (t * rows + row) * 2 * width;
                    Arch::new().dispatch(Backward {
                        gates: &gates[start..start + GATES * width],
                        before,
                        cell: &states(t)[second],
                        gradient: &gradient[from..from + 2 * width],
                        by_hidden,
                        by_cell,
                        sums,
                    });
                });
            if t > 0 || by_start {
                hidden.fill(0.0);
                weight.add_product(Matrix::new(sums, rows, GATES * width), &mut hidden);
            }
        }
        let [weight, bias] = recurrent_gradients(
            states,
            2 * width,
            self.hidden,
            &inputs,
            [rows, width, GATES * width],
        );
        Gradients { inputs, weight, bias, hidden, cell }
    }
}

/// The gates i, f, g, o, the new output and the new cell, from the sums of the gates and the previous cell.
#[inline(always)]
pub(crate) fn cell<S: Simd>(simd: S, [i, f, g, o]: [S::f32s; 4], last: S::f32s) -> [S::f32s; 6] {
    let (i, f, o) = (sigmoid(simd, i), sigmoid(simd, f), sigmoid(simd, o));
    let g = tanh(simd, g);
    let cell = simd.mul_add_e_f32s(f, last, simd.mul_f32s(i, g));
    [i, f, g, o, simd.mul_f32s(o, tanh(simd, cell)), cell]
}

struct Forward<'a> {
    /// In: sums; out: activated gates.
    gates: &'a mut [f32],
    cell: &'a [f32],
    output: &'a mut [f32],
    next: &'a mut [f32],
}

impl WithSimd for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let [i, f, g, o] = parts_mut(self.gates);
        zip(
            simd,
            [self.cell],
            [i, f, g, o, self.output, self.next],
            #[inline(always)]
            |[last], [i, f, g, o, _, _]| cell(simd, [i, f, g, o], last),
        );
    }
}

struct Backward<'a> {
    gates: &'a [f32],
    /// The cell before and after.
    before: &'a [f32],
    cell: &'a [f32],
    /// By output and cell, from later layers.
    gradient: &'a [f32],
    /// By the output, from the next frame.
    by_hidden: &'a [f32],
    /// In: by the cell, from the next frame; out: by the previous cell.
    by_cell: &'a mut [f32],
    /// By the gates' sums.
    sums: &'a mut [f32],
}

impl WithSimd for Backward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let [i, f, g, o] = parts(self.gates);
        let [by_i, by_f, by_g, by_o] = parts_mut(self.sums);
        let (by_output, by_state) = self.gradient.split_at(self.before.len());
        let one = simd.splat_f32s(1.0);
        zip(
            simd,
            [i, f, g, o, self.before, self.cell, by_output, by_state, self.by_hidden],
            [self.by_cell, by_i, by_f, by_g, by_o],
            #[inline(always)]
            |[i, f, g, o, before, cell, by_output, by_state, by_hidden], [by_cell, _, _, _, _]| {
                let bent = tanh(simd, cell);
                let by_output = simd.add_f32s(by_output, by_hidden);
                let flat = simd.sub_f32s(one, simd.mul_f32s(bent, bent));
                let through = simd.mul_f32s(simd.mul_f32s(by_output, o), flat);
                let by_cell = simd.add_f32s(simd.add_f32s(by_cell, by_state), through);
                // The derivative of a sigmoid y is y (1 - y).
                let slope = |y| simd.mul_f32s(y, simd.sub_f32s(one, y));
                [
                    simd.mul_f32s(by_cell, f),
                    simd.mul_f32s(simd.mul_f32s(by_cell, g), slope(i)),
                    simd.mul_f32s(simd.mul_f32s(by_cell, before), slope(f)),
                    simd.mul_f32s(
                        simd.mul_f32s(by_cell, i),
                        simd.sub_f32s(one, simd.mul_f32s(g, g)),
                    ),
                    simd.mul_f32s(simd.mul_f32s(by_output, bent), slope(o)),
                ]
            },
        );
    }
}
