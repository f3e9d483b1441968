//! The vectors that the two phases compute with, in each set of instructions.
//!
//! Nothing here fuses a product with a sum, and square roots and quotients are exactly rounded, so
//! that every set gives the same bits: [`portable`] is what the others ([`avx2`], [`avx512`]) are.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod portable;

use std::ops::{Add, BitAnd, BitOr, Div, Mul, Sub};

#[cfg(target_arch = "x86_64")]
pub(super) use {avx2::Avx2, avx512::Avx512};

pub(super) use portable::Portable;

/// Particles that are moved, deformed and stressed at once.
pub(super) const LANES: usize = 16;

/// One number of each of sixteen particles, in memory.
pub(super) type Lanes = [f32; LANES];

/// Two numbers of each of sixteen particles, side by side in memory.
pub(super) type Vectors = [[f32; 2]; LANES];

/// A set of vector instructions. Whoever holds a value has seen that the processor has them.
pub(super) trait Simd: Copy {
    /// One number of each of sixteen particles.
    type Lanes: Arithmetic + Div<Output = Self::Lanes>;
    /// A truth for each of sixteen particles.
    type Mask: Copy + BitAnd<Output = Self::Mask> + BitOr<Output = Self::Mask>;
    /// Two numbers for each of four neighbouring nodes: a row of a stencil.
    type Pairs: Arithmetic + Div<Output = Self::Pairs>;
    /// One number for each of four neighbouring nodes.
    type Ones: Arithmetic;

    /// Sixteen times the same number.
    fn splat(self, number: f32) -> Self::Lanes;
    /// From memory.
    fn load(self, lanes: &Lanes) -> Self::Lanes;
    /// To memory.
    fn store(self, value: Self::Lanes, lanes: &mut Lanes);
    /// From memory where two numbers of each particle lie side by side.
    fn load_vectors(self, vectors: &Vectors) -> [Self::Lanes; 2];
    /// To such memory.
    fn store_vectors(self, value: [Self::Lanes; 2], vectors: &mut Vectors);
    /// Square roots.
    fn sqrt(self, value: Self::Lanes) -> Self::Lanes;
    /// Where `a < b`. False for NaN.
    fn less(self, a: Self::Lanes, b: Self::Lanes) -> Self::Mask;
    /// Where `a >= b`. False for NaN.
    fn at_least(self, a: Self::Lanes, b: Self::Lanes) -> Self::Mask;
    /// Where `a == b`. False for NaN.
    fn equal(self, a: Self::Lanes, b: Self::Lanes) -> Self::Mask;
    /// `a` where the mask is true, else `b`.
    fn select(self, mask: Self::Mask, a: Self::Lanes, b: Self::Lanes) -> Self::Lanes;
    /// In how many lanes the mask is true.
    fn count(self, mask: Self::Mask) -> usize;
    /// Cut towards zero, as numbers and as integers. Between -2^31 and 2^31.
    fn truncate(self, value: Self::Lanes) -> (Self::Lanes, [i32; LANES]);

    /// The same number everywhere in a row.
    fn splat_pairs(self, number: f32) -> Self::Pairs;
    /// The same two numbers for each node.
    fn repeat(self, pair: &[f32; 2]) -> Self::Pairs;
    /// From memory.
    fn load_pairs(self, pairs: &[[f32; 2]; 4]) -> Self::Pairs;
    /// To memory.
    fn store_pairs(self, value: Self::Pairs, pairs: &mut [[f32; 2]; 4]);
    /// The smaller of two, `b` where one is NaN.
    fn min_pairs(self, a: Self::Pairs, b: Self::Pairs) -> Self::Pairs;
    /// The larger of two, `b` where one is NaN.
    fn max_pairs(self, a: Self::Pairs, b: Self::Pairs) -> Self::Pairs;
    /// The sum over the four nodes of each of three rows: `(0 + 2) + (1 + 3)`.
    fn sums(self, rows: [Self::Pairs; 3]) -> [[f32; 2]; 3];

    /// The sum over the four nodes: `(0 + 2) + (1 + 3)`.
    fn sum_ones(self, ones: Self::Ones) -> f32;
    /// One number of each node, for both of its numbers.
    fn twice(self, ones: Self::Ones) -> Self::Pairs;
    /// The same number for each node.
    fn splat_ones(self, number: f32) -> Self::Ones;
    /// From memory.
    fn load_ones(self, ones: &[f32; 4]) -> Self::Ones;
    /// To memory.
    fn store_ones(self, value: Self::Ones, ones: &mut [f32; 4]);
}

/// Sum, difference and product, number by number.
pub(super) trait Arithmetic:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self>
{
}

impl<T: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self>> Arithmetic for T {}
