//! What the solver knows of every particle beside its motion: pressure and energy.

use super::{
    constitutive,
    energy::Energy,
    material::{DENSITY, Lame, Moduli, hardening},
    particle::Particle,
    sand,
    solver::SolverSettings,
    water,
};
use eddy_frames::Material;

/// Pressure and energy of every particle, `[N]` each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ParticleState {
    /// Pressure (density x domain lengths^2 per s^2): minus the mean of the normal Cauchy stresses, without viscosity.
    pub pressure: Vec<f32>,
    /// Kinetic, elastic and potential energy per mass (domain lengths^2 per s^2).
    pub energy: Vec<f32>,
}

impl ParticleState {
    /// The state of these particles, in a simulation with these settings.
    pub(super) fn of(particles: &[Particle], settings: &SolverSettings) -> Self {
        let moduli = Moduli::of(&settings.materials);
        let mass = f64::from(DENSITY) * f64::from(settings.spacing).powi(2);
        let energy = |particle: &Particle| {
            (Energy::of(std::slice::from_ref(particle), settings).total() / mass) as f32
        };
        Self {
            pressure: particles.iter().map(|particle| pressure(particle, &moduli)).collect(),
            energy: particles.iter().map(energy).collect(),
        }
    }
}

fn pressure(particle: &Particle, moduli: &Moduli) -> f32 {
    let Particle { deformation, material, plastic, .. } = *particle;
    let area = deformation.determinant();
    if material == Material::Liquid && moduli.law.is_water() {
        return water::pressure(area, moduli.lame.lambda);
    }
    let factor = hardening(material, plastic);
    // Taichi's liquids have no shear modulus.
    let shear = if material == Material::Liquid { 0.0 } else { moduli.lame.mu * factor };
    let lame = Lame { mu: shear, lambda: moduli.lame.lambda * factor };
    let stress = match material {
        Material::Sand => sand::stress(deformation, lame),
        _ => constitutive::stress(deformation, lame),
    };
    // Kirchhoff stress is Cauchy stress times the area ratio.
    -0.5 * (stress.xx + stress.yy) / area
}

#[cfg(test)]
mod tests {
    use super::super::{Law, Preset, Scene, Settings, Simulation, matrix::Matrix2};
    use super::*;

    #[test]
    fn the_energies_of_all_particles_are_the_energy_of_the_simulation() {
        let scene = Scene::generate(Preset::MultiMaterial, 5, 3);
        let settings = Settings { duration: Some(0.2), ..Settings::default() };
        let mut simulation = Simulation::new(scene, &settings).unwrap();
        while let Some(frame) = simulation.next_frame().unwrap() {
            let state = simulation.particle_state();
            assert_eq!((state.pressure.len(), state.energy.len()), (frame.len(), frame.len()));
            let mass = f64::from(simulation.scene().spacing()).powi(2);
            let sum: f64 = state.energy.iter().map(|&energy| mass * f64::from(energy)).sum();
            let expected = simulation.energy().total();
            assert!((sum / expected - 1.0).abs() < 1e-4, "{sum}, {expected}");
        }
    }

    #[test]
    fn pressure_is_positive_under_compression_and_water_has_no_tension() {
        let lame = Lame { mu: 400.0, lambda: 280.0 };
        let moduli = Moduli { lame, law: Law::Water, viscosity: 0.0, sand_slope: 1.0 };
        let of = |material, stretch: f32| {
            let mut particle = Particle::at_rest([0.5, 0.5], material);
            particle.deformation = Matrix2::diagonal(stretch);
            pressure(&particle, &moduli)
        };
        for material in Material::ALL {
            assert!(of(material, 0.99) > 1.0, "{material:?}: {}", of(material, 0.99));
            assert!(of(material, 1.0).abs() < 1e-3, "{material:?}");
        }
        assert_eq!(of(Material::Liquid, 1.01), 0.0);
        assert!(of(Material::Jelly, 1.01) < -1.0);
        // Small strains: both moduli resist, -2 (mu + lambda) per linear strain, times the hardening of jelly.
        let factor = hardening(Material::Jelly, 1.0);
        let expected = 2.0 * (lame.mu + lame.lambda) * factor * 1e-3;
        let found = of(Material::Jelly, 1.0 - 1e-3);
        assert!((found / expected - 1.0).abs() < 0.02, "{found}, {expected}");
    }
}
