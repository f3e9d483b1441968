//! Rows times a matrix.
//!
//! The sums of a few rows and up to three vectors of columns stay in registers.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::{BlockBuffer, Panels, Rows};
use crate::kernels::{
    math::relu,
    vectors::{lanes, load, store},
};

/// Rows per task.
const CHUNK: usize = 1 << 10;

/// Initial values of the sums.
#[derive(Clone, Copy)]
enum Start<'a> {
    /// Their previous values.
    Sums,
    /// The same numbers in each row.
    Bias(&'a [f32]),
    Zero,
}

/// The products of the rows, `[M, I]`, with the matrix, `[I, O]`, plus the bias, if any: `[M, O]`. Applies ReLU if `rectify`.
pub fn products(rows: Rows, matrix: &Panels, bias: Option<&[f32]>, rectify: bool) -> Vec<f32> {
    let [_, columns] = matrix.shape();
    let mut sums = vec![0.0; rows.len() * columns];
    let start = bias.map_or(Start::Zero, Start::Bias);
    compute(rows, matrix, start, rectify, &mut sums);
    sums
}

/// Adds the products of the rows, `[M, I]`, with the matrix, `[I, O]`, to the sums, `[M, O]`. Applies ReLU if `rectify`.
pub fn add_products(rows: Rows, matrix: &Panels, rectify: bool, sums: &mut [f32]) {
    compute(rows, matrix, Start::Sums, rectify, sums);
}

fn compute(rows: Rows, matrix: &Panels, start: Start, rectify: bool, sums: &mut [f32]) {
    let [inner, columns] = matrix.shape();
    assert_eq!((rows.columns(), rows.len() * columns), (inner, sums.len()), "shapes");
    let missing = vec![0.0; rows.width];
    let missing = missing.as_slice();
    sums.par_chunks_mut(CHUNK * columns).enumerate().for_each(|(chunk, sums)| {
        let first = chunk * CHUNK;
        Arch::new().dispatch(Products {
            rows,
            first,
            missing,
            matrix,
            start,
            rectify,
            sums,
            buffer: BlockBuffer::new(),
        });
    });
}

struct Products<'a> {
    rows: Rows<'a>,
    /// The row of the first sums.
    first: usize,
    /// A list of zeros.
    missing: &'a [f32],
    matrix: &'a Panels,
    start: Start<'a>,
    rectify: bool,
    sums: &'a mut [f32],
    buffer: BlockBuffer,
}

impl WithSimd for Products<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let vectors = self.matrix.shape()[1].div_ceil(S::F32_LANES);
        let mut vector = 0;
        while vector < vectors {
            match vectors - vector {
                1 => self.pass::<S, 1>(simd, vector),
                2 | 4 => self.pass::<S, 2>(simd, vector),
                _ => self.pass::<S, 3>(simd, vector),
            }
            vector += match vectors - vector {
                1 => 1,
                2 | 4 => 2,
                _ => 3,
            };
        }
    }
}

impl Products<'_> {
    /// G vectors of columns from `vector` on.
    #[inline(always)]
    fn pass<S: Simd, const G: usize>(&mut self, simd: S, vector: usize) {
        if const { S::REGISTER_COUNT >= 32 } {
            self.rows::<S, 8, G>(simd, vector);
        } else {
            self.rows::<S, 4, G>(simd, vector);
        }
    }

    #[inline(always)]
    fn rows<S: Simd, const R: usize, const G: usize>(&mut self, simd: S, vector: usize) {
        let count = self.sums.len() / self.matrix.shape()[1];
        for row in (0..count).step_by(R) {
            self.block::<S, R, G>(simd, vector, row, count);
        }
    }

    /// R rows from `row` on; beyond `count` rows, the last one is repeated.
    #[inline(always)]
    fn block<S: Simd, const R: usize, const G: usize>(
        &mut self,
        simd: S,
        vector: usize,
        row: usize,
        count: usize,
    ) {
        let [_, columns] = self.matrix.shape();
        let begun = self.buffer.vectors::<S>();
        for r in 0..R {
            for g in 0..G {
                begun[r * G + g] = match self.start {
                    Start::Sums => {
                        let row = (row + r).min(count - 1);
                        load(simd, self.sums, lanes::<S>(row, vector + g, columns))
                    }
                    Start::Bias(bias) => load(simd, bias, lanes::<S>(0, vector + g, columns)),
                    Start::Zero => simd.splat_f32s(0.0),
                };
            }
        }
        let sums = self.buffer.take::<S, R, G>(simd);
        let sums = self.add::<S, R, G>(simd, vector, row, count, sums);
        self.buffer.put::<S, R, G>(sums);
        // Stores whole vectors where possible: the excess lanes fall on the next row, which is written afterwards.
        let whole = vector == 0 && G * S::F32_LANES >= columns && row + R <= count;
        let sums = self.buffer.vectors::<S>().chunks_exact(G).take(R.min(count - row));
        for (r, sums) in sums.enumerate() {
            for (g, &sum) in sums.iter().enumerate() {
                let sum = if self.rectify { relu(simd, sum) } else { sum };
                let mut lanes = lanes::<S>(row + r, vector + g, columns);
                if whole && lanes.start + S::F32_LANES <= (row + R) * columns {
                    lanes.end = lanes.start + S::F32_LANES;
                }
                store(simd, self.sums, lanes, sum);
            }
        }
    }

    /// Adds the products.
    #[inline(always)]
    fn add<S: Simd, const R: usize, const G: usize>(
        &self,
        simd: S,
        vector: usize,
        row: usize,
        count: usize,
        mut sums: [[S::f32s; G]; R],
    ) -> [[S::f32s; G]; R] {
        let Self { rows, first, matrix, .. } = self;
        let missing = &self.missing[..rows.width];
        for place in 0..rows.places {
            let mut lists = [missing; R];
            let mut none = true;
            for (r, list) in lists.iter_mut().enumerate() {
                if let Some(found) = rows.list(first + (row + r).min(count - 1), place) {
                    *list = found;
                    none = false;
                }
            }
            if none {
                continue;
            }
            let mut panels = [[].as_slice(); G];
            for (g, panel) in panels.iter_mut().enumerate() {
                *panel = matrix.weights::<S>(vector + g, place * rows.width, rows.width);
            }
            for i in 0..rows.width {
                let mut weights = [simd.splat_f32s(0.0); G];
                for g in 0..G {
                    weights[g] = panels[g][i];
                }
                for r in 0..R {
                    let x = simd.splat_f32s(lists[r][i]);
                    for g in 0..G {
                        sums[r][g] = simd.mul_add_e_f32s(x, weights[g], sums[r][g]);
                    }
                }
            }
        }
        sums
    }
}
