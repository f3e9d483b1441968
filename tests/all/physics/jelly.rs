//! Jelly returns to its shape.

use eddy::{
    frame::Material,
    mpm::{GridShape, Materials, Solver},
};

use super::{block, extent, run_for, settings, strain};

#[test]
fn jelly_returns_to_its_shape_after_an_impact() {
    let settings = settings(GridShape::unit(64), Material::Jelly, Materials::default());
    let mut particles = block([0.4, 0.2], [26, 26], settings.spacing, Material::Jelly);
    let shape = |particles: &[_]| (extent(particles, 0), extent(particles, 1));
    let (width, height) = shape(&particles);
    for particle in &mut particles {
        particle.velocity = [0.3, -3.0];
    }
    let mut solver = Solver::new(particles, settings).unwrap();
    let mut flattest = height;
    for _ in 0..30 {
        run_for(&mut solver, 0.008);
        flattest = flattest.min(extent(solver.particles(), 1));
    }
    assert!(flattest < 0.85 * height, "the impact was to deform it: {flattest} of {height}");
    run_for(&mut solver, 2.0);
    let particles = solver.particles();
    let strain = particles.iter().map(strain).sum::<f32>() / particles.len() as f32;
    let (wide, high) = (extent(particles, 0) / width, extent(particles, 1) / height);
    println!(
        "jelly: squeezed to {}, then {wide} wide, {high} high, |F - R| {strain}",
        flattest / height
    );
    // Under its own weight alone: rho g H / E' = 9.8 * 0.2 / 312 = 0.6 % at its foot.
    assert!(strain < 0.02, "{strain}");
    assert!((wide - 1.0).abs() < 0.02 && (high - 1.0).abs() < 0.02, "{wide} {high}");
}
