//! Vector types of the solver for each set of instructions.
//!
//! Products and sums are not fused, and square roots and quotients are correctly rounded, so all sets give the same bits:
//! [`portable`] defines the results of [`avx2`] and [`avx512`].
//!
//! These are not the vectors of `pulp`, as in `eddy-inference`, because code that is generic over pulp's instruction sets has
//! no vectors of a fixed width for a row of four nodes, and no loads that deinterleave. With pulp's AVX-512 vectors for
//! particles and these for nodes, a substep of the case of `eddy-lab bench solver --particles 2500,10000 --threads 1` took 46 and
//! 186 microseconds instead of 36 and 153 (AMD EPYC, two busy cores, best of seven rounds), with [`portable`] compiled for
//! AVX-512 75 and 310. The results were the same bits.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod portable;

use std::ops::{Add, BitAnd, BitOr, Div, Mul, Sub};

use super::level::Work;

#[cfg(target_arch = "x86_64")]
pub(super) use {avx2::Avx2, avx512::Avx512};

pub(super) use portable::Portable;

/// Particles per vector.
pub(super) const LANES: usize = 16;

/// One number per particle, in memory.
pub(super) type Lanes = [f32; LANES];

/// Two interleaved numbers per particle, in memory.
pub(super) type Vectors = [[f32; 2]; LANES];

/// A set of vector instructions. A value proves that the processor supports them.
pub(super) trait Simd: Copy {
    /// One number per particle.
    type Lanes: Arithmetic + Div<Output = Self::Lanes>;
    /// One boolean per particle.
    type Mask: Copy + BitAnd<Output = Self::Mask> + BitOr<Output = Self::Mask>;
    /// Two numbers for each of four neighbouring nodes, a row of a stencil.
    type Pairs: Arithmetic + Div<Output = Self::Pairs>;
    /// One number for each of four neighbouring nodes.
    type Ones: Arithmetic;

    /// Runs a computation in a function of its own, which takes no registers from the caller.
    fn run<W: Work>(self, work: W) -> W::Output;

    /// The same number in all lanes.
    fn splat(self, number: f32) -> Self::Lanes;
    /// Loads from memory.
    fn load(self, lanes: &Lanes) -> Self::Lanes;
    /// Stores to memory.
    fn store(self, value: Self::Lanes, lanes: &mut Lanes);
    /// Loads and deinterleaves two numbers per particle.
    fn load_vectors(self, vectors: &Vectors) -> [Self::Lanes; 2];
    /// Interleaves and stores two numbers per particle.
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
    /// The lanes in which the mask is true, as bits.
    fn bits(self, mask: Self::Mask) -> u16;
    /// Number of lanes in which the mask is true.
    #[inline(always)]
    fn count(self, mask: Self::Mask) -> usize {
        self.bits(mask).count_ones() as usize
    }
    /// Where `from <= x < to`. False for NaN.
    #[inline(always)]
    fn within(self, x: Self::Lanes, [from, to]: [f32; 2]) -> Self::Mask {
        self.less(x, self.splat(to)) & self.at_least(x, self.splat(from))
    }
    /// The smaller one of each number and `most`. NaN for NaN.
    #[inline(always)]
    fn min(self, x: Self::Lanes, most: f32) -> Self::Lanes {
        let most = self.splat(most);
        self.select(self.less(most, x), most, x)
    }
    /// The larger one of each number and `least`. NaN for NaN.
    #[inline(always)]
    fn max(self, x: Self::Lanes, least: f32) -> Self::Lanes {
        let least = self.splat(least);
        self.select(self.less(x, least), least, x)
    }
    /// The nearest number in this range. NaN for NaN.
    #[inline(always)]
    fn clamp(self, x: Self::Lanes, [lowest, highest]: [f32; 2]) -> Self::Lanes {
        self.min(self.max(x, lowest), highest)
    }
    /// Truncates numbers between -2^31 and 2^31, to floats and integers.
    fn truncate(self, value: Self::Lanes) -> (Self::Lanes, [i32; LANES]);

    /// The same number for both components of each node.
    fn splat_pairs(self, number: f32) -> Self::Pairs;
    /// The same two numbers for each node.
    fn repeat(self, pair: &[f32; 2]) -> Self::Pairs;
    /// Loads from memory.
    fn load_pairs(self, pairs: &[[f32; 2]; 4]) -> Self::Pairs;
    /// Stores to memory.
    fn store_pairs(self, value: Self::Pairs, pairs: &mut [[f32; 2]; 4]);
    /// Minimum; `b` where either is NaN.
    fn min_pairs(self, a: Self::Pairs, b: Self::Pairs) -> Self::Pairs;
    /// Maximum; `b` where either is NaN.
    fn max_pairs(self, a: Self::Pairs, b: Self::Pairs) -> Self::Pairs;
    /// Sums over the four nodes of each of three rows, as `(0 + 2) + (1 + 3)`.
    fn sums(self, rows: [Self::Pairs; 3]) -> [[f32; 2]; 3];

    /// Sum over the four nodes, as `(0 + 2) + (1 + 3)`.
    fn sum_ones(self, ones: Self::Ones) -> f32;
    /// Duplicates each node's number for both components.
    fn twice(self, ones: Self::Ones) -> Self::Pairs;
    /// The same number for each node.
    fn splat_ones(self, number: f32) -> Self::Ones;
    /// Loads from memory.
    fn load_ones(self, ones: &[f32; 4]) -> Self::Ones;
    /// Stores to memory.
    fn store_ones(self, value: Self::Ones, ones: &mut [f32; 4]);
}

/// Lane-wise sum, difference and product.
pub(super) trait Arithmetic:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self>
{
}

impl<T: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self>> Arithmetic for T {}
