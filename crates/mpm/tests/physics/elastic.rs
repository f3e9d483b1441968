//! Sound in a bar.

use eddy_frames::Material;
use eddy_mpm::{GridShape, Materials, Particle, Solver};

use super::{block, settings};

/// Length of the bar: two quarters of a wave, each with its clamp in the middle (domain lengths).
const LENGTH: f32 = 0.5;
/// Thickness of the bar (domain lengths).
const THICKNESS: f32 = 0.125;

/// How much the particles swing in the bar's first mode: both ends move out, the middle rests.
fn swing(particles: &[Particle], shape: &[f32]) -> f32 {
    particles.iter().zip(shape).map(|(particle, shape)| particle.velocity[0] * shape).sum()
}

/// Period of the first mode of a free bar of jelly (s): five half swings between zeros.
fn period(cells: u32) -> f32 {
    let grid = GridShape::unit(cells);
    let settings = super::SolverSettings {
        gravity: 0.0,
        ..settings(grid, Material::Jelly, Materials::default())
    };
    let count = |length: f32| (length / settings.spacing).round() as usize;
    let corner = [0.5 - 0.5 * LENGTH, 0.5 - 0.5 * THICKNESS];
    let size = [count(LENGTH), count(THICKNESS)];
    let mut particles = block(corner, size, settings.spacing, Material::Jelly);
    let wave = std::f32::consts::PI / LENGTH;
    let shape: Vec<f32> =
        particles.iter().map(|p| -(wave * (p.position[0] - corner[0])).cos()).collect();
    for (particle, shape) in particles.iter_mut().zip(&shape) {
        particle.velocity[0] = 0.05 * shape;
    }
    let mut solver = Solver::new(particles, settings).unwrap();
    let mut zeros = Vec::new();
    let mut before = swing(solver.particles(), &shape);
    for step in 0.. {
        solver.run(1).unwrap();
        let now = swing(solver.particles(), &shape);
        if before * now < 0.0 {
            zeros.push((step as f32 + before / (before - now)) * settings.dt);
        }
        if zeros.len() == 6 {
            break;
        }
        before = now;
    }
    2.0 * (zeros[5] - zeros[0]) / 5.0
}

/// The bar is thin and free to bulge: `c^2 = E' / rho` with `E' = E / (1 - nu^2)` in plane strain, and
/// E of jelly is 0.3 of the default.
#[test]
fn a_bar_rings_with_four_lengths_over_the_speed_of_sound() {
    let speed = (0.3f32 * 1000.0 / (1.0 - 0.2 * 0.2)).sqrt();
    let expected = 4.0 * (0.5 * LENGTH) / speed;
    let error = [16, 32, 64].map(|cells| (period(cells) / expected - 1.0).abs());
    println!("bar period, relative error at 16, 32, 64 cells: {error:?}");
    assert!(error[2] < 0.03, "{error:?}");
    assert!(error[0] > error[1] && error[1] > error[2], "{error:?}");
}
