//! The constitutive model for a pack, without branches, as [`constitutive`](super::super::constitutive),
//! [`water`](super::super::water) and [`sand`](super::super::sand).

use super::{
    super::{
        material::{
            EXPONENTIAL_SERIES, JELLY_STIFFNESS, LOGARITHM_SERIES, Lame, Law, Moduli,
            ROPE_STIFFNESS, SAND_STIFFNESS, SNOW_HARDENING, SNOW_HARDENING_EXPONENTS,
            SNOW_HARDENING_RANGE, SNOW_STRETCH,
        },
        sand,
        water::max_area,
    },
    pack::Pack,
    simd::{LANES, Lanes, Simd},
};
use eddy_frames::Material;

/// Below this the rotation of a matrix, or the direction of its stretch, is undefined.
const MIN_LENGTH: f32 = 1e-12;

/// Kirchhoff stress of sixteen particles: xx, xy, yy (density x velocity^2).
pub(super) type Stress<S> = [<S as Simd>::Lanes; 3];

/// F or C of sixteen particles: xx, xy, yx, yy.
type Matrices<S> = [<S as Simd>::Lanes; 4];

/// Advances the deformation of all particles by `dt` seconds and returns their stress.
#[inline(always)]
pub(super) fn advance<S: Simd>(simd: S, pack: &mut Pack, moduli: &Moduli, dt: f32) -> Stress<S> {
    let (is_liquid, is_snow) = (is(simd, pack, Material::Liquid), is(simd, pack, Material::Snow));
    let is_sand = is(simd, pack, Material::Sand);
    let (liquids, sands) = (simd.count(is_liquid), simd.count(is_sand));
    let affine = load(simd, &pack.affine);
    let trial = trial(simd, pack, &affine, dt);
    if liquids == LANES {
        let (deformation, stress) = liquid(simd, &trial, &affine, moduli);
        store(simd, pack, deformation);
        return stress;
    }
    if sands == LANES {
        let (deformation, stress) = grains(simd, pack, &trial, is_sand, moduli);
        store(simd, pack, deformation);
        return stress;
    }
    let (mut deformation, mut stress) = if simd.count(is_snow) == 0 {
        let stress = elastic(simd, &trial, polar(simd, &trial).0, factor(simd, pack), moduli);
        (trial, stress)
    } else {
        snow(simd, pack, &trial, is_snow, moduli)
    };
    let mut replace = |mask, (other, others): (Matrices<S>, Stress<S>)| {
        for k in 0..4 {
            deformation[k] = simd.select(mask, other[k], deformation[k]);
        }
        for k in 0..3 {
            stress[k] = simd.select(mask, others[k], stress[k]);
        }
    };
    if liquids > 0 {
        replace(is_liquid, liquid(simd, &trial, &affine, moduli));
    }
    if sands > 0 {
        replace(is_sand, grains(simd, pack, &trial, is_sand, moduli));
    }
    store(simd, pack, deformation);
    stress
}

/// Which particles are of this material.
#[inline(always)]
pub(super) fn is<S: Simd>(simd: S, pack: &Pack, material: Material) -> S::Mask {
    simd.equal(simd.load(&pack.material), simd.splat(f32::from(material as u8)))
}

#[inline(always)]
pub(super) fn load<S: Simd>(simd: S, [xx, xy, yx, yy]: &[Lanes; 4]) -> Matrices<S> {
    [simd.load(xx), simd.load(xy), simd.load(yx), simd.load(yy)]
}

#[inline(always)]
fn store<S: Simd>(simd: S, pack: &mut Pack, deformation: Matrices<S>) {
    for (lanes, value) in pack.deformation.iter_mut().zip(deformation) {
        simd.store(value, lanes);
    }
}

/// `(I + dt C) F`.
#[inline(always)]
fn trial<S: Simd>(simd: S, pack: &Pack, affine: &Matrices<S>, dt: f32) -> Matrices<S> {
    let [xx, xy, yx, yy] = load(simd, &pack.deformation);
    let (one, dt) = (simd.splat(1.0), simd.splat(dt));
    let (a, b) = (one + affine[0] * dt, affine[1] * dt);
    let (c, d) = (affine[2] * dt, one + affine[3] * dt);
    [a * xx + b * yx, a * xy + b * yy, c * xx + d * yx, c * xy + d * yy]
}

