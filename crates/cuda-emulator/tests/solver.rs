//! The solver's kernels beside the solver of the processor.

#![expect(clippy::unwrap_used, reason = "a test that cannot continue fails")]

use std::{slice, sync::Arc};

use eddy_cuda::solver::{Constants, Solvers};
use eddy_cuda_emulator::Emulator;
use eddy_frames::Material;
use eddy_mpm::{
    Accelerator, Advance, Attractor, Body, GRAVITY, GridShape, Interval, Law, Materials, Matrix2,
    MpmError, Particle, Preset, Scene, Settings, Shape, Simulation, Solver, SolverSettings,
};
use proptest::prelude::*;

const CELLS: u32 = 40;
const LAWS: [Law; 3] = [Law::Water, Law::Settling, Law::Taichi];

fn settings(law: Law, dt: f32) -> SolverSettings {
    let grid = GridShape { cells: [CELLS, CELLS + 3], dx: 1.0 / CELLS as f32 };
    SolverSettings {
        grid,
        spacing: 0.5 * grid.dx,
        materials: Materials { law, viscosity: 0.01, wall_friction: 0.3, ..Materials::default() },
        dt,
        gravity: GRAVITY,
        threads: 1,
    }
}

/// A block of 12 x 12 particles with its lower left corner there, which spins and stretches.
fn block(corner: [f32; 2], velocity: [f32; 2], material: Material) -> Vec<Particle> {
    let spacing = 0.5 / CELLS as f32;
    let at = |k: usize| [(k % 12) as f32 * spacing, (k / 12) as f32 * spacing];
    (0..144)
        .map(|k| {
            let [x, y] = at(k);
            Particle {
                velocity: [velocity[0] - 5.0 * y, velocity[1] + 5.0 * x],
                affine: Matrix2::new(0.0, -5.0, 5.0, 0.0),
                deformation: Matrix2::new(1.02, 0.01, -0.02, 0.97),
                plastic: if material == Material::Sand { 1.02 } else { 0.98 },
                ..Particle::at_rest([corner[0] + x, corner[1] + y], material)
            }
        })
        .collect()
}

/// A device.
fn solvers() -> Solvers {
    Solvers::new(Arc::new(Emulator::new(&Constants).unwrap()), 0)
}

/// Loads solvers, runs an interval of each, and fetches their particles.
fn run(
    device: &mut Solvers,
    solvers: &mut [&mut Solver],
    intervals: &[Interval],
) -> Vec<Result<(), usize>> {
    let here: Vec<&Solver> = solvers.iter().map(|solver| &**solver).collect();
    device.load(&here).unwrap();
    let outcomes = device.run(intervals, &|| false).unwrap();
    device.fetch(solvers);
    outcomes
}

fn numbers(matrix: Matrix2) -> [f32; 4] {
    [matrix.xx, matrix.xy, matrix.yx, matrix.yy]
}

/// The largest differences in position (cells), velocity (domain lengths per s), F, and Jp.
fn differences(one: &Solver, other: &Solver) -> [f32; 4] {
    let mut largest = [0.0f32; 4];
    let pairs = one.particles().iter().zip(other.particles());
    for (a, b) in pairs {
        let of = |x: &[f32], y: &[f32]| {
            x.iter().zip(y).fold(0.0f32, |most, (x, y)| most.max((x - y).abs()))
        };
        let found = [
            of(&a.position, &b.position) * CELLS as f32,
            of(&a.velocity, &b.velocity),
            of(&numbers(a.deformation), &numbers(b.deformation)),
            (a.plastic - b.plastic).abs(),
        ];
        assert_eq!(a.material, b.material);
        for (largest, found) in largest.iter_mut().zip(found) {
            *largest = largest.max(found);
        }
    }
    largest
}

fn materials() -> impl Strategy<Value = Material> {
    prop::sample::select(Material::ALL.to_vec())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn substeps_are_those_of_the_plain_solver(
        material in materials(),
        other in materials(),
        law in prop::sample::select(&LAWS[..]),
        // Also at walls and in corners.
        x in prop_oneof![Just(0.05f32), 0.05f32..0.5, Just(0.5)],
        y in prop_oneof![Just(0.05f32), 0.05f32..0.87, Just(0.87)],
        u in -3.0f32..3.0,
        v in -3.0f32..3.0,
        attracted in any::<bool>(),
        substeps in 1u32..12,
    ) {
        let mut particles = block([x, y], [u, v], material);
        particles.extend(block([x + 0.3, y], [-u, v], other));
        let mut plain = Solver::new(particles, settings(law, 1e-4)).unwrap();
        let attractor = Attractor { centre: [0.3, 0.4], strength: 15.0, frames: 1, period: Some(0.7) };
        let attractor = attracted.then_some(attractor);
        plain.attractor = attractor;
        let mut found = plain.clone();
        plain.run_plain(substeps).unwrap();
        let outcomes = run(&mut solvers(), &mut [&mut found], &[Interval { dt: 1e-4, substeps, attractor, motions: Vec::new() }]);
        prop_assert_eq!(outcomes, vec![Ok(())]);
        let [position, velocity, deformation, plastic] = differences(&plain, &found);
        // Those of sand are sums of logarithms and exponentials of them, in each substep.
        let most = if [material, other].contains(&Material::Sand) { 1e-5 } else { 2e-6 };
        prop_assert!(
            position < 2e-5 && velocity < 2e-4 && deformation < most && plastic < most,
            "{position:e} cells, {velocity:e}, F {deformation:e}, Jp {plastic:e}"
        );
    }
}

