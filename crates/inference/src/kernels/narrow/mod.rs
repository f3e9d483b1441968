//! Many rows times a matrix of few columns, and the matrix's gradient: the particle model's layers.
//!
//! A block of sums stays in registers while rows are read where they lie: they are neither gathered
//! nor packed before, which for so few columns would take longer than the products. Only the matrix is
//! packed.
//!
//! 1. `panels`: the matrix, in the order in which it is read.
//! 2. `sums`: rows times the matrix.
//! 3. `slopes`: the matrix's gradient.
//!
//! Each sum is one thread's, or made of parts of it in a fixed order: the same bits for any number of
//! threads.

mod panels;
mod slopes;
mod sums;

pub use panels::Panels;
pub use slopes::by_matrix;
pub use sums::{add_products, products};

use pulp::Simd;

use super::nodes::MISSING;

/// Rows that are multiplied: lists of numbers, or some of these side by side.
#[derive(Clone, Copy, Debug)]
pub struct Rows<'a> {
    numbers: &'a [f32],
    width: usize,
    /// How many lists make a row.
    places: usize,
    /// Which they are, row by row; not there where each is a row of its own.
    table: Option<&'a [u32]>,
}

impl<'a> Rows<'a> {
    /// `[R, width]`.
    pub fn plain(numbers: &'a [f32], width: usize) -> Self {
        Self { numbers, width, places: 1, table: None }
    }

    /// Lists of `numbers`, `[.., width]`, side by side: `[M, K width]`. What is [`MISSING`] counts as
    /// zeros.
    pub fn gathered<const K: usize>(
        numbers: &'a [f32],
        width: usize,
        table: &'a [[u32; K]],
    ) -> Self {
        Self { numbers, width, places: K, table: Some(table.as_flattened()) }
    }

    /// How many rows there are.
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

    /// Numbers of a row.
    pub fn columns(&self) -> usize {
        self.places * self.width
    }

    /// A list of a row, unless it is missing.
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

/// Numbers of the largest block: 8 rows of 3 vectors.
const BLOCK: usize = 8 * 3 * 16;

/// A block on its way to or from a list. What is indexed by numbers that are not known when this is
/// compiled lies in memory: here, so that the sums themselves stay in registers.
struct Room([f32; BLOCK]);

impl Room {
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
