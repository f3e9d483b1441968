//! Material parameters: density, stiffness, hardening, speed of sound.
//!
//! Values of Taichi's `mpm99` and `mpm128` examples, which follow Hu et al., "A Moving Least
//! Squares Material Point Method", ACM TOG 37(4), 2018, and, for snow, Stomakhin et al., "A Material
//! Point Method for Snow Simulation", ACM TOG 32(4), 2013.

use serde::{Deserialize, Serialize};

use eddy_frames::Material;

/// Mass per area of every material (1 unit of mass per domain length^2).
pub(super) const DENSITY: f32 = 1.0;
/// Poisson's ratio of every material.
pub(super) const POISSON_RATIO: f32 = 0.2;

/// Stiffness of jelly relative to E.
pub(super) const JELLY_STIFFNESS: f32 = 0.3;
/// Stiffness of rope relative to E: it barely stretches and bends under its own weight.
pub(super) const ROPE_STIFFNESS: f32 = 2.0;
/// Hardening of snow with plastic compression: h = exp(10 (1 - Jp)).
pub(super) const SNOW_HARDENING: f32 = 10.0;
/// Bounds of the hardening of snow.
pub(super) const SNOW_HARDENING_RANGE: [f32; 2] = [0.1, 5.0];
/// Their logarithms, rounded outwards.
pub(super) const SNOW_HARDENING_EXPONENTS: [f32; 2] = [-2.31, 1.62];

/// Taylor series of the exponential to degree 6, the highest power first.
pub(super) const EXPONENTIAL_SERIES: [f32; 7] =
    [1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0];
/// Series of 8 artanh(z) / z in z^2, the highest power first.
pub(super) const LOGARITHM_SERIES: [f32; 5] = [8.0 / 9.0, 8.0 / 7.0, 8.0 / 5.0, 8.0 / 3.0, 8.0];

/// Stiffness of sand relative to E.
pub(super) const SAND_STIFFNESS: f32 = 1.0;
/// Angle of internal friction of sand (degrees) by default: that of dry sand.
const SAND_FRICTION_DEGREES: f32 = 31.0;

/// Minimum and maximum elastic stretch of snow before it yields.
pub(super) const SNOW_STRETCH: [f32; 2] = [1.0 - 2.5e-2, 1.0 + 4.5e-3];

/// The constitutive law of liquids.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Law {
    /// Weakly compressible water: Tait's pressure without tension, and viscosity.
    Water,
    /// As `water`, with a pressure that varies smoothly and a density that knows the walls, so that it comes to rest.
    #[default]
    Settling,
    /// The law of Taichi's `mpm128`: the volumetric part of the solids' law, including tension.
    Taichi,
}

impl Law {
    /// Whether it has Tait's pressure and viscosity.
    pub fn is_water(self) -> bool {
        match self {
            Self::Water | Self::Settling => true,
            Self::Taichi => false,
        }
    }
}

/// Material settings of a simulation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Materials {
    /// Young's modulus E of every material (density x velocity^2); 1000 by default.
    pub stiffness: f32,
    /// The constitutive law of liquids.
    pub law: Law,
    /// Kinematic viscosity of liquids (domain lengths^2 per s); 0 by default.
    pub viscosity: f32,
    /// Coulomb's coefficient of friction of all matter at the walls; 0 by default: matter slips along them.
    #[serde(skip_serializing_if = "is_zero")]
    pub wall_friction: f32,
    /// Angle of internal friction of sand (degrees), at most 60; 31 by default, that of dry sand.
    #[serde(skip_serializing_if = "is_of_dry_sand")]
    pub friction_angle_degrees: f32,
}

fn is_zero(number: &f32) -> bool {
    *number == 0.0
}

fn is_of_dry_sand(degrees: &f32) -> bool {
    *degrees == SAND_FRICTION_DEGREES
}

impl Default for Materials {
    fn default() -> Self {
        Self {
            stiffness: 1e3,
            law: Law::default(),
            viscosity: 0.0,
            wall_friction: 0.0,
            friction_angle_degrees: SAND_FRICTION_DEGREES,
        }
    }
}

/// The Lame parameters of a stiffness, before hardening.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lame {
    /// Shear modulus mu (density x velocity^2).
    pub mu: f32,
    /// First parameter lambda (density x velocity^2).
    pub lambda: f32,
}

impl Lame {
    /// The parameters for Young's modulus `stiffness` (density x velocity^2).
    pub(super) fn of(stiffness: f32) -> Self {
        let nu = POISSON_RATIO;
        Self {
            mu: stiffness / (2.0 * (1.0 + nu)),
            lambda: stiffness * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)),
        }
    }

    /// Maximum speed of sound in a material (domain lengths per second): of pressure waves, for snow at maximum hardening.
    pub(super) fn sound_speed(self, material: Material) -> f32 {
        let modulus = match material {
            Material::Liquid => self.lambda,
            Material::Snow => (self.lambda + 2.0 * self.mu) * SNOW_HARDENING_RANGE[1],
            Material::Jelly => (self.lambda + 2.0 * self.mu) * JELLY_STIFFNESS,
            Material::Rope => (self.lambda + 2.0 * self.mu) * ROPE_STIFFNESS,
            Material::Sand => (self.lambda + 2.0 * self.mu) * SAND_STIFFNESS,
        };
        (modulus / DENSITY).sqrt()
    }
}

