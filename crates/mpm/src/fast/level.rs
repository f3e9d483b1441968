//! Run-time selection of vector instructions.

use super::simd::{Portable, Simd};

/// A set of vector instructions supported by this processor, as detected by [`Level::present`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in super::super) struct Level(Instructions);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Instructions {
    /// The baseline of the architecture.
    Portable,
    /// 256-bit vectors.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// 512-bit vectors.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

/// A computation that is compiled for every set of instructions. `run` and everything that it calls must be
/// `#[inline(always)]`, or the compiler does not use the instructions. A closure cannot be, so one that is called more than once, or
/// by `array::map`, has no place in it.
pub(super) trait Work {
    type Output;

    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

impl Level {
    /// The sets supported by this processor, the widest last.
    pub(in super::super) fn present() -> Vec<Self> {
        #[cfg_attr(not(target_arch = "x86_64"), expect(unused_mut, reason = "nothing to add"))]
        let mut present = vec![Self(Instructions::Portable)];
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            present.push(Self(Instructions::Avx2));
            if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl") {
                present.push(Self(Instructions::Avx512));
            }
        }
        present
    }

    /// The widest set supported by this processor.
    pub(in super::super) fn widest() -> Self {
        Self::present().pop().unwrap_or(Self(Instructions::Portable))
    }

    /// Runs a computation with these instructions.
    #[inline]
    pub(super) fn run<W: Work>(self, work: W) -> W::Output {
        match self.0 {
            Instructions::Portable => work.run(Portable),
            // SAFETY: `present` has detected AVX2.
            #[cfg(target_arch = "x86_64")]
            Instructions::Avx2 => unsafe { x86::avx2(work) },
            // SAFETY: `present` has detected AVX-512.
            #[cfg(target_arch = "x86_64")]
            Instructions::Avx512 => unsafe { x86::avx512(work) },
        }
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) mod x86 {
    use super::{
        super::simd::{Avx2, Avx512},
        Work,
    };

    #[target_feature(enable = "avx2")]
    #[inline(never)]
    pub(in super::super) fn avx2<W: Work>(work: W) -> W::Output {
        // SAFETY: the target feature is enabled.
        work.run(unsafe { Avx2::assume() })
    }

    #[target_feature(enable = "avx2,avx512f,avx512vl")]
    #[inline(never)]
    pub(in super::super) fn avx512<W: Work>(work: W) -> W::Output {
        // SAFETY: the target features are enabled.
        work.run(unsafe { Avx512::assume() })
    }
}
