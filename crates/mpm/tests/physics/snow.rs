//! Snow packs.

use eddy_frames::Material;
use eddy_mpm::{GridShape, Materials, Matrix2, Particle, Solver};

use super::{block, extent, largest_piece, run_for, settings};

/// Singular values of F, from its conformal and its anticonformal part.
fn stretches(f: Matrix2) -> [f32; 2] {
    let mean = 0.5 * (f.xx + f.yy).hypot(f.yx - f.xy);
    let half_difference = 0.5 * (f.xx - f.yy).hypot(f.yx + f.xy);
    [mean + half_difference, mean - half_difference]
}

#[test]
fn snow_packs_where_it_lands_and_stays_one_heap() {
    let settings = settings(GridShape::unit(64), Material::Snow, Materials::default());
    let mut particles = block([0.4, 0.15], [26, 26], settings.spacing, Material::Snow);
    let before = extent(&particles, 1);
    for particle in &mut particles {
        particle.velocity[1] = -5.0;
    }
    let mut solver = Solver::new(particles, settings).unwrap();
    for _ in 0..50 {
        run_for(&mut solver, 0.012);
        for particle in solver.particles() {
            let [large, small] = stretches(particle.deformation);
            // Stomakhin et al. 2013: critical compression 2.5e-2, critical stretch 4.5e-3 (Taichi's).
            assert!(small >= 0.975 - 1e-6 && large <= 1.0045 + 1e-6, "{large} {small}");
        }
    }
    let particles = solver.particles();
    let count = particles.len() as f32;
    let share = |test: fn(&&Particle) -> bool| particles.iter().filter(test).count() as f32 / count;
    // Packed snow is at least e^(10 * 0.1) = 2.7 times as stiff as fresh snow.
    let packed = share(|p| p.plastic < 0.9);
    let mut height: Vec<f32> = particles.iter().map(|p| p.position[1]).collect();
    height.sort_by(f32::total_cmp);
    let heap = largest_piece(particles, 2.0 * settings.spacing) as f32 / count;
    let floor = 2.0 * settings.grid.dx;
    let top = (height[height.len() * 98 / 100] - floor) / before;
    println!("snow: packed {packed}, heap {heap}, height {top} of {before}");
    assert!(packed > 0.2, "{packed}");
    assert!(heap > 0.95, "{heap}");
    assert!(top < 1.0, "{top}");
}
