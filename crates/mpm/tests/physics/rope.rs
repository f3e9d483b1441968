//! Rope holds together.

use eddy_frames::Material;
use eddy_mpm::{GridShape, Materials, Particle, Preset, Scene, Solver, SolverSettings};

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

/// Runs so many seconds with the first columns held: after every substep they are put back, stretched
/// like the first free column, so that they pull as hard as it does.
fn run_held(particles: &mut Vec<Particle>, seconds: f32) {
    let settings = rope_settings();
    let hand = particles[..HELD * ROWS].to_vec();
    for _ in 0..(seconds / settings.dt) as u32 {
        let mut solver = Solver::new(std::mem::take(particles), settings).unwrap();
        solver.run(1).unwrap();
        *particles = solver.particles().to_vec();
        let (held, free) = particles.split_at_mut(HELD * ROWS);
        for (k, (particle, hand)) in held.iter_mut().zip(&hand).enumerate() {
            *particle = Particle { deformation: free[k % ROWS].deformation, ..*hand };
        }
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

/// A rope that leads straight down from the top, turned up by `angle` (rad).
fn rope(angle: f32) -> Vec<Particle> {
    let spacing = rope_settings().spacing;
    let mut particles = block([0.0; 2], [COLUMNS, ROWS], spacing, Material::Rope);
    let (sin, cos) = angle.sin_cos();
    for particle in &mut particles {
        let [x, y] = particle.position;
        particle.position = [0.3 + sin * x + cos * y, 0.9 - cos * x + sin * y];
    }
    particles
}

fn assert_whole(particles: &[Particle], when: &str) {
    let link = 2.0 * rope_settings().spacing;
    assert_eq!(largest_piece(particles, link), particles.len(), "{when}");
}

#[test]
fn a_rope_that_hangs_is_one_piece_and_hardly_longer() {
    let mut particles = rope(0.0);
    let before = length(&particles);
    let mut worst: f32 = 0.0;
    for _ in 0..10 {
        run_held(&mut particles, 0.1);
        assert_whole(&particles, "hanging");
        worst = worst.max((length(&particles) / before - 1.0).abs());
    }
    println!("rope: longer or shorter by {worst} at most as it hangs");
    // Half its weight on its mean cross-section: rho g L / 2E' = 9.8 * 0.6 / (2 * 2083) = 0.14 %, and
    // twice that as it bounces.
    assert!(worst < 0.01, "{worst}");
}

#[test]
fn a_rope_that_swings_is_one_piece_and_hardly_longer() {
    let mut particles = rope(0.0);
    let free_from = particles[HELD * ROWS].position[1];
    for particle in &mut particles[HELD * ROWS..] {
        particle.velocity[0] = 3.0 * (free_from - particle.position[1]);
    }
    let before = length(&particles);
    let tip = particles.len() - 1;
    let (mut worst, mut right, mut left) = (0.0f32, 0.3, 0.3);
    for _ in 0..60 {
        run_held(&mut particles, 0.025);
        assert_whole(&particles, "swinging");
        worst = worst.max((length(&particles) / before - 1.0).abs());
        right = f32::max(right, particles[tip].position[0]);
        left = f32::min(left, particles[tip].position[0]);
    }
    println!("rope: longer by {worst} at most as it swings from {right} to {left}");
    assert!(right > 0.5 && left < 0.25, "it was to swing to and fro: {right} {left}");
    assert!(worst < 0.02, "{worst}");
}

#[test]
fn a_rope_that_is_dropped_is_one_piece() {
    let mut particles = rope(1.0);
    for particle in &mut particles {
        particle.velocity = [0.5, -2.0];
    }
    let mut solver = Solver::new(particles, rope_settings()).unwrap();
    let before = length(solver.particles());
    let mut worst: f32 = 0.0;
    for _ in 0..20 {
        run_for(&mut solver, 0.1);
        assert_whole(solver.particles(), "dropped");
        worst = worst.max((length(solver.particles()) / before - 1.0).abs());
    }
    println!("rope: longer or shorter by {worst} at most after a drop");
    assert!(worst < 0.03, "{worst}");
}

/// Ropes that meet ropes and jelly, as in the data sets.
#[test]
fn the_ropes_of_the_presets_stay_whole() {
    for id in [1, 8] {
        let scene = Scene::generate(Preset::MultiMaterial, 1, id);
        let settings = settings(GridShape::unit(64), Material::Rope, Materials::default());
        let mut ropes = 0;
        let mut solver = Solver::new(scene.particles().unwrap(), settings).unwrap();
        run_for(&mut solver, 1.0);
        let mut first = 0;
        for (number, body) in scene.bodies.iter().enumerate() {
            let particles = &solver.particles()[first..first + body.particles.unwrap()];
            first += body.particles.unwrap();
            if body.material == Material::Rope {
                ropes += 1;
                println!(
                    "preset {id} body {number}: {} of {}",
                    largest_piece(particles, 2.0 * settings.spacing),
                    body.particles.unwrap()
                );
                assert_whole(particles, &format!("scene {id}, body {number}"));
            }
        }
        assert!(ropes >= 2, "{ropes}");
    }
}
