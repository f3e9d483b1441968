//! The vector instructions of this processor, and the two phases compiled for each.

use super::{
    chunk::Chunk,
    field::{Forces, Sum, Velocities},
    pack::Pack,
    simd::Portable,
    transfer::{Step, pass},
};

/// A set of vector instructions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in super::super) enum Level {
    /// What every processor of the architecture has.
    Portable,
    /// 256-bit vectors.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// 512-bit vectors.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Level {
    /// Those of this processor, the widest last.
    pub(in super::super) fn present() -> Vec<Self> {
        #[allow(unused_mut, reason = "other architectures add nothing")]
        let mut present = vec![Self::Portable];
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") {
                present.push(Self::Avx2);
                if is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512dq")
                {
                    present.push(Self::Avx512);
                }
            }
        }
        present
    }

    /// The pass over the particles of a chunk.
    pub(super) fn pass<const GATHER: bool, const SCATTER: bool>(
        self,
        chunk: &mut Chunk,
        packs: &mut [Pack],
        field: Velocities<'_>,
        step: &Step,
    ) {
        match self {
            Self::Portable => pass::<_, GATHER, SCATTER>(Portable, chunk, packs, field, step),
            // SAFETY: a level is made by `present` only.
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => unsafe { x86::pass_avx2::<GATHER, SCATTER>(chunk, packs, field, step) },
            // SAFETY: the same.
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => unsafe {
                x86::pass_avx512::<GATHER, SCATTER>(chunk, packs, field, step)
            },
        }
    }

    /// The update of one row of nodes.
    pub(super) fn update(
        self,
        forces: &Forces,
        row: usize,
        chunks: &[Chunk],
        velocity: &mut [[f32; 2]],
        sum: &mut Sum,
    ) {
        match self {
            Self::Portable => forces.update(Portable, row, chunks, velocity, sum),
            // SAFETY: a level is made by `present` only.
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => unsafe { x86::update_avx2(forces, row, chunks, velocity, sum) },
            // SAFETY: the same.
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => unsafe { x86::update_avx512(forces, row, chunks, velocity, sum) },
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{
        super::simd::{Avx2, Avx512},
        *,
    };

    #[target_feature(enable = "avx2")]
    pub(super) fn pass_avx2<const GATHER: bool, const SCATTER: bool>(
        chunk: &mut Chunk,
        packs: &mut [Pack],
        field: Velocities<'_>,
        step: &Step,
    ) {
        // SAFETY: this function runs where AVX2 is.
        pass::<_, GATHER, SCATTER>(unsafe { Avx2::assume() }, chunk, packs, field, step);
    }

    #[target_feature(enable = "avx2,avx512f,avx512vl,avx512dq")]
    pub(super) fn pass_avx512<const GATHER: bool, const SCATTER: bool>(
        chunk: &mut Chunk,
        packs: &mut [Pack],
        field: Velocities<'_>,
        step: &Step,
    ) {
        // SAFETY: this function runs where AVX-512 is.
        pass::<_, GATHER, SCATTER>(unsafe { Avx512::assume() }, chunk, packs, field, step);
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn update_avx2(
        forces: &Forces,
        row: usize,
        chunks: &[Chunk],
        velocity: &mut [[f32; 2]],
        sum: &mut Sum,
    ) {
        // SAFETY: this function runs where Avx2 is.
        forces.update(unsafe { Avx2::assume() }, row, chunks, velocity, sum);
    }

    #[target_feature(enable = "avx2,avx512f,avx512vl,avx512dq")]
    pub(super) fn update_avx512(
        forces: &Forces,
        row: usize,
        chunks: &[Chunk],
        velocity: &mut [[f32; 2]],
        sum: &mut Sum,
    ) {
        // SAFETY: this function runs where Avx512 is.
        forces.update(unsafe { Avx512::assume() }, row, chunks, velocity, sum);
    }
}