/// Liquids: pressure from the area, and viscous stress.
#[inline(always)]
fn liquid<S: Simd>(
    simd: S,
    [xx, xy, yx, yy]: &Matrices<S>,
    affine: &Matrices<S>,
    moduli: &Moduli,
) -> (Matrices<S>, Stress<S>) {
    let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
    let area = *xx * *yy - *xy * *yx;
    let (area, stress) = match moduli.law {
        Law::Taichi => {
            let tension = simd.splat(moduli.lame.lambda) * area * (area - one);
            (area, [tension, zero, tension])
        }
        Law::Water | Law::Settling => {
            let area = simd.min(area, max_area(moduli.law));
            let packed = one / area;
            let squared = packed * packed;
            let seventh = squared * squared * squared * packed;
            let pressure = simd.splat(moduli.lame.lambda / 7.0) * (seventh - one);
            // This order of operands preserves NaN.
            let pressure = area * simd.select(simd.less(pressure, zero), zero, pressure);
            let viscous = area * simd.splat(2.0 * moduli.viscosity);
            let half = simd.splat(0.5);
            let stretch = viscous * (half * (affine[0] - affine[3]));
            let shear = viscous * (half * (affine[1] + affine[2]));
            (area, [stretch - pressure, shear, zero - stretch - pressure])
        }
    };
    let side = simd.sqrt(area);
    ([side, zero, zero, side], stress)
}

/// Cosine and sine of the rotation of the polar decomposition, and the length `q` of the conformal
/// part, as in [`polar`](super::super::polar).
#[inline(always)]
fn polar<S: Simd>(simd: S, [xx, xy, yx, yy]: &Matrices<S>) -> ([S::Lanes; 2], S::Lanes) {
    let half = simd.splat(0.5);
    let (a, b) = (half * (*xx + *yy), half * (*yx - *xy));
    let q = simd.sqrt(a * a + b * b);
    let irregular = simd.less(q, simd.splat(MIN_LENGTH));
    let cos = simd.select(irregular, simd.splat(1.0), a / q);
    let sin = simd.select(irregular, simd.splat(0.0), b / q);
    ([cos, sin], q)
}

/// Stiffness of rope or jelly relative to E.
#[inline(always)]
fn factor<S: Simd>(simd: S, pack: &Pack) -> S::Lanes {
    let rope = simd.splat(f32::from(Material::Rope as u8));
    let is_rope = simd.equal(simd.load(&pack.material), rope);
    simd.select(is_rope, simd.splat(ROPE_STIFFNESS), simd.splat(JELLY_STIFFNESS))
}

/// Fixed-corotated stress, given the rotations.
#[inline(always)]
fn elastic<S: Simd>(
    simd: S,
    [xx, xy, yx, yy]: &Matrices<S>,
    [cos, sin]: [S::Lanes; 2],
    factor: S::Lanes,
    moduli: &Moduli,
) -> Stress<S> {
    let (xx, xy, yx, yy) = (*xx, *xy, *yx, *yy);
    let area = xx * yy - xy * yx;
    let shear = simd.splat(2.0 * moduli.lame.mu) * factor;
    let tension = simd.splat(moduli.lame.lambda) * factor * area * (area - simd.splat(1.0));
    let (strain_xx, strain_xy) = (xx - cos, xy + sin);
    let (strain_yx, strain_yy) = (yx - sin, yy - cos);
    [
        shear * (strain_xx * xx + strain_xy * xy) + tension,
        shear * (strain_xx * yx + strain_xy * yy),
        shear * (strain_yx * yx + strain_yy * yy) + tension,
    ]
}

/// Deformation and stress of packs with snow: lanes with snow are projected onto the yield surface and harden.
#[inline(always)]
fn snow<S: Simd>(
    simd: S,
    pack: &mut Pack,
    trial: &Matrices<S>,
    is_snow: S::Mask,
    moduli: &Moduli,
) -> (Matrices<S>, Stress<S>) {
    let half = simd.splat(0.5);
    let (lowest, highest) = (simd.splat(SNOW_STRETCH[0]), simd.splat(SNOW_STRETCH[1]));
    let ([cos, sin], q) = polar(simd, trial);
    let [xx, xy, yx, yy] = *trial;
    // The anticonformal part `[[c, d], [d, -c]]`, and the singular values `q + r` and `q - r`.
    let (c, d) = (half * (xx - yy), half * (yx + xy));
    let r = simd.sqrt(c * c + d * d);
    let (large, small) = (q + r, q - r);
    let (large_kept, small_kept) =
        (simd.clamp(large, SNOW_STRETCH), simd.clamp(small, SNOW_STRETCH));
    let yields = is_snow & (simd.less(small, lowest) | simd.less(highest, large));

    let plastic = simd.load(&pack.plastic);
    let factor = simd.select(is_snow, hardening(simd, plastic), factor(simd, pack));
    let flowed = plastic * ((large * small) / (large_kept * small_kept));
    simd.store(simd.select(yields, flowed, plastic), &mut pack.plastic);

    let mean = half * (large_kept + small_kept);
    let undirected = simd.less(r, simd.splat(MIN_LENGTH));
    let stretch = half * (large_kept - small_kept);
    let stretch = simd.select(undirected, simd.splat(0.0), stretch / r);
    let (a, b, c, d) = (mean * cos, mean * sin, stretch * c, stretch * d);
    let deformation = [
        simd.select(yields, a + c, xx),
        simd.select(yields, d - b, xy),
        simd.select(yields, b + d, yx),
        simd.select(yields, a - c, yy),
    ];
    let stress = elastic(simd, &deformation, [cos, sin], factor, moduli);
    (deformation, stress)
}

