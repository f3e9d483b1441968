//! 256-bit vectors: sixteen particles in two of them, a row of nodes in one.
//!
//! All methods are safe because all vectors derive from a value of [`Avx2`], which exists only if the processor supports
//! AVX2. Loads and stores are unaligned and access exactly their argument.

use std::{
    arch::x86_64::*,
    ops::{Add, BitAnd, BitOr, Div, Mul, Sub},
};

use super::{
    super::level::{Work, x86},
    LANES, Lanes, Simd, Vectors,
};

/// AVX2.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Avx2(());

impl Avx2 {
    /// The instruction set.
    ///
    /// # Safety
    /// The processor supports AVX2.
    #[inline(always)]
    pub(in super::super) unsafe fn assume() -> Self {
        Self(())
    }
}

/// Sixteen numbers.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Two([__m256; 2]);

/// Sixteen booleans: all bits of a lane are set or none.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Mask([__m256; 2]);

/// Two numbers for each of four nodes.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Pairs(__m256);

/// One number for each of four nodes.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Ones(__m128);

macro_rules! operator {
    ($type:ident, $trait:ident, $name:ident, |$a:ident, $b:ident| $value:expr) => {
        impl $trait for $type {
            type Output = Self;
            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                let (Self($a), Self($b)) = (self, other);
                // SAFETY: see the module.
                Self(unsafe { $value })
            }
        }
    };
}
pub(super) use operator;

operator!(Two, Add, add, |a, b| [_mm256_add_ps(a[0], b[0]), _mm256_add_ps(a[1], b[1])]);
operator!(Two, Sub, sub, |a, b| [_mm256_sub_ps(a[0], b[0]), _mm256_sub_ps(a[1], b[1])]);
operator!(Two, Mul, mul, |a, b| [_mm256_mul_ps(a[0], b[0]), _mm256_mul_ps(a[1], b[1])]);
operator!(Two, Div, div, |a, b| [_mm256_div_ps(a[0], b[0]), _mm256_div_ps(a[1], b[1])]);
operator!(Mask, BitAnd, bitand, |a, b| [_mm256_and_ps(a[0], b[0]), _mm256_and_ps(a[1], b[1])]);
operator!(Mask, BitOr, bitor, |a, b| [_mm256_or_ps(a[0], b[0]), _mm256_or_ps(a[1], b[1])]);
operator!(Pairs, Add, add, |a, b| _mm256_add_ps(a, b));
operator!(Pairs, Sub, sub, |a, b| _mm256_sub_ps(a, b));
operator!(Pairs, Mul, mul, |a, b| _mm256_mul_ps(a, b));
operator!(Pairs, Div, div, |a, b| _mm256_div_ps(a, b));
operator!(Ones, Add, add, |a, b| _mm_add_ps(a, b));
operator!(Ones, Sub, sub, |a, b| _mm_sub_ps(a, b));
operator!(Ones, Mul, mul, |a, b| _mm_mul_ps(a, b));

/// Compares sixteen numbers.
#[inline(always)]
fn compare<const HOW: i32>(a: [__m256; 2], b: [__m256; 2]) -> Mask {
    // SAFETY: see the module.
    Mask(unsafe { [_mm256_cmp_ps::<HOW>(a[0], b[0]), _mm256_cmp_ps::<HOW>(a[1], b[1])] })
}

impl Simd for Avx2 {
    type Lanes = Two;
    type Mask = Mask;
    type Pairs = Pairs;
    type Ones = Ones;

