//! Linear layers for blocks of rows: a [`Source`] of input rows and a [`Sink`] of outputs.
//!
//! The sums of R rows and G panels stay in registers. The grouping of rows does not change their sums.
#![expect(unsafe_code, reason = "reads without bounds checks in the innermost loop")]

use std::ops::Range;

use pulp::Simd;

use super::packed::{Linear, SplitLinear, add_products, load, store};
use crate::kernels::math::relu;

/// The inputs of a layer, row by row.
pub(crate) trait Source {
    /// Adds to `sums` the products of the R rows from `first` on with G panels. Beyond `count` rows, the last one is
    /// repeated.
    fn add<S: Simd, const G: usize, const R: usize>(
        &self,
        simd: S,
        linear: &Linear,
        panels: [usize; G],
        first: usize,
        count: usize,
        sums: [[S::f32s; R]; G],
    ) -> [[S::f32s; R]; G];
}

/// The outputs of a layer, row by row.
pub(crate) trait Sink {
    /// Receives a vector of a row's outputs.
    fn put<S: Simd>(&mut self, simd: S, row: usize, outputs: Range<usize>, sums: S::f32s);
}

/// Applies a layer to `count` rows. The condition is a constant block, so that code for other vectors is not even compiled.
#[inline(always)]
pub(crate) fn apply<S: Simd>(
    simd: S,
    linear: &SplitLinear,
    count: usize,
    source: &impl Source,
    sink: &mut impl Sink,
) {
    if const { S::REGISTER_COUNT >= 32 } {
        apply_rows::<S, 12, 4>(simd, &linear.whole, count, source, sink);
        // The code is part of a function for AVX-512, which has 32 registers of 256 bits as well.
        #[cfg(target_arch = "x86_64")]
        if let Some((simd, last)) = &linear.last {
            apply_rows::<_, 12, 4>(*simd, last, count, source, sink);
        }
    } else {
        apply_rows::<S, 6, 2>(simd, &linear.whole, count, source, sink);
    }
}

/// Pairs of panels, then the last one of an odd number; panels whose weights are all zero give their biases.
#[inline(always)]
fn apply_rows<S: Simd, const R: usize, const Q: usize>(
    simd: S,
    linear: &Linear,
    count: usize,
    source: &impl Source,
    sink: &mut impl Sink,
) {
    let computed = linear.computed_panels();
    for panel in computed..linear.panels() {
        let [bias] = linear.bias::<S, 1>(simd, panel);
        (0..count).for_each(
            #[inline(always)]
            |row| sink.put(simd, row, linear.padded_outputs(panel), bias),
        );
    }
    let mut panel = 0;
    while panel + 1 < computed {
        apply_panels::<S, 2, R, Q>(simd, linear, [panel, panel + 1], count, source, sink);
        panel += 2;
    }
    if panel < computed {
        apply_panels::<S, 1, R, Q>(simd, linear, [panel], count, source, sink);
    }
}

/// G panels for all rows: blocks of R rows, then of Q rows for the rest.
#[inline(always)]
fn apply_panels<S: Simd, const G: usize, const R: usize, const Q: usize>(
    simd: S,
    linear: &Linear,
    panels: [usize; G],
    count: usize,
    source: &impl Source,
    sink: &mut impl Sink,
) {
    let mut first = 0;
    while count - first >= R {
        apply_block::<S, G, R>(simd, linear, panels, first, count, source, sink);
        first += R;
    }
    while first < count {
        apply_block::<S, G, Q>(simd, linear, panels, first, count, source, sink);
        first += Q;
    }
}

/// A block of R rows and G panels.
#[inline(always)]
fn apply_block<S: Simd, const G: usize, const R: usize>(
    simd: S,
    linear: &Linear,
    panels: [usize; G],
    first: usize,
    count: usize,
    source: &impl Source,
    sink: &mut impl Sink,
) {
    let mut sums = [[simd.splat_f32s(0.0); R]; G];
    for g in 0..G {
        sums[g] = linear.bias(simd, panels[g]);
    }
    let sums = source.add::<S, G, R>(simd, linear, panels, first, count, sums);
    for g in 0..G {
        let outputs = linear.padded_outputs(panels[g]);
        for (row, &sums) in (first..count).zip(&sums[g]) {
            sink.put(simd, row, outputs.clone(), sums);
        }
    }
}

/// Adds the products of R rows with the weights of G panels for a range of inputs.
#[inline(always)]
fn add_part<S: Simd, const G: usize, const R: usize>(
    simd: S,
    linear: &Linear,
    panels: [usize; G],
    inputs: Range<usize>,
    rows: [&[f32]; R],
    sums: [[S::f32s; R]; G],
) -> [[S::f32s; R]; G] {
    let mut weights = [[].as_slice(); G];
    for g in 0..G {
        weights[g] = linear.inputs(panels[g], inputs.clone());
    }
    add_products::<S, G, R, 1>(simd, weights, rows, sums)
}

/// Contiguous rows.
#[derive(Clone, Copy)]
pub(crate) struct Rows<'a> {
    /// `[.., width]`.
    pub(crate) numbers: &'a [f32],
    /// Length of a row: the number of inputs, or more.
    pub(crate) width: usize,
}

