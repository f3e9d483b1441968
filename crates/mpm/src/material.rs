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
pub(super) const SNOW_HARDENING_SERIES: [f32; 7] =
    [1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0];

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
}

impl Default for Materials {
    fn default() -> Self {
        Self { stiffness: 1e3, law: Law::default(), viscosity: 0.0 }
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
}

impl Moduli {
    /// The moduli of these materials.
    pub(super) fn of(materials: &Materials) -> Self {
        let Materials { stiffness, law, viscosity } = *materials;
        Self { lame: Lame::of(stiffness), law, viscosity: viscosity * DENSITY }
    }
}

/// The factor on both Lame parameters. `plastic` is Jp, the plastic area ratio of snow: below 1 where it is compressed.
pub(super) fn hardening(material: Material, plastic: f32) -> f32 {
    match material {
        Material::Liquid => 1.0,
        Material::Snow => snow_hardening(plastic),
        Material::Jelly => JELLY_STIFFNESS,
        Material::Rope => ROPE_STIFFNESS,
    }
}

/// `exp(10 (1 - Jp))`, clamped. Uses sums and products only, so that it gives the same bits on every machine and with all
/// vector instructions: the Taylor series of an eighth of the exponent, raised to the eighth power. The relative error is
/// below 1e-6.
pub(super) fn snow_hardening(plastic: f32) -> f32 {
    let [softest, hardest] = SNOW_HARDENING_RANGE;
    let [least, most] = SNOW_HARDENING_EXPONENTS;
    let x = 0.125 * (SNOW_HARDENING * (1.0 - plastic)).clamp(least, most);
    let [first, rest @ ..] = SNOW_HARDENING_SERIES;
    let eighth = rest.into_iter().fold(first, |sum, coefficient| coefficient + x * sum);
    let fourth = eighth * eighth;
    let half = fourth * fourth;
    (half * half).clamp(softest, hardest)
}

#[cfg(test)]
mod tests {
    use super::*;

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
