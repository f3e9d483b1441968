//! minGRU and minLSTM over all frames: states from the outputs of their linear layers, and gradients, in one pass over
//! memory each. Columns are independent, so that each thread processes a strip of them frame by frame. `model/scan.rs` of
//! `eddy-learning` computes the same with tensor operations.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::{
    math::{positive, sigmoid},
    vectors::{strips, zip},
};

/// Columns per task.
const STRIP: usize = 512;

/// The variant of the recurrence. The M columns are rows times width of the state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Minimal {
    /// Whether the candidate c enters as g(c) = c + 1/2 for c >= 0 and sigmoid(c) below: the log form.
    pub log: bool,
    /// minLSTM: whether f and i are divided by their sum.
    pub normalize: bool,
}

/// Gradients of the recurrence, `[T, M]` except for `initial`.
#[derive(Clone, Debug)]
pub struct Gradients<const G: usize> {
    /// By the linear output of each gate.
    pub gates: [Vec<f32>; G],
    /// By the linear output of the candidate.
    pub candidate: Vec<f32>,
    /// By the state before the first frame, `[M]`.
    pub initial: Vec<f32>,
}

impl Minimal {
    /// The states, `[T, M]`, from the linear outputs of the gates (update; or forget, input) and of the candidate, `[T, M]`
    /// each, and the state before the first frame, `[M]`.
    pub fn forward<const G: usize>(
        self,
        gates: [&[f32]; G],
        candidate: &[f32],
        initial: &[f32],
    ) -> Vec<f32> {
        let width = initial.len();
        let mut states = vec![0.0; candidate.len()];
        strips(&mut states, width, STRIP).into_par_iter().enumerate().for_each(
            |(strip, states)| {
                let columns = Columns { start: strip * STRIP, width };
                Arch::new().dispatch(Forward {
                    kind: self,
                    gates,
                    candidate,
                    initial,
                    columns,
                    states,
                });
            },
        );
        states
    }

