//! Finds out whether the substep is too long for any particle in packs, as [`bound`](super::super::bound).

use super::{super::bound::Bound, level::Work, pack::Pack, simd::Simd};
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
            let too_fast = simd.less(one, (u * u + v * v) * travel_limit);
            let strained = |k: usize| {
                let c = simd.load(&pack.affine[k]);
                simd.less(one, c * c * strain_limit)
            };
            let strained = strained(0) | strained(1) | strained(2) | strained(3);
            let [xx, xy, yx, yy] = [0, 1, 2, 3].map(|k| simd.load(&pack.deformation[k]));
            let sum = half * (xx * xx + xy * xy + yx * yx + yy * yy);
            let area = xx * yy - xy * yx;
            let difference = sum * sum - area * area;
            let difference = simd.select(simd.less(difference, zero), zero, difference);
            let mut stretch = sum + simd.sqrt(difference);
            let material = simd.load(&pack.material);
            let is = |kind: Material| simd.equal(material, simd.splat(f32::from(kind as u8)));
            if bound.is_water {
                let packed = one / area;
                let cube = packed * packed * packed;
                stretch = simd.select(is(Material::Liquid), cube * cube, stretch);
            }
            let [first, rest @ ..] = Material::ALL;
            let limit = |kind: Material| simd.splat(bound.sound[kind as usize]);
            let mut sound_limit = limit(first);
            for kind in rest {
                sound_limit = simd.select(is(kind), limit(kind), sound_limit);
            }
            let too_stiff = simd.less(one, stretch * sound_limit);
            simd.count(too_fast | strained | too_stiff) > 0
        })
    }
}