    #[inline(always)]
    fn run<W: Work>(self, work: W) -> W::Output {
        // SAFETY: see the module.
        unsafe { x86::avx2(work) }
    }
    #[inline(always)]
    fn splat(self, number: f32) -> Two {
        // SAFETY: see the module.
        Two(unsafe { [_mm256_set1_ps(number); 2] })
    }
    #[inline(always)]
    fn load(self, lanes: &Lanes) -> Two {
        let start = lanes.as_ptr();
        // SAFETY: see the module.
        Two(unsafe { [_mm256_loadu_ps(start), _mm256_loadu_ps(start.add(8))] })
    }
    #[inline(always)]
    fn store(self, Two([a, b]): Two, lanes: &mut Lanes) {
        let start = lanes.as_mut_ptr();
        // SAFETY: see the module.
        unsafe {
            _mm256_storeu_ps(start, a);
            _mm256_storeu_ps(start.add(8), b);
        }
    }
    #[inline(always)]
    fn load_vectors(self, vectors: &Vectors) -> [Two; 2] {
        let start = vectors.as_ptr().cast::<f32>();
        // SAFETY: see the module.
        unsafe {
            let half = |start: *const f32| {
                let (a, b) = (_mm256_loadu_ps(start), _mm256_loadu_ps(start.add(8)));
                let (low, high) =
                    (_mm256_permute2f128_ps::<0x20>(a, b), _mm256_permute2f128_ps::<0x31>(a, b));
                let x = _mm256_shuffle_ps::<0b10_00_10_00>(low, high);
                let y = _mm256_shuffle_ps::<0b11_01_11_01>(low, high);
                (x, y)
            };
            let ((x0, y0), (x1, y1)) = (half(start), half(start.add(16)));
            [Two([x0, x1]), Two([y0, y1])]
        }
    }
    #[inline(always)]
    fn store_vectors(self, [Two(x), Two(y)]: [Two; 2], vectors: &mut Vectors) {
        let start = vectors.as_mut_ptr().cast::<f32>();
        // SAFETY: see the module.
        unsafe {
            for k in 0..2 {
                let (low, high) = (_mm256_unpacklo_ps(x[k], y[k]), _mm256_unpackhi_ps(x[k], y[k]));
                let start = start.add(16 * k);
                _mm256_storeu_ps(start, _mm256_permute2f128_ps::<0x20>(low, high));
                _mm256_storeu_ps(start.add(8), _mm256_permute2f128_ps::<0x31>(low, high));
            }
        }
    }
    #[inline(always)]
    fn sqrt(self, Two([a, b]): Two) -> Two {
        // SAFETY: see the module.
        Two(unsafe { [_mm256_sqrt_ps(a), _mm256_sqrt_ps(b)] })
    }
    #[inline(always)]
    fn less(self, Two(a): Two, Two(b): Two) -> Mask {
        compare::<_CMP_LT_OQ>(a, b)
    }
    #[inline(always)]
    fn at_least(self, Two(a): Two, Two(b): Two) -> Mask {
        compare::<_CMP_GE_OQ>(a, b)
    }
    #[inline(always)]
    fn equal(self, Two(a): Two, Two(b): Two) -> Mask {
        compare::<_CMP_EQ_OQ>(a, b)
    }
    #[inline(always)]
    fn select(self, Mask(mask): Mask, Two(a): Two, Two(b): Two) -> Two {
        // SAFETY: see the module.
        Two(unsafe {
            [_mm256_blendv_ps(b[0], a[0], mask[0]), _mm256_blendv_ps(b[1], a[1], mask[1])]
        })
    }
    #[inline(always)]
    fn bits(self, Mask([a, b]): Mask) -> u16 {
        // SAFETY: see the module.
        let bits = unsafe { _mm256_movemask_ps(b) << 8 | _mm256_movemask_ps(a) };
        bits as u16
    }
    #[inline(always)]
    fn truncate(self, Two([a, b]): Two) -> (Two, [i32; LANES]) {
        let mut integers = [0; LANES];
        // SAFETY: see the module.
        unsafe {
            let (a, b) = (_mm256_cvttps_epi32(a), _mm256_cvttps_epi32(b));
            _mm256_storeu_si256(integers.as_mut_ptr().cast(), a);
            _mm256_storeu_si256(integers.as_mut_ptr().add(8).cast(), b);
            (Two([_mm256_cvtepi32_ps(a), _mm256_cvtepi32_ps(b)]), integers)
        }
    }

