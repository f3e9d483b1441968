//! minGRU and minLSTM over all frames at once, from the outputs of their linear parts to the states,
//! and back: one pass over memory each way. Frame by frame within a strip of columns, which are
//! independent of each other; `model/scan.rs` is the same by tensor operations.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::{
    math::{positive, sigmoid},
    vectors::{strips, zip},
};

/// Columns that a thread takes at once.
const STRIP: usize = 512;

/// What the recurrence is made of. `M` columns are the rows times the width of the state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Minimal {
    /// Whether the candidate c enters as g(c) = c + 1/2 for c >= 0 and sigmoid(c) below: the log form.
    pub log: bool,
    /// minLSTM: whether f and i are divided by their sum.
    pub normalize: bool,
}

/// Gradients of the recurrence, `[T, M]` but for the last.
#[derive(Clone, Debug)]
pub struct Gradients<const G: usize> {
    /// By the linear part of each gate.
    pub gates: [Vec<f32>; G],
    /// By that of the candidate.
    pub candidate: Vec<f32>,
    /// By the state before the first frame, `[M]`.
    pub carried: Vec<f32>,
}

impl Minimal {
    /// The states `[T, M]` from the linear parts of the gates (update; or forget, input) and of the
    /// candidate, each `[T, M]`, and the state before the first frame, `[M]`.
    pub fn forward<const G: usize>(
        self,
        gates: [&[f32]; G],
        candidate: &[f32],
        carried: &[f32],
    ) -> Vec<f32> {
        let width = carried.len();
        let mut states = vec![0.0; candidate.len()];
        strips(&mut states, width, STRIP).into_par_iter().enumerate().for_each(
            |(strip, states)| {
                let columns = Columns { start: strip * STRIP, width };
                Arch::new().dispatch(Forward {
                    kind: self,
                    gates,
                    candidate,
                    carried,
                    columns,
                    states,
                });
            },
        );
        states
    }

    /// The gradients from `gradient`, that of the states, `[T, M]`.
    pub fn backward<const G: usize>(
        self,
        gates: [&[f32]; G],
        candidate: &[f32],
        carried: &[f32],
        states: &[f32],
        gradient: &[f32],
    ) -> Gradients<G> {
        let width = carried.len();
        let zeros = || vec![0.0; candidate.len()];
        let mut by_gates: [Vec<f32>; G] = std::array::from_fn(|_| zeros());
        let mut by_candidate = zeros();
        let mut by_carried = vec![0.0; width];
        let mut by_gate_strips = Vec::new();
        by_gate_strips.resize_with(width.div_ceil(STRIP), Vec::new);
        for by_gate in &mut by_gates {
            for (all, strip) in by_gate_strips.iter_mut().zip(strips(by_gate, width, STRIP)) {
                all.push(strip);
            }
        }
        by_gate_strips
            .into_par_iter()
            .zip(strips(&mut by_candidate, width, STRIP))
            .zip(by_carried.par_chunks_mut(STRIP))
            .enumerate()
            .for_each(|(strip, ((by_gates, by_candidate), by_carried))| {
                let columns = Columns { start: strip * STRIP, width };
                Arch::new().dispatch(Backward {
                    kind: self,
                    gates,
                    candidate,
                    carried,
                    states,
                    gradient,
                    columns,
                    by_gates,
                    by_candidate,
                    by_carried,
                });
            });
        Gradients { gates: by_gates, candidate: by_candidate, carried: by_carried }
    }

    /// What enters the state, and its slope.
    #[inline(always)]
    fn entering<S: Simd>(self, simd: S, candidate: S::f32s) -> [S::f32s; 2] {
        let one = simd.splat_f32s(1.0);
        if !self.log {
            return [candidate, one];
        }
        let value = positive(simd, candidate);
        let above = simd.greater_than_f32s(candidate, simd.splat_f32s(0.0));
        let below = simd.mul_f32s(value, simd.sub_f32s(one, value)); // of a sigmoid
        [value, simd.select_f32s(above, one, below)]
    }
}

/// A strip of the columns.
#[derive(Clone, Copy)]
struct Columns {
    start: usize,
    width: usize,
}

impl Columns {
    /// The strip, `length` wide, of frame `t`.
    #[inline(always)]
    fn of(self, values: &[f32], t: usize, length: usize) -> &[f32] {
        let start = t * self.width + self.start;
        &values[start..start + length]
    }
}

/// Keeps f + i from zero where both gates are shut as far as f32 goes.
pub const LEAST_SUM: f32 = 1e-12;

struct Forward<'a, const G: usize> {
    kind: Minimal,
    gates: [&'a [f32]; G],
    candidate: &'a [f32],
    carried: &'a [f32],
    columns: Columns,
    states: Vec<&'a mut [f32]>,
}