/// [`sand::advanced`] in the lanes with sand, operation by operation; others keep their plastic state.
#[inline(always)]
fn grains<S: Simd>(
    simd: S,
    pack: &mut Pack,
    trial: &Matrices<S>,
    is_sand: S::Mask,
    moduli: &Moduli,
) -> (Matrices<S>, Stress<S>) {
    let (zero, one, half) = (simd.splat(0.0), simd.splat(1.0), simd.splat(0.5));
    let Lame { mu, lambda } = moduli.lame;
    let lame = Lame { mu: mu * SAND_STIFFNESS, lambda: lambda * SAND_STIFFNESS };
    let [xx, xy, yx, yy] = *trial;
    let (a, b, c, d) = (half * (xx + yy), half * (yx - xy), half * (xx - yy), half * (yx + xy));
    let (q, r) = (simd.sqrt(a * a + b * b), simd.sqrt(c * c + d * d));
    let undirected = simd.less(q, simd.splat(MIN_LENGTH)) | simd.less(r, simd.splat(MIN_LENGTH));
    let turn = |part: S::Lanes, length: S::Lanes, otherwise: S::Lanes| {
        simd.select(simd.less(length, simd.splat(MIN_LENGTH)), otherwise, part / length)
    };
    let (cos, sin) = (turn(a, q, one), turn(b, q, zero));
    let (along, across) = (turn(c, r, one), turn(d, r, zero));

    let plastic = simd.load(&pack.plastic);
    let gained = plastic - one;
    let of = |stretch: S::Lanes| logarithm(simd, simd.clamp(stretch, sand::STRETCH));
    let (large, small) = (of(q + r), of(q - r));
    let (mean, shear) = (half * (large + small + gained), half * (large - small));
    let most = simd.splat(moduli.sand_slope) * (zero - mean);
    let parts = simd.at_least(mean, zero);
    let slides = simd.less(most, shear);
    let kept = simd.select(slides, most, shear);

    // Where grains have parted, a rotation is left.
    let kept = simd.select(parts, zero, kept);
    let compressed = simd.select(parts, zero, mean);
    let changed = slides | parts | simd.less(zero, gained);
    let of_changed =
        |changed_to: S::Lanes, before: S::Lanes| simd.select(changed, changed_to, before);
    let (first, second) =
        (exponential(simd, compressed + kept), exponential(simd, compressed - kept));
    let (p, s) = (half * (first + second), half * (first - second));
    let (e, g, h, k) = (p * cos, p * sin, s * along, s * across);
    let deformation = [
        of_changed(e + h, xx),
        of_changed(k - g, xy),
        of_changed(g + k, yx),
        of_changed(e - h, yy),
    ];
    let left = simd.select(parts, one + (mean + mean), one);
    simd.store(simd.select(is_sand, left, plastic), &mut pack.plastic);

    let pressure = simd.splat(2.0 * (lame.lambda + lame.mu)) * compressed;
    let tangent = simd.splat(2.0 * lame.mu) * kept;
    let (axis_cos, axis_sin) = (cos * along - sin * across, cos * across + sin * along);
    let axis_cos = simd.select(undirected, one, axis_cos);
    let axis_sin = simd.select(undirected, zero, axis_sin);
    let (normal, shear) = (tangent * axis_cos, tangent * axis_sin);
    (deformation, [pressure + normal, shear, pressure - normal])
}

/// [`logarithm`](super::super::material::logarithm), operation by operation.
#[inline(always)]
fn logarithm<S: Simd>(simd: S, x: S::Lanes) -> S::Lanes {
    let one = simd.splat(1.0);
    let root = simd.sqrt(simd.sqrt(x));
    let z = (root - one) / (root + one);
    let square = z * z;
    let [first, rest @ ..] = LOGARITHM_SERIES;
    let mut series = simd.splat(first);
    for coefficient in rest {
        series = simd.splat(coefficient) + square * series;
    }
    z * series
}

/// [`exponential`](super::super::material::exponential), operation by operation.
#[inline(always)]
fn exponential<S: Simd>(simd: S, x: S::Lanes) -> S::Lanes {
    let x = simd.splat(0.125) * x;
    let [first, rest @ ..] = EXPONENTIAL_SERIES;
    let mut eighth = simd.splat(first);
    for coefficient in rest {
        eighth = simd.splat(coefficient) + x * eighth;
    }
    let fourth = eighth * eighth;
    let half = fourth * fourth;
    half * half
}

/// [`snow_hardening`](super::super::material::snow_hardening), operation by operation.
#[inline(always)]
fn hardening<S: Simd>(simd: S, plastic: S::Lanes) -> S::Lanes {
    let exponent = simd.splat(SNOW_HARDENING) * (simd.splat(1.0) - plastic);
    let exponent = simd.clamp(exponent, SNOW_HARDENING_EXPONENTS);
    simd.clamp(exponential(simd, exponent), SNOW_HARDENING_RANGE)
}
