//! Whether matter is in a state that the laws describe: its energy has not grown, and it is not crushed.

use super::{
    energy::Energy, error::Collapse, material::DENSITY, particle::Particle, solver::SolverSettings,
};
use eddy_frames::Material;

/// Growth of the energy that rounding and the law of water may cause. In scenes of all presets it did not grow by a thousandth.
const GROWTH: f64 = 0.02;
/// The same per mass, for scenes that begin with little energy (domain lengths^2 per s^2).
const LEAST_GROWTH: f64 = 1e-2;
/// Fraction of its area to which matter may be compressed. The stress of a solid grows with compression down to half of its width
/// only.
const LEAST_AREA: f32 = 0.1;
/// Fraction of a body's particles that may be compressed further: single particles between two bodies are.
const CRUSHED: f32 = 0.02;
/// Particles in a cell, relative to undeformed matter.
const MOST_DENSE: f32 = 16.0;

/// Checks particles with this energy, which have had or got `budget` (density x domain lengths^4 per s^2).
///
/// # Errors
/// The index of a particle, and what is wrong.
pub(super) fn check(
    particles: &[Particle],
    settings: &SolverSettings,
    energy: &Energy,
    budget: f64,
) -> Result<(), (usize, Collapse)> {
    let mass = f64::from(DENSITY * settings.volume()) * particles.len() as f64;
    let most = budget * (1.0 + GROWTH) + mass * LEAST_GROWTH;
    let total = energy.total();
    // Not finite is too much, too.
    if total.is_nan() || total > most {
        return Err((fastest(particles), Collapse::Energy(total, most)));
    }
    crushed(particles)?;
    dense(particles, settings)
}

/// The index of the fastest particle.
fn fastest(particles: &[Particle]) -> usize {
    let speed = |particle: &Particle| particle.velocity[0].hypot(particle.velocity[1]);
    let speeds = particles.iter().map(speed).enumerate();
    speeds.max_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(index, _)| index)
}

/// Checks that few particles of each material are compressed too far.
fn crushed(particles: &[Particle]) -> Result<(), (usize, Collapse)> {
    let (mut count, mut crushed) = ([0u32; Material::COUNT], [0u32; Material::COUNT]);
    let mut worst = [(0, f32::INFINITY); Material::COUNT];
    for (index, particle) in particles.iter().enumerate() {
        let kind = particle.material as usize;
        let area = particle.deformation.determinant() * particle.plastic;
        count[kind] += 1;
        if area < LEAST_AREA {
            crushed[kind] += 1;
            if area < worst[kind].1 {
                worst[kind] = (index, area);
            }
        }
    }
    for kind in 0..Material::COUNT {
        if crushed[kind] as f32 > CRUSHED * count[kind] as f32 {
            let (index, area) = worst[kind];
            return Err((index, Collapse::Crushed(area)));
        }
    }
    Ok(())
}

/// Checks that no cell has too many particles.
fn dense(particles: &[Particle], settings: &SolverSettings) -> Result<(), (usize, Collapse)> {
    let SolverSettings { grid, spacing, .. } = *settings;
    let usual = (grid.dx / spacing).powi(2);
    let most = (MOST_DENSE * usual).max(MOST_DENSE) as u32;
    // Counts in the box around the particles: a grid may have far more cells.
    let place = |particle: &Particle| particle.position.map(|x| (x / grid.dx) as usize);
    let (mut lower, mut upper) = ([usize::MAX; 2], [0; 2]);
    for particle in particles {
        let place = place(particle);
        for axis in 0..2 {
            lower[axis] = lower[axis].min(place[axis]);
            upper[axis] = upper[axis].max(place[axis] + 1);
        }
    }
    let cell = |particle: &Particle| {
        let [x, y] = place(particle);
        (x - lower[0]) * (upper[1] - lower[1]) + y - lower[1]
    };
    let sides = [0, 1].map(|axis| upper[axis].saturating_sub(lower[axis]));
    let mut counts = vec![0u32; sides[0] * sides[1]];
    for (index, particle) in particles.iter().enumerate() {
        let count = &mut counts[cell(particle)];
        *count += 1;
        if *count > most {
            let all = particles.iter().filter(|other| cell(other) == cell(particle)).count();
            return Err((index, Collapse::Dense(all as u32, usual)));
        }
    }
    Ok(())
}
