//! Finds out whether the substep is too long for any particle in packs, as [`bound`](super::super::bound).

use super::{
    super::bound::Bound,
    law::{is, load},
    level::Work,
    pack::Pack,
    simd::Simd,
};
use eddy_frames::Material;

/// The search in these packs.
pub(super) struct Search<'a> {
    pub(super) packs: &'a [Pack],
    pub(super) bound: &'a Bound,
}

impl Work for Search<'_> {
    /// Whether the substep is too long for a particle.
    type Output = bool;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> bool {
        let Self { packs, bound } = self;
        let (zero, one, half) = (simd.splat(0.0), simd.splat(1.0), simd.splat(0.5));
        let (travel_limit, strain_limit) = (simd.splat(bound.travel), simd.splat(bound.strain));
        packs.iter().any(|pack| {
            let [u, v] = [simd.load(&pack.velocity[0]), simd.load(&pack.velocity[1])];
            let mut exceeding = simd.less(one, (u * u + v * v) * travel_limit);
            for c in &pack.affine {
                let c = simd.load(c);
                exceeding = exceeding | simd.less(one, c * c * strain_limit);
            }
            let [xx, xy, yx, yy] = load(simd, &pack.deformation);
            let sum = half * (xx * xx + xy * xy + yx * yx + yy * yy);
            let area = xx * yy - xy * yx;
            let difference = sum * sum - area * area;
            let difference = simd.select(simd.less(difference, zero), zero, difference);
            let mut stretch = sum + simd.sqrt(difference);
            if bound.is_water {
                let packed = one / area;
                let cube = packed * packed * packed;
                stretch = simd.select(is(simd, pack, Material::Liquid), cube * cube, stretch);
            }
            let mut sound_limit = zero;
            for kind in Material::ALL {
                let limit = simd.splat(bound.sound[kind as usize]);
                sound_limit = simd.select(is(simd, pack, kind), limit, sound_limit);
            }
            let too_stiff = simd.less(one, stretch * sound_limit);
            simd.count(exceeding | too_stiff) > 0
        })
    }
}