impl<'a> Rows<'a> {
    #[inline(always)]
    fn row(&self, row: usize) -> &'a [f32] {
        &self.numbers[row * self.width..(row + 1) * self.width]
    }

    /// The R rows from `first` on; beyond `count` rows, the last one is repeated.
    #[inline(always)]
    pub(crate) fn block<const R: usize>(&self, first: usize, count: usize) -> [&'a [f32]; R] {
        let mut rows = [[].as_slice(); R];
        for (r, row) in rows.iter_mut().enumerate() {
            *row = self.row((first + r).min(count - 1));
        }
        rows
    }
}

impl Source for Rows<'_> {
    #[inline(always)]
    fn add<S: Simd, const G: usize, const R: usize>(
        &self,
        simd: S,
        linear: &Linear,
        panels: [usize; G],
        first: usize,
        count: usize,
        sums: [[S::f32s; R]; G],
    ) -> [[S::f32s; R]; G] {
        add_part(simd, linear, panels, 0..linear.input(), self.block::<R>(first, count), sums)
    }
}

/// The rows of a block in column-major order.
pub(crate) struct Columns<'a> {
    /// `[inputs, length]`; the values of missing rows are arbitrary.
    pub(crate) numbers: &'a [f32],
    pub(crate) length: usize,
}

impl Source for Columns<'_> {
    #[inline(always)]
    fn add<S: Simd, const G: usize, const R: usize>(
        &self,
        simd: S,
        linear: &Linear,
        panels: [usize; G],
        first: usize,
        _: usize,
        mut sums: [[S::f32s; R]; G],
    ) -> [[S::f32s; R]; G] {
        let mut weights = [[].as_slice(); G];
        for g in 0..G {
            weights[g] = S::as_simd_f32s(linear.panel(panels[g])).0;
        }
        let inputs = linear.input();
        assert!(weights.iter().all(|weights| weights.len() == inputs));
        assert!(first + R <= self.length && self.numbers.len() == inputs * self.length);
        for k in 0..inputs {
            // SAFETY: k is less than the number of inputs, which was compared with the lengths above.
            let (weights, numbers) = unsafe {
                let first = k * self.length + first;
                (
                    weights.map(|weights| *weights.get_unchecked(k)),
                    self.numbers.get_unchecked(first..first + R),
                )
            };
            for r in 0..R {
                let number = simd.splat_f32s(numbers[r]);
                for g in 0..G {
                    sums[g][r] = simd.mul_add_e_f32s(weights[g], number, sums[g][r]);
                }
            }
        }
        sums
    }
}

/// Rows of K concatenated rows that a table selects. Missing rows count as zeros.
pub(crate) struct Gathered<'a, const K: usize> {
    pub(crate) table: &'a [[u32; K]],
    /// All rows, and a zero row behind them.
    pub(crate) rows: Rows<'a>,
    /// Index of the zero row.
    pub(crate) zero: usize,
}

impl<const K: usize> Source for Gathered<'_, K> {
    #[inline(always)]
    fn add<S: Simd, const G: usize, const R: usize>(
        &self,
        simd: S,
        linear: &Linear,
        panels: [usize; G],
        first: usize,
        count: usize,
        mut sums: [[S::f32s; R]; G],
    ) -> [[S::f32s; R]; G] {
        let width = linear.input() / K;
        for k in 0..K {
            let mut rows = [[].as_slice(); R];
            let mut none = true;
            for (r, numbers) in rows.iter_mut().enumerate() {
                // The index of a missing row is larger than all others.
                let row = (self.table[(first + r).min(count - 1)][k] as usize).min(self.zero);
                none &= row == self.zero;
                *numbers = self.rows.row(row);
            }
            if !none {
                sums = add_part(simd, linear, panels, k * width..(k + 1) * width, rows, sums);
            }
        }
        sums
    }
}

/// Contiguous rows, with ReLU if `rectify`.
pub(crate) struct Output<'a> {
    /// `[.., width]`.
    pub(crate) numbers: &'a mut [f32],
    pub(crate) width: usize,
    pub(crate) rectify: bool,
}

impl Sink for Output<'_> {
    #[inline(always)]
    fn put<S: Simd>(&mut self, simd: S, row: usize, outputs: Range<usize>, sums: S::f32s) {
        let sums = if self.rectify { relu(simd, sums) } else { sums };
        let first = row * self.width;
        store(simd, &mut self.numbers[first + outputs.start..first + outputs.end], sums);
    }
}

/// Contiguous rows, ReLU of the sum with other rows.
pub(crate) struct Sum<'a> {
    /// `[.., width]`.
    pub(crate) numbers: &'a mut [f32],
    pub(crate) width: usize,
    pub(crate) added: Rows<'a>,
}

impl Sink for Sum<'_> {
    #[inline(always)]
    fn put<S: Simd>(&mut self, simd: S, row: usize, outputs: Range<usize>, sums: S::f32s) {
        let first = row * self.width;
        let sums = simd.add_f32s(load(simd, &self.added.row(row)[outputs.clone()]), sums);
        let own = &mut self.numbers[first + outputs.start..first + outputs.end];
        store(simd, own, relu(simd, sums));
    }
}
