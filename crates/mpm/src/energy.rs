//! The energy of a simulation, in double precision.

use serde::{Deserialize, Serialize};

#[cfg(test)]
use super::material::Lame;
use super::{
    material::{DENSITY, Law, Moduli, hardening},
    matrix::Matrix2,
    particle::Particle,
    sand,
    solver::SolverSettings,
};
use eddy_frames::Material;

/// Energy of all particles (density x domain lengths^4 per s^2).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Energy {
    /// Kinetic energy, including the affine motion around particles (APIC).
    pub kinetic: f64,
    /// Elastic energy of deformation.
    pub elastic: f64,
    /// Potential energy relative to y = 0.
    pub potential: f64,
}

/// Fixed-corotated energy per area: `mu |F - R|^2 + lambda/2 (J - 1)^2`. `f` is `[[xx, xy], [yx, yy]]`.
fn elastic(f: [[f64; 2]; 2], mu: f64, lambda: f64) -> f64 {
    let [[xx, xy], [yx, yy]] = f;
    // |F - R|^2 = (s1 - 1)^2 + (s2 - 1)^2 with s = q +- r, as in `polar`.
    // Not `hypot`, which takes several times as long; entries are neither tiny nor huge.
    let length = |a: f64, b: f64| (a * a + b * b).sqrt();
    let (q, r) = (0.5 * length(xx + yy, yx - xy), 0.5 * length(xx - yy, yx + xy));
    let area = xx * yy - xy * yx;
    mu * ((q + r - 1.0).powi(2) + (q - r - 1.0).powi(2)) + 0.5 * lambda * (area - 1.0).powi(2)
}

/// Energy per area of sand: `mu |e|^2 + lambda/2 tr(e)^2` with the logarithms e of the singular values.
fn hencky([[xx, xy], [yx, yy]]: [[f64; 2]; 2], mu: f64, lambda: f64) -> f64 {
    let (q, r) = (0.5 * (xx + yy).hypot(yx - xy), 0.5 * (xx - yy).hypot(yx + xy));
    let [lowest, highest] = sand::STRETCH.map(f64::from);
    let [large, small] = [q + r, q - r].map(|stretch| stretch.clamp(lowest, highest).ln());
    mu * (large * large + small * small) + 0.5 * lambda * (large + small).powi(2)
}

/// Energy per area of water: the work of Tait's pressure, `K/7 (J^-6/6 + J - 7/6)`, none in tension.
fn tait([[xx, xy], [yx, yy]]: [[f64; 2]; 2], bulk_modulus: f64) -> f64 {
    let area = (xx * yy - xy * yx).min(1.0);
    bulk_modulus / 7.0 * (area.powi(-6) / 6.0 + area - 7.0 / 6.0)
}

/// Derivative of [`tait`] by central differences.
#[cfg(test)]
pub(super) fn tait_slope(area: f64, bulk_modulus: f64) -> f64 {
    const STEP: f64 = 1e-6;
    let energy = |area: f64| tait([[area, 0.0], [0.0, 1.0]], bulk_modulus);
    (energy(area + STEP) - energy(area - STEP)) / (2.0 * STEP)
}

fn double(f: Matrix2) -> [[f64; 2]; 2] {
    [[f.xx.into(), f.xy.into()], [f.yx.into(), f.yy.into()]]
}

impl Energy {
    /// The energy of these particles, in a simulation with these settings.
    pub fn of(particles: &[Particle], settings: &SolverSettings) -> Self {
        let moduli = Moduli::of(&settings.materials);
        let volume = f64::from(settings.spacing).powi(2);
        let mass = f64::from(DENSITY) * volume;
        let inertia = f64::from(settings.grid.dx).powi(2) / 4.0;
        let mut sum = Self { kinetic: 0.0, elastic: 0.0, potential: 0.0 };
        for particle in particles {
            let [u, v] = particle.velocity.map(f64::from);
            let affine: f64 = double(particle.affine).as_flattened().iter().map(|c| c * c).sum();
            sum.kinetic += 0.5 * mass * (u * u + v * v + inertia * affine);
            sum.elastic += volume * stored(particle, &moduli);
            sum.potential -= mass * f64::from(settings.gravity) * f64::from(particle.position[1]);
        }
        sum
    }

    /// Total energy.
    pub fn total(&self) -> f64 {
        self.kinetic + self.elastic + self.potential
    }
}

/// Elastic energy of a particle per area.
fn stored(particle: &Particle, moduli: &Moduli) -> f64 {
    let f = double(particle.deformation);
    let factor = f64::from(hardening(particle.material, particle.plastic));
    let (mu, lambda) = (f64::from(moduli.lame.mu), f64::from(moduli.lame.lambda));
    match (particle.material, moduli.law) {
        (Material::Liquid, Law::Water | Law::Settling) => tait(f, lambda),
        (Material::Liquid, Law::Taichi) => elastic(f, 0.0, lambda),
        (Material::Sand, _) => hencky(f, mu * factor, lambda * factor),
        _ => elastic(f, mu * factor, lambda * factor),
    }
}

/// Kirchhoff stress `(d psi / d F) F^T` by central differences.
#[cfg(test)]
pub(super) fn kirchhoff_by_differences(f: Matrix2, lame: Lame) -> Matrix2 {
    const STEP: f64 = 1e-5;
    let (mu, lambda) = (f64::from(lame.mu), f64::from(lame.lambda));
    let f = double(f);
    let slope = |row: usize, column: usize| {
        let moved = |by: f64| {
            let mut f = f;
            f[row][column] += by;
            elastic(f, mu, lambda)
        };
        (moved(STEP) - moved(-STEP)) / (2.0 * STEP)
    };
    let stress = |row: usize, column: usize| {
        (slope(row, 0) * f[column][0] + slope(row, 1) * f[column][1]) as f32
    };
    Matrix2::new(stress(0, 0), stress(0, 1), stress(1, 0), stress(1, 1))
}
