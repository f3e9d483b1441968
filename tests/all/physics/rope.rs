//! Rope holds together.

use std::ops::Range;

use eddy::{
    frame::Material,
    mpm::{GridShape, Materials, Particle, Solver, SolverSettings},
};

use super::{block, largest_piece, run_for, settings};

/// Particles across the rope: the fewest that a preset has.
const ROWS: usize = 5;
/// Particles along it.
const COLUMNS: usize = 80;
/// Columns that are held.
const HELD: usize = 8;

fn rope_settings() -> SolverSettings {
    settings(GridShape::unit(64), Material::Rope, Materials::default())
}

/// Runs so many seconds with the particles `held` where they are: they are put back after every few
/// substeps.
fn run_held(particles: &mut Vec<Particle>, held: Range<usize>, seconds: f32) {
    const BETWEEN: u32 = 4;
    let settings = rope_settings();
    let hand = particles[held.clone()].to_vec();
    let rounds = (seconds / settings.dt) as u32 / BETWEEN;
    for _ in 0..rounds {
        let mut solver = Solver::new(std::mem::take(particles), settings).unwrap();
        solver.run(BETWEEN).unwrap();
        *particles = solver.particles().to_vec();
        particles[held.clone()].copy_from_slice(&hand);
    }
}

/// Length of the middle line through the columns of the rope (domain lengths).
fn length(particles: &[Particle]) -> f32 {
    let middles: Vec<[f32; 2]> = particles
        .chunks_exact(ROWS)
        .map(|column| {
            [0, 1].map(|axis| column.iter().map(|p| p.position[axis]).sum::<f32>() / ROWS as f32)
        })
        .collect();
    middles.windows(2).map(|pair| (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1])).sum()
}

/// A rope that leads straight from the upper left, `angle` below the horizon (rad).
fn rope(angle: f32) -> Vec<Particle> {
    let spacing = rope_settings().spacing;
    let mut particles = block([0.0; 2], [COLUMNS, ROWS], spacing, Material::Rope);
    let (sin, cos) = angle.sin_cos();
    for particle in &mut particles {
        let [x, y] = particle.position;
        particle.position = [0.3 + cos * x + sin * y, 0.9 - sin * x + cos * y];
    }
    particles
}

fn assert_whole(particles: &[Particle], when: &str) {
    let link = 2.0 * rope_settings().spacing;
    assert_eq!(largest_piece(particles, link), particles.len(), "{when}");
}

#[test]
fn a_rope_that_hangs_is_one_piece_and_hardly_longer() {
    let mut particles = rope(std::f32::consts::FRAC_PI_2);
    let before = length(&particles);
    run_held(&mut particles, 0..HELD * ROWS, 1.0);
    let stretch = length(&particles) / before - 1.0;
    println!("rope: stretched by {stretch} as it hangs");
    assert_whole(&particles, "hanging");
    // Half its weight on its mean cross-section: rho g L / 2E' = 9.8 * 0.6 / (2 * 2083) = 0.14 %.
    assert!((0.0..0.01).contains(&stretch), "{stretch}");
}

#[test]
fn a_rope_that_swings_is_one_piece_and_hardly_longer() {
    let mut particles = rope(0.0);
    let before = length(&particles);
    let mut longest = before;
    let mut lowest = f32::MAX;
    for _ in 0..20 {
        run_held(&mut particles, 0..HELD * ROWS, 0.05);
        assert_whole(&particles, "swinging");
        longest = longest.max(length(&particles));
        lowest = particles.iter().map(|p| p.position[1]).fold(lowest, f32::min);
    }
    let stretch = longest / before - 1.0;
    println!("rope: stretched by {stretch} at most as it swings, lowest point {lowest}");
    assert!(lowest < 0.45, "it was to swing down: {lowest}");
    assert!((0.0..0.02).contains(&stretch), "{stretch}");
}

#[test]
fn a_rope_that_is_dropped_is_one_piece() {
    let mut particles = rope(0.5);
    for particle in &mut particles {
        particle.velocity = [0.5, -2.0];
    }
    let mut solver = Solver::new(particles, rope_settings()).unwrap();
    let before = length(solver.particles());
    for _ in 0..10 {
        run_for(&mut solver, 0.1);
        assert_whole(solver.particles(), "dropped");
    }
    let stretch = length(solver.particles()) / before - 1.0;
    println!("rope: stretched by {stretch} after a drop");
    assert!(stretch.abs() < 0.02, "{stretch}");
}
