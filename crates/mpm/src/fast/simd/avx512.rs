//! 512-bit vectors for particles; rows of nodes use [`Avx2`].
//!
//! All methods are safe because all vectors derive from a value of [`Avx512`], which exists only if the processor supports
//! AVX-512. Loads and stores are unaligned and access exactly their argument.

use std::{
    arch::x86_64::*,
    ops::{Add, BitAnd, BitOr, Div, Mul, Sub},
};

use super::{
    super::level::{Work, x86},
    LANES, Lanes, Simd, Vectors,
    avx2::{Avx2, operator},
};

/// AVX-512 F.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Avx512(Avx2);

impl Avx512 {
    /// The instruction set.
    ///
    /// # Safety
    /// The processor supports AVX2, AVX-512 F and AVX-512 VL.
    #[inline(always)]
    pub(in super::super) unsafe fn assume() -> Self {
        // SAFETY: guaranteed by the caller.
        Self(unsafe { Avx2::assume() })
    }
}

/// Sixteen numbers.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct One(__m512);

/// Sixteen booleans, one bit each.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Bits(__mmask16);

operator!(One, Add, add, |a, b| _mm512_add_ps(a, b));
operator!(One, Sub, sub, |a, b| _mm512_sub_ps(a, b));
operator!(One, Mul, mul, |a, b| _mm512_mul_ps(a, b));
operator!(One, Div, div, |a, b| _mm512_div_ps(a, b));

impl BitAnd for Bits {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }
}

impl BitOr for Bits {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

impl Simd for Avx512 {
    type Lanes = One;
    type Mask = Bits;
    type Pairs = <Avx2 as Simd>::Pairs;
    type Ones = <Avx2 as Simd>::Ones;

    #[inline(always)]
    fn run<W: Work>(self, work: W) -> W::Output {
        // SAFETY: see the module.
        unsafe { x86::avx512(work) }
    }
    #[inline(always)]
    fn splat(self, number: f32) -> One {
        // SAFETY: see the module.
        One(unsafe { _mm512_set1_ps(number) })
    }
    #[inline(always)]
    fn load(self, lanes: &Lanes) -> One {
        // SAFETY: see the module.
        One(unsafe { _mm512_loadu_ps(lanes.as_ptr()) })
    }
    #[inline(always)]
    fn store(self, One(value): One, lanes: &mut Lanes) {
        // SAFETY: see the module.
        unsafe { _mm512_storeu_ps(lanes.as_mut_ptr(), value) }
    }
    #[inline(always)]
    fn load_vectors(self, vectors: &Vectors) -> [One; 2] {
        let start = vectors.as_ptr().cast::<f32>();
        // SAFETY: see the module.
        unsafe {
            let (a, b) = (_mm512_loadu_ps(start), _mm512_loadu_ps(start.add(16)));
            let even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
            let odd = _mm512_add_epi32(even, _mm512_set1_epi32(1));
            let pick = |places| One(_mm512_permutex2var_ps(a, places, b));
            [pick(even), pick(odd)]
        }
    }
    #[inline(always)]
    fn store_vectors(self, [One(x), One(y)]: [One; 2], vectors: &mut Vectors) {
        let start = vectors.as_mut_ptr().cast::<f32>();
        // SAFETY: see the module.
        unsafe {
            let first = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
            let last = _mm512_add_epi32(first, _mm512_set1_epi32(8));
            _mm512_storeu_ps(start, _mm512_permutex2var_ps(x, first, y));
            _mm512_storeu_ps(start.add(16), _mm512_permutex2var_ps(x, last, y));
        }
    }
    #[inline(always)]
    fn sqrt(self, One(value): One) -> One {
        // SAFETY: see the module.
        One(unsafe { _mm512_sqrt_ps(value) })
    }
    #[inline(always)]
    fn less(self, One(a): One, One(b): One) -> Bits {
        // SAFETY: see the module.
        Bits(unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(a, b) })
    }
    #[inline(always)]
    fn at_least(self, One(a): One, One(b): One) -> Bits {
        // SAFETY: see the module.
        Bits(unsafe { _mm512_cmp_ps_mask::<_CMP_GE_OQ>(a, b) })
    }
    #[inline(always)]
    fn equal(self, One(a): One, One(b): One) -> Bits {
        // SAFETY: see the module.
        Bits(unsafe { _mm512_cmp_ps_mask::<_CMP_EQ_OQ>(a, b) })
    }
    #[inline(always)]
    fn select(self, Bits(mask): Bits, One(a): One, One(b): One) -> One {
        // SAFETY: see the module.
        One(unsafe { _mm512_mask_blend_ps(mask, b, a) })
    }
    #[inline(always)]
    fn bits(self, Bits(mask): Bits) -> u16 {
        mask
    }
    #[inline(always)]
    fn truncate(self, One(value): One) -> (One, [i32; LANES]) {
        let mut integers = [0; LANES];
        // SAFETY: see the module.
        unsafe {
            let cut = _mm512_cvttps_epi32(value);
            _mm512_storeu_si512(integers.as_mut_ptr().cast(), cut);
            (One(_mm512_cvtepi32_ps(cut)), integers)
        }
    }

    #[inline(always)]
    fn splat_pairs(self, number: f32) -> Self::Pairs {
        self.0.splat_pairs(number)
    }
    #[inline(always)]
    fn repeat(self, pair: &[f32; 2]) -> Self::Pairs {
        self.0.repeat(pair)
    }
    #[inline(always)]
    fn load_pairs(self, pairs: &[[f32; 2]; 4]) -> Self::Pairs {
        self.0.load_pairs(pairs)
    }
    #[inline(always)]
    fn store_pairs(self, value: Self::Pairs, pairs: &mut [[f32; 2]; 4]) {
        self.0.store_pairs(value, pairs);
    }
    #[inline(always)]
    fn min_pairs(self, a: Self::Pairs, b: Self::Pairs) -> Self::Pairs {
        self.0.min_pairs(a, b)
    }
    #[inline(always)]
    fn max_pairs(self, a: Self::Pairs, b: Self::Pairs) -> Self::Pairs {
        self.0.max_pairs(a, b)
    }
    #[inline(always)]
    fn sums(self, rows: [Self::Pairs; 3]) -> [[f32; 2]; 3] {
        self.0.sums(rows)
    }
    #[inline(always)]
    fn sum_ones(self, ones: Self::Ones) -> f32 {
        self.0.sum_ones(ones)
    }
    #[inline(always)]
    fn twice(self, ones: Self::Ones) -> Self::Pairs {
        self.0.twice(ones)
    }
    #[inline(always)]
    fn splat_ones(self, number: f32) -> Self::Ones {
        self.0.splat_ones(number)
    }
    #[inline(always)]
    fn load_ones(self, ones: &[f32; 4]) -> Self::Ones {
        self.0.load_ones(ones)
    }
    #[inline(always)]
    fn store_ones(self, value: Self::Ones, ones: &mut [f32; 4]) {
        self.0.store_ones(value, ones);
    }
}
