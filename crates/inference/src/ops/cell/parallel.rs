//! Cells whose sums do not depend on the state, over all frames in one pass over memory: states, and gradients. Columns are
//! independent, so that each thread processes a strip of them frame by frame. The M columns are rows times width of the
//! state.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::{Cell, MAX_SUMS};
use crate::kernels::vectors::{lanes, load, store, strips};

/// Columns per task.
const STRIP: usize = 512;

/// The states, `[T, M]`, from the sums of each gate, `[T, M]`, and the state before the first frame, `[M]`.
pub fn forward<C: Cell>(cell: C, sums: &[&[f32]], initial: &[f32]) -> Vec<f32> {
    let width = initial.len();
    let mut states = vec![0.0; sums[0].len()];
    strips(&mut states, width, STRIP).into_par_iter().enumerate().for_each(|(strip, states)| {
        let columns = Columns { start: strip * STRIP, width };
        Arch::new().dispatch(Forward { cell, sums, initial, columns, states });
    });
    states
}

/// The gradients by the sums of each gate, `[T, M]`, and at last by the state before the first frame, `[M]`, from
/// `gradient`, that by the states, `[T, M]`. `states` are the result of [`forward`].
pub fn backward<C: Cell>(
    cell: C,
    sums: &[&[f32]],
    initial: &[f32],
    states: &[f32],
    gradient: &[f32],
) -> Vec<Vec<f32>> {
    let width = initial.len();
    let mut by_sums: Vec<_> = sums.iter().map(|sums| vec![0.0; sums.len()]).collect();
    let mut by_state = vec![0.0; width];
    let mut by_strips: Vec<Vec<_>> = Vec::new();
    by_strips.resize_with(width.div_ceil(STRIP), Vec::new);
    for by_gate in &mut by_sums {
        for (all, strip) in by_strips.iter_mut().zip(strips(by_gate, width, STRIP)) {
            all.push(strip);
        }
    }
    by_strips.into_par_iter().zip(by_state.par_chunks_mut(STRIP)).enumerate().for_each(
        |(strip, (by_sums, by_state))| {
            let columns = Columns { start: strip * STRIP, width };
            Arch::new().dispatch(Backward {
                cell,
                sums,
                initial,
                states,
                gradient,
                columns,
                by_sums,
                by_state,
            });
        },
    );
    by_sums.push(by_state);
    by_sums
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

    /// The strip of frame `t` of the sums of all gates.
    #[inline(always)]
    fn of_all<'a>(self, sums: &[&'a [f32]], t: usize, length: usize) -> [&'a [f32]; MAX_SUMS] {
        let mut all = [[].as_slice(); MAX_SUMS];
        for (own, sums) in all.iter_mut().zip(sums) {
            *own = self.of(sums, t, length);
        }
        all
    }
}

struct Forward<'a, C> {
    cell: C,
    sums: &'a [&'a [f32]],
    initial: &'a [f32],
    columns: Columns,
    states: Vec<&'a mut [f32]>,
}

impl<C: Cell> WithSimd for Forward<'_, C> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { cell, sums, initial, columns, mut states } = self;
        let gates = const { C::CORE.gates() };
        for t in 0..states.len() {
            let (earlier, now) = states.split_at_mut(t);
            let now = &mut *now[0];
            let length = now.len();
            let before = match earlier.last() {
                None => columns.of(initial, 0, length),
                Some(before) => before,
            };
            let sums = columns.of_all(sums, t, length);
            for vector in 0..length.div_ceil(S::F32_LANES) {
                let units = || lanes::<S>(0, vector, length);
                let mut own = [simd.splat_f32s(0.0); MAX_SUMS];
                for gate in 0..gates {
                    own[gate] = load(simd, sums[gate], units());
                }
                let mut state = [load(simd, before, units()), simd.splat_f32s(0.0)];
                cell.next(simd, &mut own[..gates], &mut state);
                store(simd, now, units(), state[0]);
            }
        }
    }
}

struct Backward<'a, C> {
    cell: C,
    sums: &'a [&'a [f32]],
    initial: &'a [f32],
    states: &'a [f32],
    /// By the states.
    gradient: &'a [f32],
    columns: Columns,
    /// Gate by gate, frame by frame.
    by_sums: Vec<Vec<&'a mut [f32]>>,
    /// By the current frame's state through all later frames.
    by_state: &'a mut [f32],
}

impl<C: Cell> WithSimd for Backward<'_, C> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { cell, sums, initial, states, gradient, columns, .. } = self;
        let (mut by_sums, by_state) = (self.by_sums, self.by_state);
        let gates = const { C::CORE.gates() };
        let length = by_state.len();
        for t in (0..by_sums[0].len()).rev() {
            let last = match t {
                0 => columns.of(initial, 0, length),
                _ => columns.of(states, t - 1, length),
            };
            let [new, gradient] = [states, gradient].map(|all| columns.of(all, t, length));
            let sums = columns.of_all(sums, t, length);
            for vector in 0..length.div_ceil(S::F32_LANES) {
                let units = || lanes::<S>(0, vector, length);
                let (zero, read) = (simd.splat_f32s(0.0), |list| load(simd, list, units()));
                let mut own = [zero; MAX_SUMS];
                for gate in 0..gates {
                    own[gate] = read(sums[gate]);
                }
                let mut by = [simd.add_f32s(read(by_state), read(gradient)), zero];
                cell.gradient(
                    simd,
                    &mut own[..gates],
                    [read(last), zero],
                    [read(new), zero],
                    &mut by,
                );
                for gate in 0..gates {
                    store(simd, by_sums[gate][t], units(), own[gate]);
                }
                store(simd, by_state, units(), by[0]);
            }
        }
    }
}
