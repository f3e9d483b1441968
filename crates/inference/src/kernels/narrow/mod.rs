//! Products of many rows with a matrix of few columns, and the gradient by the matrix: the particle model's layers.
//!
//! A block of sums stays in registers while rows are read in place: gathering or packing them first would take longer than
//! the products. Only the matrix is packed.
//!
//! 1. `panels`: the packed matrix.
//! 2. `products`: rows times the matrix.
//! 3. `gradient`: the gradient by the matrix.
//!
//! Each sum is computed by one thread, or from parts in a fixed order: any number of threads gives the same bits.

mod gradient;
mod panels;
mod products;

pub use gradient::matrix_gradient;
pub use panels::Panels;
pub use products::{add_products, products};

use pulp::Simd;

use super::nodes::MISSING;

/// Input rows: lists of numbers, or several lists concatenated.
#[derive(Clone, Copy, Debug)]
pub struct Rows<'a> {
    numbers: &'a [f32],
    width: usize,
    /// Lists per row.
    places: usize,
    /// The lists of each row; none if each list is a row.
    table: Option<&'a [u32]>,
}

impl<'a> Rows<'a> {
    /// `[R, width]`.
    pub fn plain(numbers: &'a [f32], width: usize) -> Self {
        Self { numbers, width, places: 1, table: None }
    }

    /// Lists of `numbers`, `[.., width]`, concatenated to rows, `[M, K width]`. Lists that are [`MISSING`] count as zeros.
    pub fn gathered<const K: usize>(
        numbers: &'a [f32],
        width: usize,
        table: &'a [[u32; K]],
    ) -> Self {
        Self { numbers, width, places: K, table: Some(table.as_flattened()) }
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        match self.table {
            Some(table) => table.len() / self.places,
            None => self.numbers.len() / self.width,
        }
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Length of a row.
    pub fn columns(&self) -> usize {
        self.places * self.width
    }

    /// A list of a row; none if it is missing.
    #[inline(always)]
    fn list(&self, row: usize, place: usize) -> Option<&'a [f32]> {
        let list = match self.table {
            None => row,
            Some(table) => match table[row * self.places + place] {
                MISSING => return None,
                list => list as usize,
            },
        };
        Some(&self.numbers[list * self.width..][..self.width])
    }
}

/// Length of the largest block: 8 rows of 3 vectors.
const BLOCK: usize = 8 * 3 * 16;

/// A block on its way to or from a list. Arrays that are indexed at run time are placed in memory: with this copy, the sums
/// themselves stay in registers.
struct BlockBuffer([f32; BLOCK]);

impl BlockBuffer {
    fn new() -> Self {
        Self([0.0; BLOCK])
    }

    #[inline(always)]
    fn put<S: Simd, const R: usize, const G: usize>(&mut self, sums: [[S::f32s; G]; R]) {
        let vectors = &mut S::as_mut_simd_f32s(&mut self.0).0[..R * G];
        for r in 0..R {
            for g in 0..G {
                vectors[r * G + g] = sums[r][g];
            }
        }
    }

    #[inline(always)]
    fn take<S: Simd, const R: usize, const G: usize>(&self, simd: S) -> [[S::f32s; G]; R] {
        let vectors = &S::as_simd_f32s(&self.0).0[..R * G];
        let mut sums = [[simd.splat_f32s(0.0); G]; R];
        for r in 0..R {
            for g in 0..G {
                sums[r][g] = vectors[r * G + g];
            }
        }
        sums
    }

    /// The vectors, row by row.
    #[inline(always)]
    fn vectors<S: Simd>(&mut self) -> &mut [S::f32s] {
        S::as_mut_simd_f32s(&mut self.0).0
    }
}

#[cfg(test)]
mod tests;
