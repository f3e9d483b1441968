//! A GRU layer frame by frame: values and gradients. The equations are those of `model/gru.rs` in `eddy-learning`, which uses tensor operations.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::{
    math::{sigmoid, tanh},
    matrix::Matrix,
    packed::{Recurrent, is_zero, recurrent_gradients},
    vectors::{parts, parts_mut, zip},
};

/// Gates of a cell.
const GATES: usize = 3;

/// The recurrent part of a layer with R rows and width H.
#[derive(Clone, Copy, Debug)]
pub struct Gru<'a> {
    /// Products of the inputs with W_ih, plus b_ih, `[T, R, 3 H]`: gates r, z, n.
    pub inputs: &'a [f32],
    /// W_hh, `[H, 3 H]`.
    pub weight: &'a [f32],
    /// b_hh, `[3 H]`.
    pub bias: &'a [f32],
    /// The state before the first frame, `[R, H]`.
    pub hidden: &'a [f32],
}

/// Results of all frames.
#[derive(Clone, Debug)]
pub struct States {
    /// `[T, R, H]`.
    pub states: Vec<f32>,
    /// Activated gates, `[T, R, 3 H]`.
    pub gates: Vec<f32>,
    /// Products of the states with W_hh, plus b_hh, `[T, R, 3 H]`.
    pub recurrent: Vec<f32>,
}

/// Gradients of the layer.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// By the products of the inputs, `[T, R, 3 H]`.
    pub inputs: Vec<f32>,
    /// By W_hh, `[H, 3 H]`.
    pub weight: Vec<f32>,
    /// By b_hh, `[3 H]`.
    pub bias: Vec<f32>,
    /// By the state before the first frame, `[R, H]`.
    pub hidden: Vec<f32>,
}

impl Gru<'_> {
    fn width(&self) -> usize {
        self.bias.len() / GATES
    }

    /// The states.
    pub fn forward(&self) -> States {
        let width = self.width();
        let rows = self.hidden.len() / width;
        let frame = rows * GATES * width;
        let mut gates = self.inputs.to_vec();
        let mut recurrent = vec![0.0; self.inputs.len()];
        for row in recurrent.chunks_exact_mut(GATES * width) {
            row.copy_from_slice(self.bias);
        }
        let mut states = vec![0.0; self.inputs.len() / GATES];
        let weight =
            Recurrent::new(Matrix::new(self.weight, width, GATES * width), gates.len() / frame);
        let all = gates.chunks_exact_mut(frame).zip(recurrent.chunks_exact_mut(frame));
        for (t, (gates, recurrent)) in all.enumerate() {
            let (earlier, now) = states.split_at_mut(t * rows * width);
            let before = match earlier.len().checked_sub(rows * width) {
                None => self.hidden,
                Some(start) => &earlier[start..],
            };
            if t > 0 || !is_zero(self.hidden) {
                weight.add_product(Matrix::new(before, rows, width), recurrent);
            }
            gates
                .par_chunks_exact_mut(GATES * width)
                .zip(recurrent.par_chunks_exact(GATES * width))
                .zip(before.par_chunks_exact(width))
                .zip(now[..rows * width].par_chunks_exact_mut(width))
                .for_each(|(((gates, recurrent), before), state)| {
                    Arch::new().dispatch(Forward { gates, recurrent, before, state });
                });
        }
        States { states, gates, recurrent }
    }

    /// The gradients from `gradient`, that by the `states`, `[T, R, H]`. `states`, `gates` and `recurrent` are the results of
    /// `forward`. The gradient by the state before the first frame is computed only if `by_start`.
    pub fn backward(
        &self,
        states: &[f32],
        gates: &[f32],
        recurrent: &[f32],
        gradient: &[f32],
        by_start: bool,
    ) -> Gradients {
        let width = self.width();
        let rows = self.hidden.len() / width;
        let frame = rows * GATES * width;
        let mut inputs = vec![0.0; self.inputs.len()];
        // By the recurrent products; only n differs from the products of the inputs.
        let mut products = vec![0.0; self.inputs.len()];
        // By the state: directly (z h), and through the recurrent products.
        let (mut direct, mut through) = (vec![0.0; rows * width], vec![0.0; rows * width]);
        let weight = Matrix::new(self.weight, width, GATES * width).transposed();
        let weight = Recurrent::new(weight, inputs.len() / frame);
        for t in (0..inputs.len() / frame).rev() {
            let before = match t {
                0 => self.hidden,
                _ => &states[(t - 1) * rows * width..t * rows * width],
            };
            let (from, to) = (t * frame, (t + 1) * frame);
            let products = &mut products[from..to];
            inputs[from..to]
                .par_chunks_exact_mut(GATES * width)
                .zip(products.par_chunks_exact_mut(GATES * width))
                .zip(direct.par_chunks_exact_mut(width))
                .zip(through.par_chunks_exact(width))
                .enumerate()
                .for_each(|(row, (((inputs, products), direct), through))| {
                    let gate = from + row * GATES * width;
                    let state = (t * rows + row) * width;
                    Arch::new().dispatch(Backward {
                        gates: &gates[gate..gate + GATES * width],
                        candidate: &recurrent[gate + 2 * width..gate + GATES * width],
                        before: &before[row * width..(row + 1) * width],
                        gradient: &gradient[state..state + width],
                        through,
                        direct,
                        inputs,
                        products,
                    });
                });
            if t > 0 || by_start {
                through.fill(0.0);
                weight.add_product(Matrix::new(products, rows, GATES * width), &mut through);
            }
        }
        let [weight, bias] = recurrent_gradients(
            states,
            width,
            self.hidden,
            &products,
            [rows, width, GATES * width],
        );
        direct.iter_mut().zip(&through).for_each(|(direct, through)| *direct += through);
        Gradients { inputs, weight, bias, hidden: direct }
    }
}