    #[inline(always)]
    fn splat_pairs(self, number: f32) -> Pairs {
        // SAFETY: see the module.
        Pairs(unsafe { _mm256_set1_ps(number) })
    }
    #[inline(always)]
    fn repeat(self, pair: &[f32; 2]) -> Pairs {
        // SAFETY: see the module; two numbers are moved as one of twice the size.
        Pairs(unsafe {
            let bits = pair.as_ptr().cast::<f64>().read_unaligned();
            _mm256_castpd_ps(_mm256_set1_pd(bits))
        })
    }
    #[inline(always)]
    fn load_pairs(self, pairs: &[[f32; 2]; 4]) -> Pairs {
        // SAFETY: see the module.
        Pairs(unsafe { _mm256_loadu_ps(pairs.as_ptr().cast()) })
    }
    #[inline(always)]
    fn store_pairs(self, Pairs(value): Pairs, pairs: &mut [[f32; 2]; 4]) {
        // SAFETY: see the module.
        unsafe { _mm256_storeu_ps(pairs.as_mut_ptr().cast(), value) }
    }
    #[inline(always)]
    fn min_pairs(self, Pairs(a): Pairs, Pairs(b): Pairs) -> Pairs {
        // SAFETY: see the module.
        Pairs(unsafe { _mm256_min_ps(a, b) })
    }
    #[inline(always)]
    fn max_pairs(self, Pairs(a): Pairs, Pairs(b): Pairs) -> Pairs {
        // SAFETY: see the module.
        Pairs(unsafe { _mm256_max_ps(a, b) })
    }
    #[inline(always)]
    fn sums(self, [Pairs(a), Pairs(b), Pairs(c)]: [Pairs; 3]) -> [[f32; 2]; 3] {
        let mut sums = [[0.0; 2]; 3];
        // SAFETY: see the module; 16 bytes go to the first two pairs, 8 to the third.
        unsafe {
            let halves =
                |row| _mm_add_ps(_mm256_castps256_ps128(row), _mm256_extractf128_ps::<1>(row));
            let (a, b, c) = (halves(a), halves(b), halves(c));
            let both = _mm_add_ps(_mm_movelh_ps(a, b), _mm_movehl_ps(b, a));
            let last = _mm_add_ps(c, _mm_movehl_ps(c, c));
            _mm_storeu_ps(sums.as_mut_ptr().cast(), both);
            _mm_storel_epi64(sums.as_mut_ptr().add(2).cast(), _mm_castps_si128(last));
        }
        sums
    }

    #[inline(always)]
    fn sum_ones(self, Ones(ones): Ones) -> f32 {
        // SAFETY: see the module.
        unsafe {
            let halves = _mm_add_ps(ones, _mm_movehl_ps(ones, ones));
            _mm_cvtss_f32(_mm_add_ss(halves, _mm_movehdup_ps(halves)))
        }
    }
    #[inline(always)]
    fn twice(self, Ones(ones): Ones) -> Pairs {
        // SAFETY: see the module.
        Pairs(unsafe {
            let (low, high) = (_mm_unpacklo_ps(ones, ones), _mm_unpackhi_ps(ones, ones));
            _mm256_set_m128(high, low)
        })
    }
    #[inline(always)]
    fn splat_ones(self, number: f32) -> Ones {
        // SAFETY: see the module.
        Ones(unsafe { _mm_set1_ps(number) })
    }
    #[inline(always)]
    fn load_ones(self, ones: &[f32; 4]) -> Ones {
        // SAFETY: see the module.
        Ones(unsafe { _mm_loadu_ps(ones.as_ptr()) })
    }
    #[inline(always)]
    fn store_ones(self, Ones(value): Ones, ones: &mut [f32; 4]) {
        // SAFETY: see the module.
        unsafe { _mm_storeu_ps(ones.as_mut_ptr(), value) }
    }
}
