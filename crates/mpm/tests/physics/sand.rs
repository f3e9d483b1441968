//! Sand: columns collapse to heaps that stand.

use eddy_frames::Material;
use eddy_mpm::{Energy, GridShape, Materials, Solver};

use super::{block, run_for, settings};

/// Friction at the walls: that of sand on sand, the tangent of 31 degrees.
const ROUGH: f32 = 0.6;

/// A column of `[columns, rows]` particles at the left wall of a box of two by one. Also the place of wall and floor.
fn column(sides: [usize; 2], wall_friction: f32) -> (Solver, f32) {
    let grid = GridShape { cells: [128, 64], dx: 1.0 / 64.0 };
    let materials = Materials { stiffness: 2e3, wall_friction, ..Materials::default() };
    let settings = settings(grid, Material::Sand, materials);
    // The inner nodes of the walls.
    let wall = 2.0 * grid.dx;
    let particles = block([wall, wall], sides, settings.spacing, Material::Sand);
    (Solver::new(particles, settings).unwrap(), wall)
}

/// Distance from the wall within which 99 % of the particles lie.
fn front(solver: &Solver, wall: f32) -> f32 {
    let mut reach: Vec<f32> = solver.particles().iter().map(|p| p.position[0] - wall).collect();
    reach.sort_by(f32::total_cmp);
    reach[reach.len() * 99 / 100]
}

/// Largest speed of the particles.
fn fastest(solver: &Solver) -> f32 {
    solver.particles().iter().map(|p| p.velocity[0].hypot(p.velocity[1])).fold(0.0, f32::max)
}

#[test]
fn a_column_of_sand_runs_out_on_a_rough_floor_and_comes_to_rest() {
    // Columns at a wall, between two walls, on a rough base: (L - L0) / L0 = 1.2 a for aspect ratios a up to 1.8 (Lube et al. 2005) or 3
    // (Lajeunesse et al. 2005); height H / L0 = a^(1/3) from .7 on (Lajeunesse et al. 2005).
    for (aspect, sides) in [(1.0f32, [32, 32]), (2.0, [24, 48]), (3.0, [20, 60])] {
        let (mut solver, wall) = column(sides, ROUGH);
        run_for(&mut solver, 2.0);
        let width = sides[0] as f32 * solver.settings().spacing;
        let run_out = (front(&solver, wall) - width) / width / (1.2 * aspect);
        let top = solver.particles().iter().map(|p| p.position[1] - wall).fold(0.0, f32::max);
        let height = top / width / aspect.cbrt();
        let speed = fastest(&solver);
        println!("sand {aspect}: {run_out} of the run-out, {height} of the height, speed {speed}");
        assert!((run_out - 1.0).abs() < 0.15, "{aspect}: {run_out}");
        assert!((height - 1.0).abs() < 0.15, "{aspect}: {height}");
        assert!(speed < 0.02, "{aspect}: {speed}");
    }
}

#[test]
fn a_heap_of_sand_keeps_its_slope_and_slides_apart_without_friction_at_the_floor() {
    let (mut rough, wall) = column([48, 32], ROUGH);
    run_for(&mut rough, 1.5);
    let at_rest = front(&rough, wall);
    run_for(&mut rough, 1.5);
    let later = front(&rough, wall);
    assert!((later - at_rest).abs() < 0.25 * rough.settings().spacing, "{at_rest}, {later}");

    let (mut smooth, wall) = column([48, 32], 0.0);
    run_for(&mut smooth, 1.5);
    assert!(front(&smooth, wall) > 1.5 * at_rest, "{}", front(&smooth, wall));
}

#[test]
fn energy_of_sand_does_not_grow() {
    let (mut solver, _) = column([24, 48], ROUGH);
    let total = |solver: &Solver| Energy::total(&solver.energy());
    let mut before = total(&solver);
    let start = before;
    for step in 0..40 {
        run_for(&mut solver, 0.05);
        let now = total(&solver);
        assert!(now < before + 1e-4 * start, "{step}: {before}, {now}");
        before = now;
    }
    assert!(before < 0.6 * start, "a collapse dissipates: {before} of {start}");
}