/// Parameters of the constitutive law, from [`Materials`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Moduli {
    /// The parameters before hardening.
    pub lame: Lame,
    /// The constitutive law of liquids.
    pub law: Law,
    /// Dynamic viscosity of liquids (density x domain lengths^2 per s).
    pub viscosity: f32,
    /// The largest half difference of the logarithmic strains of sand relative to its mean compression:
    /// `2 mu shear <= sin(phi) 2 (lambda + mu) mean`.
    pub sand_slope: f32,
}

impl Moduli {
    /// The moduli of these materials.
    pub(super) fn of(materials: &Materials) -> Self {
        let Materials { stiffness, law, viscosity, friction_angle_degrees, .. } = *materials;
        let lame = Lame::of(stiffness);
        // With the same bits on every machine.
        let friction = libm::sinf(friction_angle_degrees.to_radians());
        let sand_slope = friction * (lame.lambda + lame.mu) / lame.mu;
        Self { lame, law, viscosity: viscosity * DENSITY, sand_slope }
    }
}

/// The factor on both Lame parameters. `plastic` is Jp, the plastic area ratio of snow: below 1 where it is compressed.
pub(super) fn hardening(material: Material, plastic: f32) -> f32 {
    match material {
        Material::Liquid => 1.0,
        Material::Snow => snow_hardening(plastic),
        Material::Jelly => JELLY_STIFFNESS,
        Material::Rope => ROPE_STIFFNESS,
        Material::Sand => SAND_STIFFNESS,
    }
}

/// `exp(10 (1 - Jp))`, clamped; the same bits on every machine and with all vector instructions.
pub(super) fn snow_hardening(plastic: f32) -> f32 {
    let [softest, hardest] = SNOW_HARDENING_RANGE;
    let [least, most] = SNOW_HARDENING_EXPONENTS;
    exponential((SNOW_HARDENING * (1.0 - plastic)).clamp(least, most)).clamp(softest, hardest)
}

/// `exp(x)` for x of -3 to 3, by sums and products only: the Taylor series of an eighth of x, raised to the eighth power. The
/// relative error is below 3e-6, for x of -2.31 to 1.62 below 1e-6.
pub(super) fn exponential(x: f32) -> f32 {
    let x = 0.125 * x;
    let [first, rest @ ..] = EXPONENTIAL_SERIES;
    let eighth = rest.into_iter().fold(first, |sum, coefficient| coefficient + x * sum);
    let fourth = eighth * eighth;
    let half = fourth * fourth;
    half * half
}

/// `ln(x)` for x of .05 to 20, by square roots and the series of the area tangent: 8 artanh((r - 1) / (r + 1)) with r the
/// fourth root. The error is below 2e-5, for x of .8 to 1.25 below 1e-6.
pub(super) fn logarithm(x: f32) -> f32 {
    let root = x.sqrt().sqrt();
    let z = (root - 1.0) / (root + 1.0);
    let square = z * z;
    let [first, rest @ ..] = LOGARITHM_SERIES;
    let series = rest.into_iter().fold(first, |sum, coefficient| coefficient + square * sum);
    z * series
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponential_and_logarithm_are_those_of_the_library() {
        for k in 0..=600 {
            let x = 0.01 * k as f32 - 3.0;
            let ratio = f64::from(exponential(x)) / f64::from(x).exp();
            let most = if (-2.31..1.62).contains(&x) { 1e-6 } else { 3e-6 };
            assert!((ratio - 1.0).abs() < most, "exp({x}): {ratio}");
            let x = f64::from(x).exp() as f32;
            let error = (f64::from(logarithm(x)) - f64::from(x).ln()).abs();
            let most = if (0.8..1.25).contains(&x) { 1e-6 } else { 2e-5 };
            assert!(error < most, "ln({x}): {error}");
        }
        assert_eq!((exponential(0.0), logarithm(1.0)), (1.0, 0.0));
    }

    #[test]
    fn snow_hardens_with_the_exponential_of_its_plastic_compression() {
        for k in 0..=300 {
            let plastic = 0.8 + 0.0015 * k as f32;
            let expected = (10.0 * (1.0 - f64::from(plastic))).exp().clamp(0.1, 5.0);
            let found = f64::from(snow_hardening(plastic));
            assert!((found / expected - 1.0).abs() < 1e-6, "{plastic}: {found}, {expected}");
        }
    }
}
