//! Water: weakly compressible, viscous, and without tension. Two laws, `water` and `settling`.
//!
//! Its pressure follows from the area ratio J that each particle integrates. Integrated alone, J drifts from the actual
//! density: after a splash a pool had lost a tenth of its area and compressed its lowest rows by half, both with a tension
//! cut-off and with Taichi's law, and with J capped at 1 other pools swelled by a tenth. So J is relaxed towards the density
//! of the grid, slowly compared with sound and fast compared with the drift.
//!
//! With the law `water` a pool does not rest (`tests/physics/water.rs`), and the pressure of a particle is off by as much as it is. Two
//! causes, which the law `settling` does not have:
//!
//! - At a wall half of a kernel has no matter, so that the density there seems too low and matter is compressed until the lowest row is
//!   half as dense again; the energy of its fall feeds the motion. `settling` compares a node's mass with the part of its kernel that lies
//!   between the walls.
//! - J of single particles is a null mode: what cancels within a cell moves no node, and a density that is off by half a percent has the
//!   pressure of a whole pool. With `settling` the grid has J too, the mean of the liquid around a node, relaxed towards its density, and
//!   particles follow it within the time that sound takes to cross a cell. Water that has separated has no memory of it: J is at most 1.
//!
//! The bulk modulus is the first Lame parameter of E. At E = 1000 sound runs at 16.7 domain lengths per
//! second, four times as fast as the flow; ten times the modulus moved the front of a broken dam by 1.6 %
//! at most.

use super::{
    material::{DENSITY, Law, Moduli},
    matrix::Matrix2,
};

/// Maximum J: limits the area of separated water, so that it resists soon after it merges again. Settled pools had the
/// same density with 1.02 as with 1.2, but a pool at rest began to slosh spontaneously from 1.05.
pub(super) const MAX_AREA: f32 = 1.02;

/// Relaxation time of J (s): settled pools kept their density within 2.5 %. 0.3 s was too slow for viscous splashes.
pub(super) const RELAXATION_TIME: f32 = 0.1;

/// J, at most `most`. Unlike `min`, it preserves NaN.
#[inline(always)]
pub(super) fn limited(area: f32, most: f32) -> f32 {
    if area > most { most } else { area }
}

/// The largest J of a particle.
pub(super) fn max_area(law: Law) -> f32 {
    match law {
        Law::Settling => 1.0,
        Law::Water | Law::Taichi => MAX_AREA,
    }
}

/// The area ratio J after `dt` seconds with this velocity gradient (1/s).
#[inline]
pub(super) fn advanced(area: f32, gradient: Matrix2, law: Law, dt: f32) -> f32 {
    limited(area * (Matrix2::IDENTITY + gradient * dt).determinant(), max_area(law))
}

/// J of a particle, relaxed for `dt` seconds towards the density of the grid (mass per domain length^2).
///
/// A density correction as in Zhang, Zhang, Sze and Liu 2018, "Improved incompressible material point
/// method based on particle density correction", as a relaxation of the state instead of a shift of
/// the particles.
#[inline]
pub(super) fn corrected(area: f32, density: f32, dt: f32) -> f32 {
    relaxed(area, DENSITY / density, (dt / RELAXATION_TIME).min(1.0))
}

/// J that has gone this share of the way to that of the density, at most [`MAX_AREA`].
#[inline(always)]
pub(super) fn relaxed(area: f32, by_density: f32, share: f32) -> f32 {
    area + (limited(by_density, MAX_AREA) - area) * share
}

/// Relaxation time of J with the law `settling` (s).
const SETTLING_TIME: f32 = 0.2;

/// The smallest share of liquid in the mass of a node whose J is that of its liquid: the mass of the liquid is a difference.
pub(super) const LEAST_LIQUID: f32 = 1e-4;

/// How J changes in a substep of the law `settling`, as shares of the way.
#[derive(Clone, Copy, Debug)]
pub struct Settling {
    /// Of a node to the J of its density.
    pub relaxing: f32,
    /// Of a particle to the J of the grid.
    pub following: f32,
}

impl Settling {
    /// Particles take only a part of what the grid's J changes by, which therefore goes further by as much: the time does not depend on the
    /// length of the substep.
    pub(super) fn of(moduli: &Moduli, inverse_dx: f32, dt: f32) -> Self {
        let following = (dt * (moduli.lame.lambda / DENSITY).sqrt() * inverse_dx).min(1.0);
        Self { relaxing: (dt / (SETTLING_TIME * following)).min(1.0), following }
    }

