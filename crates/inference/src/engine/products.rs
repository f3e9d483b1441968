//! Linear layers for some rows at a time: where the rows come from, and where the sums go.
//!
//! R rows of G panels stay in registers. How rows are taken together does not change their sums.
#![expect(unsafe_code, reason = "reads without bounds checks in the innermost loop")]

use std::ops::Range;

use pulp::Simd;

use super::linear::{Linear, add_products, store};
use crate::kernels::math::relu;

/// Where the inputs of a layer's rows are.
pub(super) trait Source {
    /// Adds to `sums` the products of R rows from number `first` on with G panels; the last of `count`
    /// rows again where there are no more.
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

/// Where the outputs go.
pub(super) trait Sink {
    /// Takes some outputs of a row, a whole vector.
    fn put<S: Simd>(&mut self, simd: S, row: usize, outputs: Range<usize>, sums: S::f32s);
}

/// `count` rows through a layer.
#[inline(always)]
pub(super) fn pass<S: Simd>(
    simd: S,
    linear: &Linear,
    count: usize,
    source: &impl Source,
    sink: &mut impl Sink,
) {
    if S::REGISTER_COUNT >= 32 {
        pass_rows::<S, 12, 4>(simd, linear, count, source, sink);
    } else {
        pass_rows::<S, 6, 2>(simd, linear, count, source, sink);
    }
}

/// R rows at a time, and Q of those that are left.
#[inline(always)]
fn pass_rows<S: Simd, const R: usize, const Q: usize>(
    simd: S,
    linear: &Linear,
    count: usize,
    source: &impl Source,
    sink: &mut impl Sink,
) {
    let mut panel = 0;
    while panel < linear.panels() {
        let two = panel + 1 < linear.panels();
        let mut first = 0;
        while first < count {
            let many = count - first >= R;
            match (two, many) {
                (true, true) => {
                    some::<S, 2, R>(simd, linear, [panel, panel + 1], first, count, source, sink);
                }
                (true, false) => {
                    some::<S, 2, Q>(simd, linear, [panel, panel + 1], first, count, source, sink);
                }
                (false, true) => some::<S, 1, R>(simd, linear, [panel], first, count, source, sink),
                (false, false) => {
                    some::<S, 1, Q>(simd, linear, [panel], first, count, source, sink)
                }
            }
            first += if many { R } else { Q };
        }
        panel += if two { 2 } else { 1 };
    }
}

/// G panels of R rows.
#[inline(always)]
fn some<S: Simd, const G: usize, const R: usize>(
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
        let outputs = linear.places(panels[g]);
        for (row, &sums) in (first..count).zip(&sums[g]) {
            sink.put(simd, row, outputs.clone(), sums);
        }
    }
}

/// Adds the products of R rows with the weights of G panels to the inputs with these numbers.
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

/// Rows that lie one after the other.
#[derive(Clone, Copy)]
pub(super) struct Rows<'a> {
    /// `[.., width]`.
    pub(super) numbers: &'a [f32],
    /// Length of a row: as many as the layer has inputs, or more.
    pub(super) width: usize,
}

impl<'a> Rows<'a> {
    #[inline(always)]
    fn row(&self, row: usize) -> &'a [f32] {
        &self.numbers[row * self.width..(row + 1) * self.width]
    }

    /// R rows from number `first` on.
    #[inline(always)]
    pub(super) fn some<const R: usize>(&self, first: usize, count: usize) -> [&'a [f32]; R] {
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
        add_part(simd, linear, panels, 0..linear.input(), self.some::<R>(first, count), sums)
    }
}

/// Rows of a block that lie beside each other, number by number.
#[derive(Clone, Copy)]
pub(super) struct Columns<'a> {
    /// `[width, LENGTH]`, in the places of rows that there are not anything.
    pub(super) numbers: &'a [f32],
    pub(super) width: usize,
    pub(super) length: usize,
}

impl Columns<'_> {
    /// Adds the products of R rows with the weights of the first inputs.
    #[inline(always)]
    fn add_first<S: Simd, const G: usize, const R: usize>(
        &self,
        simd: S,
        linear: &Linear,
        panels: [usize; G],
        first: usize,
        mut sums: [[S::f32s; R]; G],
    ) -> [[S::f32s; R]; G] {
        let mut weights = [[].as_slice(); G];
        for g in 0..G {
            weights[g] = S::as_simd_f32s(linear.inputs(panels[g], 0..self.width)).0;
        }
        assert!(weights.iter().all(|weights| weights.len() == self.width));
        assert!(first + R <= self.length && self.numbers.len() == self.width * self.length);
        for k in 0..self.width {
            // SAFETY: as asserted, k being below the width.
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

impl Source for Columns<'_> {
    #[inline(always)]
    fn add<S: Simd, const G: usize, const R: usize>(
        &self,
        simd: S,
        linear: &Linear,
        panels: [usize; G],
        first: usize,
        _: usize,
        sums: [[S::f32s; R]; G],
    ) -> [[S::f32s; R]; G] {
        self.add_first(simd, linear, panels, first, sums)
    }
}

/// Two parts of a row side by side.
pub(super) struct Beside<'a>(pub(super) Columns<'a>, pub(super) Rows<'a>);

impl Source for Beside<'_> {
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
        let Self(left, right) = self;
        let sums = left.add_first(simd, linear, panels, first, sums);
        let inputs = left.width..linear.input();
        add_part(simd, linear, panels, inputs, right.some::<R>(first, count), sums)
    }
}

/// K rows side by side, which a table names. A row that is missing is left out.
pub(super) struct Gathered<'a, const K: usize> {
    pub(super) table: &'a [[u32; K]],
    /// All rows; the one behind the last named is zero.
    pub(super) rows: Rows<'a>,
    /// Number of the zero row.
    pub(super) zero: usize,
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
                // What is missing has a number beyond all.
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

/// Rows that lie one after the other, after ReLU if `rectify`.
pub(super) struct Output<'a> {
    /// `[.., width]`.
    pub(super) numbers: &'a mut [f32],
    pub(super) width: usize,
    pub(super) rectify: bool,
}

impl Sink for Output<'_> {
    #[inline(always)]
    fn put<S: Simd>(&mut self, simd: S, row: usize, outputs: Range<usize>, sums: S::f32s) {
        let sums = if self.rectify { relu(simd, sums) } else { sums };
        let first = row * self.width;
        store(simd, &mut self.numbers[first + outputs.start..first + outputs.end], sums);
    }
}