    /// The gradients from `gradient`, that by the states, `[T, M]`.
    pub fn backward<const G: usize>(
        self,
        gates: [&[f32]; G],
        candidate: &[f32],
        initial: &[f32],
        states: &[f32],
        gradient: &[f32],
    ) -> Gradients<G> {
        let width = initial.len();
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
                    initial,
                    states,
                    gradient,
                    columns,
                    by_gates,
                    by_candidate,
                    by_carried,
                });
            });
        Gradients { gates: by_gates, candidate: by_candidate, initial: by_carried }
    }

    /// The candidate as it enters the state, and its derivative.
    #[inline(always)]
    fn candidate<S: Simd>(self, simd: S, candidate: S::f32s) -> [S::f32s; 2] {
        let one = simd.splat_f32s(1.0);
        if !self.log {
            return [candidate, one];
        }
        let value = positive(simd, candidate);
        let above = simd.greater_than_f32s(candidate, simd.splat_f32s(0.0));
        let below = simd.mul_f32s(value, simd.sub_f32s(one, value)); // of a sigmoid
        [value, simd.select_f32s(above, one, below)]
    }

    /// The new state from the sums of the gates and of the candidate, in the order of the checkpoint, and the last state: minGRU's
    /// (1 - z) h + z c, minLSTM's f h + i c, or (1 - u) h + u c with u = i / (f + i).
    #[inline(always)]
    pub(crate) fn next<S: Simd, const G: usize>(
        self,
        simd: S,
        sums: [S::f32s; G],
        last: S::f32s,
    ) -> S::f32s {
        let one = simd.splat_f32s(1.0);
        let (kept, update, candidate) = match *sums.as_slice() {
            [gate, candidate] => {
                let update = sigmoid(simd, gate);
                (simd.sub_f32s(one, update), update, candidate)
            }
            [forget, input, candidate] => {
                let (forget, input) = (sigmoid(simd, forget), sigmoid(simd, input));
                if self.normalize {
                    let sum =
                        simd.add_f32s(simd.add_f32s(forget, input), simd.splat_f32s(MIN_GATE_SUM));
                    let update = simd.div_f32s(input, sum);
                    (simd.sub_f32s(one, update), update, candidate)
                } else {
                    (forget, input, candidate)
                }
            }
            _ => unreachable!("minGRU has two gates, minLSTM three"),
        };
        let [candidate, _] = self.candidate(simd, candidate);
        simd.mul_add_e_f32s(kept, last, simd.mul_f32s(update, candidate))
    }

    /// minGRU: the gradients by the previous state, the gate and the candidate, from that by the state.
    #[inline(always)]
    fn mingru_gradients<S: Simd>(
        self,
        simd: S,
        [gate, c, before]: [S::f32s; 3],
        by_state: S::f32s,
    ) -> [S::f32s; 3] {
        let [candidate, derivative] = self.candidate(simd, c);
        let update = sigmoid(simd, gate);
        let kept = simd.sub_f32s(simd.splat_f32s(1.0), update);
        let by_update = simd.mul_f32s(by_state, simd.sub_f32s(candidate, before));
        let by_candidate = simd.mul_f32s(by_state, update);
        [
            simd.mul_f32s(by_state, kept),
            simd.mul_f32s(by_update, simd.mul_f32s(update, kept)),
            simd.mul_f32s(by_candidate, derivative),
        ]
    }

    /// minLSTM: the gradients by the previous state, both gates and the candidate, from that by the state.
    #[inline(always)]
    fn minlstm_gradients<S: Simd>(
        self,
        simd: S,
        [forget, input, c, before]: [S::f32s; 4],
        by_state: S::f32s,
    ) -> [S::f32s; 4] {
        let one = simd.splat_f32s(1.0);
        let [candidate, derivative] = self.candidate(simd, c);
        let (forget, input) = (sigmoid(simd, forget), sigmoid(simd, input));
        let forget_slope = simd.mul_f32s(forget, simd.sub_f32s(one, forget));
        let input_slope = simd.mul_f32s(input, simd.sub_f32s(one, input));
        let (by_before, by_forget, by_input, by_candidate);
        if self.normalize {
            let sum = simd.add_f32s(forget, input);
            let inverse = simd.div_f32s(one, simd.add_f32s(sum, simd.splat_f32s(MIN_GATE_SUM)));
            let share = simd.mul_f32s(input, inverse);
            let kept = simd.sub_f32s(one, share);
            let change = simd.sub_f32s(candidate, before);
            // The derivatives of the share i / (f + i) are (1 - share) / (f + i) by i and -share / (f + i) by f.
            let by_share = simd.mul_f32s(simd.mul_f32s(by_state, change), inverse);
            by_before = simd.mul_f32s(by_state, kept);
            by_forget = simd.neg_f32s(simd.mul_f32s(by_share, share));
            by_input = simd.mul_f32s(by_share, kept);
            by_candidate = simd.mul_f32s(by_state, share);
        } else {
            by_before = simd.mul_f32s(by_state, forget);
            by_forget = simd.mul_f32s(by_state, before);
            by_input = simd.mul_f32s(by_state, candidate);
            by_candidate = simd.mul_f32s(by_state, input);
        }
        [
            by_before,
            simd.mul_f32s(by_forget, forget_slope),
            simd.mul_f32s(by_input, input_slope),
            simd.mul_f32s(by_candidate, derivative),
        ]
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

/// Added to f + i, which is zero in f32 if both gates are closed.
pub const MIN_GATE_SUM: f32 = 1e-12;

struct Forward<'a, const G: usize> {
    kind: Minimal,
    gates: [&'a [f32]; G],
    candidate: &'a [f32],
    initial: &'a [f32],
    columns: Columns,
    states: Vec<&'a mut [f32]>,
}

impl<const G: usize> WithSimd for Forward<'_, G> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { kind, gates, candidate, initial, columns, mut states } = self;
        for t in 0..states.len() {
            let (earlier, now) = states.split_at_mut(t);
            let now = &mut *now[0];
            let length = now.len();
            let before = match earlier.last() {
                None => columns.of(initial, 0, length),
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
                    [match G {
                        1 => kind.next(simd, [first, candidate], before),
                        _ => kind.next(simd, [first, second, candidate], before),
                    }]
                },
            );
        }
    }
}

struct Backward<'a, const G: usize> {
    kind: Minimal,
    gates: [&'a [f32]; G],
    candidate: &'a [f32],
    initial: &'a [f32],
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
        let Self { kind, gates, candidate, initial, states, gradient, columns, .. } = self;
        let (mut by_gates, mut by_candidate) = (self.by_gates, self.by_candidate);
        // The gradient by the current frame's state through all later frames.
        let later = self.by_carried;
        let length = later.len();
        for t in (0..by_candidate.len()).rev() {
            let before = match t {
                0 => columns.of(initial, 0, length),
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
                        let by_state = simd.add_f32s(later, gradient);
                        kind.mingru_gradients(simd, [gate, candidate, before], by_state)
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
                    let by_state = simd.add_f32s(later, gradient);
                    kind.minlstm_gradients(simd, [forget, input, candidate, before], by_state)
                },
            );
        }
    }
}