#[test]
fn scenes_side_by_side_have_the_bits_they_have_alone() {
    let dt = |k: usize| 1e-4 / (k + 1) as f32;
    let make = |k: usize| {
        let material = Material::ALL[k % 4];
        let mut particles = block([0.1 + 0.1 * k as f32, 0.3], [1.0, k as f32 - 2.0], material);
        particles.truncate(144 - 30 * k);
        particles.extend(block([0.1, 0.5], [0.0, -1.0], Material::Liquid));
        Solver::new(particles, settings(LAWS[k % 3], dt(k))).unwrap()
    };
    let intervals: Vec<Interval> = [40, 0, 7, 25]
        .into_iter()
        .enumerate()
        .map(|(k, substeps)| Interval { substeps, dt: dt(k), attractor: None, motions: Vec::new() })
        .collect();
    let mut together: Vec<Solver> = (0..4).map(make).collect();
    let mut all: Vec<&mut Solver> = together.iter_mut().collect();
    assert_eq!(run(&mut solvers(), &mut all, &intervals), vec![Ok(()); 4]);
    for (k, found) in together.iter().enumerate() {
        let mut alone = make(k);
        run(&mut solvers(), &mut [&mut alone], &intervals[k..=k]);
        assert!(alone.particles() == found.particles(), "scene {k}");
    }
    assert!(together[1].particles() == make(1).particles(), "no substeps");
}

#[test]
fn an_interval_is_the_same_in_one_run_and_in_several() {
    // Over several rounds, with particles that leave their tiles, and with the particles uploaded in between.
    let start = || {
        Solver::new(block([0.2, 0.5], [3.0, -2.0], Material::Jelly), settings(Law::Water, 2e-4))
            .unwrap()
    };
    let interval = |substeps| Interval { substeps, dt: 2e-4, attractor: None, motions: Vec::new() };
    let (mut once, mut parts) = (start(), start());
    let mut device = solvers();
    run(&mut device, &mut [&mut once], &[interval(150)]);
    for substeps in [70, 1, 79] {
        run(&mut device, &mut [&mut parts], &[interval(substeps)]);
    }
    assert!(once.particles() == parts.particles());
}

#[test]
fn a_fast_particle_is_sorted_again_in_time() {
    // .4 cells a substep: it leaves the margin of its tile several times a round.
    let particles = block([0.15, 0.4], [80.0, 0.0], Material::Liquid);
    let mut plain = Solver::new(particles, settings(Law::Taichi, 1e-4)).unwrap();
    let mut found = plain.clone();
    plain.run_plain(50).unwrap();
    run(
        &mut solvers(),
        &mut [&mut found],
        &[Interval { substeps: 50, dt: 1e-4, attractor: None, motions: Vec::new() }],
    );
    assert!(plain.particles()[0].position[0] > 0.5);
    assert!(differences(&plain, &found)[0] < 1e-3);
}

#[test]
fn particles_in_one_cell_are_summed_exactly() {
    // More than a block has threads, and than a sum of 32 bits holds.
    let particles = (0..5000).map(|k| {
        let shift = 0.4 * (k % 71) as f32 / (71.0 * CELLS as f32);
        let material = [Material::Rope, Material::Liquid][k % 2];
        Particle { velocity: [1.0, 2.0], ..Particle::at_rest([0.5 + shift, 0.5], material) }
    });
    let mut plain = Solver::new(particles.collect(), settings(Law::Settling, 1e-4)).unwrap();
    let mut found = plain.clone();
    plain.run_plain(2).unwrap();
    run(
        &mut solvers(),
        &mut [&mut found],
        &[Interval { substeps: 2, dt: 1e-4, attractor: None, motions: Vec::new() }],
    );
    let [position, velocity, ..] = differences(&plain, &found);
    assert!(position < 1e-5 && velocity < 1e-3, "{position:e} {velocity:e}");
}

