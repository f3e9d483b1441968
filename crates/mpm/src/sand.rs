//! Sand: dry grains without cohesion.
//!
//! Hencky's law: the Kirchhoff stress is `2 mu e + lambda tr(e)` with the logarithms e of the singular values of F, along the axes of
//! the left stretch. Plasticity of Drucker and Prager (Klar et al. 2016, "Drucker-Prager Elastoplasticity for Sand Animation"), in two
//! dimensions that of Mohr and Coulomb: half of the difference of the principal stresses is at most `sin(phi)` times the pressure.
//! Beyond it, shear strain is lost and the area kept. Grains that are pulled apart have no stress; the area that they gain is remembered
//! and must be given back before they resist compression again (Tampubolon et al. 2017, volume correction).

use super::{
    material::{Lame, exponential, logarithm},
    matrix::Matrix2,
    polar::Decomposition,
};

/// Range of the singular values whose logarithms are taken.
pub(super) const STRETCH: [f32; 2] = [0.05, 20.0];

/// Logarithmic strains: mean and half difference of the two, the half difference is not negative.
#[derive(Clone, Copy, Debug)]
struct Strain {
    mean: f32,
    shear: f32,
}

/// The deformation that remains elastic of a trial one, the gained area (its logarithm) after it, and the Kirchhoff stress. `slope` is
/// that of [`Moduli`](super::Moduli).
#[inline]
pub(super) fn advanced(
    trial: Matrix2,
    gained: f32,
    lame: Lame,
    slope: f32,
) -> (Matrix2, f32, Matrix2) {
    let parts = Decomposition::of(trial);
    let strain = strain(parts, gained);
    // The sum of both strains: the change of the area since the grains touched.
    let area = 2.0 * strain.mean;
    if area >= 0.0 {
        return (parts.with_singular_values([1.0, 1.0]), area, Matrix2::ZERO);
    }
    let most = slope * (0.0 - strain.mean);
    let kept = Strain { shear: strain.shear.min(most), ..strain };
    let stress = stress_along(parts, kept, lame);
    if kept.shear == strain.shear && gained <= 0.0 {
        return (trial, 0.0, stress);
    }
    let [large, small] = [kept.mean + kept.shear, kept.mean - kept.shear].map(exponential);
    (parts.with_singular_values([large, small]), 0.0, stress)
}

/// Kirchhoff stress of an elastic deformation.
pub(super) fn stress(deformation: Matrix2, lame: Lame) -> Matrix2 {
    let parts = Decomposition::of(deformation);
    stress_along(parts, strain(parts, 0.0), lame)
}

fn strain(parts: Decomposition, gained: f32) -> Strain {
    let [large, small] =
        parts.singular_values().map(|stretch| logarithm(stretch.clamp(STRETCH[0], STRETCH[1])));
    Strain { mean: 0.5 * (large + small + gained), shear: 0.5 * (large - small) }
}

/// The stress of a strain along the axes of the left stretch.
fn stress_along(parts: Decomposition, strain: Strain, lame: Lame) -> Matrix2 {
    let mean = 2.0 * (lame.lambda + lame.mu) * strain.mean;
    let shear = 2.0 * lame.mu * strain.shear;
    let [cos, sin] = parts.left_axis();
    Matrix2::new(mean + shear * cos, shear * sin, shear * sin, mean - shear * cos)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const LAME: Lame = Lame { mu: 400.0, lambda: 280.0 };
    const FRICTION: f32 = 0.5;
    const SLOPE: f32 = FRICTION * 680.0 / 400.0;

    fn deformations() -> impl Strategy<Value = Matrix2> {
        (0.8f32..1.2, -0.2f32..0.2, -0.2f32..0.2, 0.8f32..1.2)
            .prop_map(|(xx, xy, yx, yy)| Matrix2::new(xx, xy, yx, yy))
    }

    fn rotated(angle: f32) -> Matrix2 {
        let (sin, cos) = angle.sin_cos();
        Matrix2::new(cos, -sin, sin, cos)
    }

    fn largest(matrix: Matrix2) -> f32 {
        [matrix.xx, matrix.xy, matrix.yx, matrix.yy].iter().fold(0.0, |m, x| x.abs().max(m))
    }

    /// Mean and half difference of the principal stresses.
    fn principal(stress: Matrix2) -> [f32; 2] {
        let half = 0.5 * (stress.xx - stress.yy);
        [0.5 * (stress.xx + stress.yy), (half * half + stress.xy * stress.xy).sqrt()]
    }

    proptest! {
        #[test]
        fn shear_stress_is_at_most_friction_and_there_is_no_tension(f in deformations(), gained in 0.0f32..0.1) {
            let (_, _, stress) = advanced(f, gained, LAME, SLOPE);
            let [mean, shear] = principal(stress);
            prop_assert!(mean <= 0.0);
            prop_assert!(shear <= FRICTION * -mean * (1.0 + 1e-4) + 1e-3, "{shear}, {mean}");
        }

        #[test]
        fn area_is_kept_or_remembered(f in deformations(), gained in 0.0f32..0.1) {
            let (kept, now, _) = advanced(f, gained, LAME, SLOPE);
            let before = f.determinant().ln() + gained;
            let after = kept.determinant().ln() + now;
            prop_assert!((after - before).abs() < 1e-5, "{before}, {after}");
        }

        #[test]
        fn what_remains_elastic_is_not_changed_again(f in deformations(), gained in 0.0f32..0.1) {
            let (kept, now, stress) = advanced(f, gained, LAME, SLOPE);
            let (again, later, same) = advanced(kept, now, LAME, SLOPE);
            prop_assert!(largest(again + kept * -1.0) < 1e-5);
            prop_assert!((later - now).abs() < 1e-5);
            prop_assert!(largest(same + stress * -1.0) < 5e-3, "{stress:?}, {same:?}");
        }

        #[test]
        fn stress_is_frame_indifferent(f in deformations(), angle in -3.1f32..3.1) {
            let q = rotated(angle);
            let seen = stress(q * f, LAME);
            let turned = q * stress(f, LAME) * q.transpose();
            prop_assert!(largest(seen + turned * -1.0) < 2e-3);
        }
    }

    #[test]
    fn small_strains_have_the_stress_of_linear_elasticity() {
        let found = stress(Matrix2::new(1.0 - 1e-3, 0.0, 0.0, 1.0), LAME);
        assert!((found.xx + (LAME.lambda + 2.0 * LAME.mu) * 1e-3).abs() < 2e-3, "{found:?}");
        assert!((found.yy + LAME.lambda * 1e-3).abs() < 2e-3, "{found:?}");
    }
}