/// The gates r, z, n and the new state: from the sums of r and z, the products of the input and of the state for n, and the
/// previous state.
#[inline(always)]
pub(crate) fn cell<S: Simd>(
    simd: S,
    [r, z, input, recurrent]: [S::f32s; 4],
    before: S::f32s,
) -> [S::f32s; 4] {
    let (r, z) = (sigmoid(simd, r), sigmoid(simd, z));
    let n = tanh(simd, simd.mul_add_e_f32s(r, recurrent, input));
    [r, z, n, simd.mul_add_e_f32s(z, simd.sub_f32s(before, n), n)]
}

struct Forward<'a> {
    /// In: products of the inputs; out: activated gates.
    gates: &'a mut [f32],
    recurrent: &'a [f32],
    before: &'a [f32],
    state: &'a mut [f32],
}

impl WithSimd for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let [reset, update, candidate] = parts(self.recurrent);
        let [r, z, n] = parts_mut(self.gates);
        zip(
            simd,
            [reset, update, candidate, self.before],
            [r, z, n, self.state],
            #[inline(always)]
            |[reset, update, candidate, before], [r, z, n, _]| {
                let (r, z) = (simd.add_f32s(r, reset), simd.add_f32s(z, update));
                cell(simd, [r, z, n, candidate], before)
            },
        );
    }
}

struct Backward<'a> {
    gates: &'a [f32],
    /// The recurrent product of n.
    candidate: &'a [f32],
    before: &'a [f32],
    gradient: &'a [f32],
    /// By the state, through the recurrent products of the next frame.
    through: &'a [f32],
    /// In: by the state, directly from the next frame; out: by the previous state.
    direct: &'a mut [f32],
    inputs: &'a mut [f32],
    products: &'a mut [f32],
}

impl WithSimd for Backward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let [r, z, n] = parts(self.gates);
        let [by_r, by_z, by_n] = parts_mut(self.inputs);
        let [product_r, product_z, product_n] = parts_mut(self.products);
        let one = simd.splat_f32s(1.0);
        zip(
            simd,
            [r, z, n, self.candidate, self.before, self.gradient, self.through],
            [self.direct, by_r, by_z, by_n, product_r, product_z, product_n],
            #[inline(always)]
            |[r, z, n, candidate, before, gradient, through], [direct, _, _, _, _, _, _]| {
                let by_state = simd.add_f32s(simd.add_f32s(direct, through), gradient);
                let new = simd.mul_f32s(by_state, simd.sub_f32s(one, z));
                let by_n = simd.mul_f32s(new, simd.sub_f32s(one, simd.mul_f32s(n, n)));
                // The derivative of a sigmoid y is y (1 - y).
                let slope = |y| simd.mul_f32s(y, simd.sub_f32s(one, y));
                let by_r = simd.mul_f32s(simd.mul_f32s(by_n, candidate), slope(r));
                let by_z = simd.mul_f32s(by_state, simd.sub_f32s(before, n));
                let by_z = simd.mul_f32s(by_z, slope(z));
                [simd.mul_f32s(by_state, z), by_r, by_z, by_n, by_r, by_z, simd.mul_f32s(by_n, r)]
            },
        );
    }
}