#[test]
fn a_lost_particle_is_named_and_others_go_on() {
    let make = |speed: f32| {
        let mut particles = block([0.4, 0.4], [0.0, 0.0], Material::Jelly);
        particles[17].velocity[0] = speed;
        // It gathers its velocity from nodes that others share: only a lonely one keeps it.
        particles[17].position = [0.8, 0.8];
        Solver::new(particles, settings(Law::Water, 1e-4)).unwrap()
    };
    let interval = Interval { substeps: 30, dt: 1e-4, attractor: None, motions: Vec::new() };
    for speed in [5000.0, f32::NAN, f32::INFINITY] {
        let (mut bad, mut good) = (make(speed), make(1.0));
        let outcomes =
            run(&mut solvers(), &mut [&mut bad, &mut good], &[interval.clone(), interval.clone()]);
        assert_eq!(outcomes, vec![Err(17), Ok(())], "{speed}");
    }
}

#[test]
fn a_simulation_goes_on_from_the_particles_of_a_device() {
    let scene = Scene::generate(Preset::MultiMaterial, 3, 1);
    let overrides = Settings { duration: Some(0.05), ..Settings::default() };
    let mut here = Simulation::new(scene.clone(), &overrides).unwrap();
    let mut there = Simulation::new(scene, &overrides).unwrap();
    let mut device = solvers();
    device.load(&[there.solver()]).unwrap();
    let mut frames = 0;
    while let Some(interval) = there.next_interval() {
        let lost = device.run(slice::from_ref(&interval), &|| false).unwrap().pop().unwrap();
        device.fetch(&mut [there.solver_mut()]);
        let outcome = there.solver().outcome(&interval, lost);
        if let Advance::Frame(found) = there.finish_interval(outcome).unwrap() {
            let expected = here.next_frame().unwrap().unwrap();
            assert_eq!((found.stamp, found.sequence), (expected.stamp, expected.sequence));
            let far = |k: usize| {
                let ([a, b], [c, d]) = (found.position[k], expected.position[k]);
                (a - c).hypot(b - d)
            };
            let mean = (0..found.len()).map(far).sum::<f32>() / found.len() as f32;
            assert!(mean < 1e-4, "frame {frames}: {mean}");
            frames += 1;
        }
    }
    assert_eq!(here.next_frame().unwrap(), None);
    assert_eq!(frames, 3);
}

/// A scene in which a body is thrown at a wall, on a device to its end: the intervals that needed more substeps, and the error, if any.
fn thrown(material: Material, speed: f32) -> (Vec<[u64; 2]>, Option<MpmError>) {
    let body = Body {
        material,
        shape: Shape::Rectangle { size: [0.15, 0.15] },
        position: [0.2, 0.5],
        angle_degrees: 0.0,
        velocity: [-speed, 0.0],
        particles: None,
    };
    let mut scene = Scene { bodies: vec![body], cell_width: 1.0 / 32.0, ..Scene::default() };
    scene.frames.duration = 0.064;
    let mut simulation = Simulation::new(scene, &Settings::default()).unwrap();
    let mut device = solvers();
    device.load(&[simulation.solver()]).unwrap();
    while let Some(interval) = simulation.next_interval() {
        let lost = device.run(slice::from_ref(&interval), &|| false).unwrap().pop().unwrap();
        device.fetch(&mut [simulation.solver_mut()]);
        let outcome = simulation.solver().outcome(&interval, lost);
        match simulation.finish_interval(outcome) {
            Ok(Advance::Again) => device.load(&[simulation.solver()]).unwrap(),
            Ok(Advance::Frame(_) | Advance::None) => {}
            Err(error) => return (simulation.refined().to_vec(), Some(error)),
        }
    }
    (simulation.refined().to_vec(), None)
}

#[test]
fn an_impact_is_run_again_with_more_substeps_or_refused() {
    let (refined, error) = thrown(Material::Liquid, 20.0);
    assert!(!refined.is_empty() && error.is_none(), "{refined:?} {error:?}");
    assert_eq!(thrown(Material::Liquid, 20.0).0, refined);
    let error = thrown(Material::Jelly, 25.0).1.unwrap();
    assert!(matches!(error, MpmError::Collapsed { .. }), "{error}");
}

#[test]
fn an_interval_is_cancelled_between_its_rounds() {
    let solver =
        Solver::new(block([0.4, 0.4], [0.0; 2], Material::Jelly), settings(Law::Water, 1e-4));
    let mut device = solvers();
    device.load(&[&solver.unwrap()]).unwrap();
    let interval = Interval { substeps: 1_000_000, dt: 1e-4, attractor: None, motions: Vec::new() };
    assert_eq!(device.run(&[interval], &|| true), Err(MpmError::Cancelled));
}
