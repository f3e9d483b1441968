//! The constitutive model: elastic trial, plastic correction and Kirchhoff stress of the fixed-corotated law.
//!
//! `F <- (I + dt C) F`; snow is projected onto its yield surface, liquids discard their shear deformation ([`water`] and
//! [`sand`] have laws of their own); then `tau = 2 mu (F - R) F^T + lambda J (J - 1) I` with hardened mu and lambda
//! (Stomakhin et al. 2012, "Energetically Consistent Invertible Elasticity").

use super::{
    material::{Lame, Law, Moduli, SNOW_STRETCH, hardening},
    matrix::Matrix2,
    particle::Particle,
    polar::{self, Decomposition},
    sand, water,
};
use eddy_frames::Material;

/// Advances the deformation of a particle by `dt` seconds and returns its Kirchhoff stress (density x velocity^2).
#[inline]
pub(super) fn advance(particle: &mut Particle, moduli: &Moduli, dt: f32) -> Matrix2 {
    let trial = (Matrix2::IDENTITY + particle.affine * dt) * particle.deformation;
    let factor = hardening(particle.material, particle.plastic);
    let lame = Lame { mu: moduli.lame.mu * factor, lambda: moduli.lame.lambda * factor };
    match particle.material {
        Material::Liquid => {
            let (area, stress) = match moduli.law {
                Law::Taichi => {
                    let area = trial.determinant();
                    (area, Matrix2::diagonal(pressure(lame, area)))
                }
                Law::Water | Law::Settling => {
                    let before = particle.deformation.determinant();
                    let area = water::advanced(before, particle.affine, moduli.law, dt);
                    (area, water::stress(area, particle.affine, moduli))
                }
            };
            particle.deformation = Matrix2::diagonal(area.sqrt());
            stress
        }
        Material::Snow => {
            let (elastic, flow) = project_to_yield_surface(trial);
            particle.deformation = elastic;
            particle.plastic *= flow;
            stress(elastic, lame)
        }
        Material::Jelly | Material::Rope => {
            particle.deformation = trial;
            stress(trial, lame)
        }
        Material::Sand => {
            let gained = particle.plastic - 1.0;
            let (elastic, gained, stress) = sand::advanced(trial, gained, lame, moduli.sand_slope);
            particle.deformation = elastic;
            particle.plastic = 1.0 + gained;
            stress
        }
    }
}

/// Changes the area of a liquid.
#[inline]
pub(super) fn correct_area(particle: &mut Particle, corrected: impl FnOnce(f32) -> f32) {
    if particle.material == Material::Liquid {
        let area = corrected(particle.deformation.determinant());
        particle.deformation = Matrix2::diagonal(area.sqrt());
    }
}

/// Kirchhoff stress of the fixed-corotated law.
pub(super) fn stress(deformation: Matrix2, lame: Lame) -> Matrix2 {
    let strain = deformation + polar::rotation(deformation) * -1.0;
    let shear = strain * deformation.transpose() * (2.0 * lame.mu);
    shear + Matrix2::diagonal(pressure(lame, deformation.determinant()))
}

/// The volumetric part of the stress, positive in tension.
fn pressure(lame: Lame, area: f32) -> f32 {
    lame.lambda * area * (area - 1.0)
}

/// The elastic part of a trial deformation of snow, with its singular values clamped to [`SNOW_STRETCH`], and the factor
/// on Jp that compensates the clamp.
fn project_to_yield_surface(trial: Matrix2) -> (Matrix2, f32) {
    let [lowest, highest] = SNOW_STRETCH;
    let parts = Decomposition::of(trial);
    let [large, small] = parts.singular_values();
    if small >= lowest && large <= highest {
        return (trial, 1.0);
    }
    let clamped = [large.clamp(lowest, highest), small.clamp(lowest, highest)];
    let flow = (large / clamped[0]) * (small / clamped[1]);
    (parts.with_singular_values(clamped), flow)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::{super::energy, *};

    const LAME: Lame = Lame { mu: 0.7, lambda: 0.4 };

    fn rotated(angle: f32) -> Matrix2 {
        let (sin, cos) = angle.sin_cos();
        Matrix2::new(cos, -sin, sin, cos)
    }

    fn largest(matrix: Matrix2) -> f32 {
        [matrix.xx, matrix.xy, matrix.yx, matrix.yy].iter().fold(0.0, |m, x| x.abs().max(m))
    }

    fn deformations() -> impl Strategy<Value = Matrix2> {
        (0.6f32..1.6, -0.4f32..0.4, -0.4f32..0.4, 0.6f32..1.6)
            .prop_map(|(xx, xy, yx, yy)| Matrix2::new(xx, xy, yx, yy))
    }

    proptest! {
        #[test]
        fn a_rotation_gives_no_stress(angle in -3.1f32..3.1) {
            prop_assert!(largest(stress(rotated(angle), LAME)) < 1e-5);
        }

        #[test]
        fn stress_is_frame_indifferent(f in deformations(), angle in -3.1f32..3.1) {
            let q = rotated(angle);
            let seen = stress(q * f, LAME);
            let turned = q * stress(f, LAME) * q.transpose();
            prop_assert!(largest(seen + turned * -1.0) < 1e-5);
        }

        #[test]
        fn stress_is_the_derivative_of_the_energy(f in deformations()) {
            let expected = energy::kirchhoff_by_differences(f, LAME);
            let found = stress(f, LAME);
            prop_assert!(largest(found + expected * -1.0) < 1e-4, "{found:?} {expected:?}");
        }

        #[test]
        fn snow_stays_on_or_inside_its_yield_surface_and_keeps_its_area(f in deformations()) {
            let (elastic, flow) = project_to_yield_surface(f);
            let [large, small] = Decomposition::of(elastic).singular_values();
            prop_assert!(small >= SNOW_STRETCH[0] - 1e-6 && large <= SNOW_STRETCH[1] + 1e-6);
            let area = elastic.determinant() * flow;
            prop_assert!((area - f.determinant()).abs() < 1e-5);
        }
    }

    #[test]
    fn snow_hardens_up_to_its_bounds_when_packed() {
        assert_eq!(hardening(Material::Snow, 1.0), 1.0);
        assert_eq!(hardening(Material::Snow, 0.5), 5.0);
        assert_eq!(hardening(Material::Snow, 2.0), 0.1);
    }

    #[test]
    fn a_liquid_keeps_its_area_and_forgets_its_shape() {
        let mut particle = Particle::at_rest([0.5, 0.5], Material::Liquid);
        particle.affine = Matrix2::new(2.0, 3.0, -1.0, 1.0);
        let moduli = Moduli { lame: LAME, law: Law::Taichi, viscosity: 0.0, sand_slope: 1.0 };
        let stress = advance(&mut particle, &moduli, 0.1);
        let area = 1.2 * 1.1 + 0.3 * 0.1;
        assert!((particle.deformation.determinant() - area).abs() < 1e-6);
        assert_eq!((particle.deformation.xy, particle.deformation.yx), (0.0, 0.0));
        assert_eq!((stress.xy, stress.yx), (0.0, 0.0));
    }
}
