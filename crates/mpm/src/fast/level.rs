//! The vector instructions of this processor, chosen while the program runs.

use super::simd::{Portable, Simd};

/// A set of vector instructions that this processor has: only [`Level::present`] makes one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in super::super) struct Level(Instructions);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Instructions {
    /// What every processor of the architecture has.
    Portable,
    /// 256-bit vectors.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// 512-bit vectors.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

/// Something to compute that is compiled for every set of instructions. `run` has to be inlined
/// (`#[inline(always)]`), with everything that it calls: only so the compiler uses the instructions.
pub(super) trait Work {
    /// What comes out.
    type Output;

    /// Computes it.
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

impl Level {
    /// Those of this processor, the widest last.
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

    /// The widest of this processor.
    pub(in super::super) fn widest() -> Self {
        Self::present().pop().unwrap_or(Self(Instructions::Portable))
    }

    /// Computes something with these instructions.
    #[inline]
    pub(super) fn run<W: Work>(self, work: W) -> W::Output {
        match self.0 {
            Instructions::Portable => work.run(Portable),
            // SAFETY: `present` has seen AVX2.
            #[cfg(target_arch = "x86_64")]
            Instructions::Avx2 => unsafe { x86::avx2(work) },
            // SAFETY: `present` has seen AVX-512.
            #[cfg(target_arch = "x86_64")]
            Instructions::Avx512 => unsafe { x86::avx512(work) },
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{
        super::simd::{Avx2, Avx512},
        Work,
    };

    #[target_feature(enable = "avx2")]
    pub(super) fn avx2<W: Work>(work: W) -> W::Output {
        // SAFETY: this function runs where AVX2 is.
        work.run(unsafe { Avx2::assume() })
    }

    #[target_feature(enable = "avx2,avx512f,avx512vl")]
    pub(super) fn avx512<W: Work>(work: W) -> W::Output {
        // SAFETY: this function runs where AVX2 and AVX-512 are.
        work.run(unsafe { Avx512::assume() })
    }
}
