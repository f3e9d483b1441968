//! Snow packs.

use eddy::{
    frame::Material,
    mpm::{GridShape, Materials, Solver},
};

use super::{block, extent, largest_piece, run_for, settings};

/// Singular values of F, from its conformal and its anticonformal part.
fn stretches(f: eddy::mpm::Matrix2) -> [f32; 2] {
    let mean = 0.5 * (f.xx + f.yy).hypot(f.yx - f.xy);
    let half_difference = 0.5 * (f.xx - f.yy).hypot(f.yx + f.xy);
    [mean + half_difference, mean - half_difference]
}

#[test]
fn snow_packs_where_it_lands_and_stays_one_heap() {
    let settings = settings(GridShape::unit(64), Material::Snow, Materials::default());
    let mut particles = block([0.4, 0.15], [26, 26], settings.spacing, Material::Snow);
    let height = extent(&particles, 1);
    for particle in &mut particles {
        particle.velocity[1] = -3.0;
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
    let packed = particles.iter().filter(|p| p.plastic < 0.99).count() as f32 / count;
    let plastic = particles.iter().map(|p| p.plastic).sum::<f32>() / count;
    let heap = largest_piece(particles, 2.0 * settings.spacing) as f32 / count;
    let flat = extent(particles, 1) / height;
    println!("snow: packed {packed}, mean Jp {plastic}, heap {heap}, height {flat}");
    assert!(packed > 0.2, "{packed}");
    assert!(heap > 0.95, "{heap}");
    assert!((0.5..1.0).contains(&flat), "{flat}");
}