impl<const G: usize> WithSimd for Forward<'_, G> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { kind, gates, candidate, carried, columns, mut states } = self;
        for t in 0..states.len() {
            let (earlier, now) = states.split_at_mut(t);
            let now = &mut *now[0];
            let length = now.len();
            let before = match earlier.last() {
                None => columns.of(carried, 0, length),
                Some(before) => before,
            };
            let candidate = columns.of(candidate, t, length);
            let first = columns.of(gates[0], t, length);
            let second = columns.of(gates[G - 1], t, length);
            zip(
                simd,
                [first, second, candidate, before],
                [now],
                #[inline(always)]
                |[first, second, candidate, before], _| {
                    let [entering, _] = kind.entering(simd, candidate);
                    let first = sigmoid(simd, first);
                    if G == 1 {
                        let change = simd.sub_f32s(entering, before);
                        return [simd.mul_add_e_f32s(first, change, before)];
                    }
                    let input = sigmoid(simd, second);
                    if !kind.normalize {
                        return [simd.mul_add_e_f32s(
                            first,
                            before,
                            simd.mul_f32s(input, entering),
                        )];
                    }
                    let sum = simd.add_f32s(first, input);
                    let sum = simd.add_f32s(sum, simd.splat_f32s(LEAST_SUM));
                    let change = simd.sub_f32s(entering, before);
                    [simd.mul_add_e_f32s(simd.div_f32s(input, sum), change, before)]
                },
            );
        }
    }
}

struct Backward<'a, const G: usize> {
    kind: Minimal,
    gates: [&'a [f32]; G],
    candidate: &'a [f32],
    carried: &'a [f32],
    states: &'a [f32],
    gradient: &'a [f32],
    columns: Columns,
    /// Gate by gate, frame by frame.
    by_gates: Vec<Vec<&'a mut [f32]>>,
    by_candidate: Vec<&'a mut [f32]>,
    by_carried: &'a mut [f32],
}

impl<const G: usize> WithSimd for Backward<'_, G> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { kind, gates, candidate, carried, states, gradient, columns, .. } = self;
        let (mut by_gates, mut by_candidate) = (self.by_gates, self.by_candidate);
        // The gradient by the state after the frame at hand, through all later frames.
        let later = self.by_carried;
        let length = later.len();
        let one = simd.splat_f32s(1.0);
        for t in (0..by_candidate.len()).rev() {
            let before = match t {
                0 => columns.of(carried, 0, length),
                _ => columns.of(states, t - 1, length),
            };
            let inputs = [
                columns.of(gates[0], t, length),
                columns.of(gates[G - 1], t, length),
                columns.of(candidate, t, length),
                before,
                columns.of(gradient, t, length),
            ];
            let (first_gates, second_gates) = by_gates.split_at_mut(1);
            let by_first = &mut *first_gates[0][t];
            let by_candidate = &mut *by_candidate[t];
            if G == 1 {
                zip(
                    simd,
                    inputs,
                    [&mut *later, by_first, by_candidate],
                    #[inline(always)]
                    |[gate, _, candidate, before, gradient], [later, _, _]| {
                        let [entering, slope] = kind.entering(simd, candidate);
                        let update = sigmoid(simd, gate);
                        let by_state = simd.add_f32s(later, gradient);
                        let kept = simd.sub_f32s(one, update);
                        let by_update = simd.mul_f32s(by_state, simd.sub_f32s(entering, before));
                        let by_entering = simd.mul_f32s(by_state, update);
                        [
                            simd.mul_f32s(by_state, kept),
                            simd.mul_f32s(by_update, simd.mul_f32s(update, kept)),
                            simd.mul_f32s(by_entering, slope),
                        ]
                    },
                );
                continue;
            }
            let by_second = &mut *second_gates[0][t];
            zip(
                simd,
                inputs,
                [&mut *later, by_first, by_second, by_candidate],
                #[inline(always)]
                |[forget, input, candidate, before, gradient], [later, _, _, _]| {
                    let [entering, slope] = kind.entering(simd, candidate);
                    let forget = sigmoid(simd, forget);
                    let input = sigmoid(simd, input);
                    let by_state = simd.add_f32s(later, gradient);
                    let forget_slope = simd.mul_f32s(forget, simd.sub_f32s(one, forget));
                    let input_slope = simd.mul_f32s(input, simd.sub_f32s(one, input));
                    if !kind.normalize {
                        let by_forget = simd.mul_f32s(by_state, before);
                        let by_input = simd.mul_f32s(by_state, entering);
                        let by_entering = simd.mul_f32s(by_state, input);
                        return [
                            simd.mul_f32s(by_state, forget),
                            simd.mul_f32s(by_forget, forget_slope),
                            simd.mul_f32s(by_input, input_slope),
                            simd.mul_f32s(by_entering, slope),
                        ];
                    }
                    let sum = simd.add_f32s(forget, input);
                    let inverse =
                        simd.div_f32s(one, simd.add_f32s(sum, simd.splat_f32s(LEAST_SUM)));
                    let share = simd.mul_f32s(input, inverse);
                    let kept = simd.sub_f32s(one, share);
                    let change = simd.sub_f32s(entering, before);
                    // The share i / (f + i) grows with i by (1 - share) / (f + i), with f by -share / (f + i).
                    let by_share = simd.mul_f32s(simd.mul_f32s(by_state, change), inverse);
                    let by_forget = simd.neg_f32s(simd.mul_f32s(by_share, share));
                    let by_input = simd.mul_f32s(by_share, kept);
                    let by_entering = simd.mul_f32s(by_state, share);
                    [
                        simd.mul_f32s(by_state, kept),
                        simd.mul_f32s(by_forget, forget_slope),
                        simd.mul_f32s(by_input, input_slope),
                        simd.mul_f32s(by_entering, slope),
                    ]
                },
            );
        }
    }
}