    /// J of a node: that of its liquid, from the sum of mass times J, relaxed.
    #[inline(always)]
    pub(super) fn of_node(self, mass: f32, solid: f32, area: f32, by_density: f32) -> f32 {
        let liquid = mass - solid;
        let mean = if liquid > LEAST_LIQUID * mass { area / liquid } else { 1.0 };
        relaxed(mean, by_density, self.relaxing)
    }

    /// J of a particle that has followed that of the grid.
    #[inline]
    pub(super) fn followed(self, area: f32, of_grid: f32) -> f32 {
        limited(area + (of_grid - area) * self.following, max_area(Law::Settling))
    }
}

/// Kirchhoff stress (density x velocity^2).
#[inline]
pub(super) fn stress(area: f32, gradient: Matrix2, moduli: &Moduli) -> Matrix2 {
    Matrix2::diagonal(-area * pressure(area, moduli.lame.lambda))
        + deviator(gradient) * (2.0 * moduli.viscosity * area)
}

/// Tait's pressure with the exponent 7, none in tension (Becker and Teschner 2007, "Weakly
/// compressible SPH for free surface flows", equation 7).
#[inline]
pub(super) fn pressure(area: f32, bulk_modulus: f32) -> f32 {
    let packed = 1.0 / area;
    let squared = packed * packed;
    let pressure = bulk_modulus / 7.0 * (squared * squared * squared * packed - 1.0);
    if pressure < 0.0 { 0.0 } else { pressure }
}

/// The part of the rate of deformation that keeps the area: `sym(C) - tr(C)/2 I`.
#[inline]
fn deviator(gradient: Matrix2) -> Matrix2 {
    let shear = 0.5 * (gradient.xy + gradient.yx);
    let stretch = 0.5 * (gradient.xx - gradient.yy);
    Matrix2::new(stretch, shear, shear, -stretch)
}

#[cfg(test)]
mod tests {
    use super::{
        super::{energy, material::Materials},
        *,
    };

    fn moduli(viscosity: f32) -> Moduli {
        Moduli::of(&Materials { law: Law::Water, viscosity, ..Materials::default() })
    }

    #[test]
    fn pressure_is_the_derivative_of_the_energy_and_never_pulls() {
        let bulk_modulus = moduli(0.0).lame.lambda;
        for area in [0.8f32, 0.9, 0.97, 0.995, 1.0, 1.01] {
            let expected = -energy::tait_slope(area.into(), bulk_modulus.into());
            let found = f64::from(pressure(area, bulk_modulus));
            assert!((found - expected).abs() <= 1e-4 * expected.abs().max(1.0), "{area}");
            assert!(found >= 0.0);
        }
    }

    #[test]
    fn the_bulk_modulus_is_the_slope_at_rest() {
        let bulk_modulus = 278.0;
        let slope = pressure(0.999, bulk_modulus) / 0.001;
        assert!((slope / bulk_modulus - 1.0).abs() < 0.01, "{slope}");
    }

    #[test]
    fn viscosity_resists_shear_and_not_spin_or_swelling() {
        let moduli = moduli(0.5);
        let still = |gradient| stress(1.0, gradient, &moduli) == Matrix2::ZERO;
        assert!(still(Matrix2::new(0.0, -3.0, 3.0, 0.0)) && still(Matrix2::diagonal(2.0)));
        // mu du/dy, on both sides of the diagonal.
        let sheared = stress(1.0, Matrix2::new(0.0, 3.0, 0.0, 0.0), &moduli);
        assert_eq!(sheared, Matrix2::new(0.0, 1.5, 1.5, 0.0));
    }

    #[test]
    fn the_area_relaxes_to_the_density() {
        for (density, expected) in [(1.1, 1.0 / 1.1), (1.0, 1.0), (0.5, MAX_AREA)] {
            for start in [0.9, 1.0, MAX_AREA] {
                let after = (0..1000).fold(start, |area, _| corrected(area, density, 1e-3));
                assert!((after - expected).abs() < 1e-3, "{density} {start}: {after}");
            }
        }
        assert_eq!(corrected(0.9, 1.0, 1e9), 1.0);
    }
}
