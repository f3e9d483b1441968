//! The gradient by the matrix: the sum over rows of the outer product of each row with its gradient.
//!
//! A block of the sum stays in registers over a chunk of rows.

use std::ops::Range;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::{BlockBuffer, Rows};
use crate::kernels::vectors::{lanes, load, store};

/// Rows per partial sum.
const PART: usize = 1 << 10;
/// Rows per chunk: they stay in the nearest caches.
const CHUNK: usize = 1 << 8;
/// Inputs per block.
const BLOCK: usize = 8;

/// The gradient by the matrix, `[I, O]`, from its input rows, `[M, I]`, and the gradient of the products, `[M, O]`.
pub fn matrix_gradient(rows: Rows, gradient: &[f32], outputs: usize) -> Vec<f32> {
    assert_eq!(gradient.len(), rows.len() * outputs, "shapes");
    let size = rows.columns() * outputs;
    let mut sums = vec![0.0; rows.len().div_ceil(PART).max(1) * size];
    let parts = sums.par_chunks_exact_mut(size).zip(gradient.par_chunks(PART * outputs));
    parts.enumerate().for_each(|(part, (sums, gradient))| {
        Arch::new().dispatch(MatrixGradient {
            rows,
            first: part * PART,
            gradient,
            outputs,
            sums,
            buffer: BlockBuffer::new(),
        });
    });
    let (whole, parts) = sums.split_at_mut(size);
    for part in parts.chunks_exact(size) {
        whole.iter_mut().zip(part).for_each(|(sum, part)| *sum += part);
    }
    sums.truncate(size);
    sums
}

struct MatrixGradient<'a> {
    rows: Rows<'a>,
    /// The row of the first gradient.
    first: usize,
    gradient: &'a [f32],
    outputs: usize,
    sums: &'a mut [f32],
    buffer: BlockBuffer,
}

/// A block of the sum.
#[derive(Clone)]
struct Block {
    /// Rows, relative to the first.
    rows: Range<usize>,
    place: usize,
    /// The first input.
    input: usize,
    /// The first input that no earlier block covered.
    new: usize,
    /// The first vector of outputs.
    vector: usize,
}

impl WithSimd for MatrixGradient<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let count = self.gradient.len() / self.outputs;
        for first in (0..count).step_by(CHUNK) {
            for place in 0..self.rows.places {
                let rows = first..(first + CHUNK).min(count);
                let block = Block { rows, place, input: 0, new: 0, vector: 0 };
                self.chunk::<S>(simd, block);
            }
        }
    }
}

impl MatrixGradient<'_> {
    /// All blocks of a chunk of rows and one list of each row.
    #[inline(always)]
    fn chunk<S: Simd>(&mut self, simd: S, mut block: Block) {
        let width = self.rows.width;
        let mut input = 0;
        while input < width {
            block.new = input;
            // The last block overlaps the one before rather than end beyond the inputs.
            let inputs = if width < BLOCK { 1 } else { BLOCK };
            block.input = input.min(width - inputs);
            let vectors = self.outputs.div_ceil(S::F32_LANES);
            block.vector = 0;
            while block.vector < vectors {
                let two = vectors - block.vector >= 2;
                match (width < BLOCK, two) {
                    (true, true) => self.add::<S, 1, 2>(simd, &block),
                    (true, false) => self.add::<S, 1, 1>(simd, &block),
                    (false, true) => self.add::<S, BLOCK, 2>(simd, &block),
                    (false, false) => self.add::<S, BLOCK, 1>(simd, &block),
                }
                block.vector += if two { 2 } else { 1 };
            }
            input = block.input + inputs;
        }
    }

    /// R inputs and G vectors of outputs.
    #[inline(always)]
    fn add<S: Simd, const R: usize, const G: usize>(&mut self, simd: S, block: &Block) {
        let (outputs, vector) = (self.outputs, block.vector);
        let first = block.place * self.rows.width + block.input;
        let input = |r: usize| first + r;
        let begun = self.buffer.vectors::<S>();
        for r in 0..R {
            for g in 0..G {
                let lanes = lanes::<S>(input(r), vector + g, outputs);
                begun[r * G + g] = load(simd, self.sums, lanes);
            }
        }
        let sums = self.buffer.take::<S, R, G>(simd);
        let sums = self.products::<S, R, G>(simd, block, sums);
        self.buffer.put::<S, R, G>(sums);
        let sums = self.buffer.vectors::<S>().chunks_exact(G).enumerate().take(R);
        for (r, sums) in sums.skip(block.new - block.input) {
            for (g, &sum) in sums.iter().enumerate() {
                store(simd, self.sums, lanes::<S>(input(r), vector + g, outputs), sum);
            }
        }
    }

    /// Adds the products.
    #[inline(always)]
    fn products<S: Simd, const R: usize, const G: usize>(
        &self,
        simd: S,
        block: &Block,
        mut sums: [[S::f32s; G]; R],
    ) -> [[S::f32s; G]; R] {
        let Block { rows, place, input, vector, .. } = block.clone();
        for row in rows {
            let Some(list) = self.rows.list(self.first + row, place) else { continue };
            let list = &list[input..input + R];
            let mut by = [simd.splat_f32s(0.0); G];
            for (g, by) in by.iter_mut().enumerate() {
                *by = load(simd, self.gradient, lanes::<S>(row, vector + g, self.outputs));
            }
            for r in 0..R {
                let x = simd.splat_f32s(list[r]);
                for g in 0..G {
                    sums[r][g] = simd.mul_add_e_f32s(x, by[g], sums[r][g]);
                }
            }
        }
        sums
    }
}
