//! What two tools cost: time per substep with them beside the same matter without them, on one thread.
//!
//!     cargo run --release -p eddy-mpm --example tool_cost
//!
//! A pool of 20,000 particles, and two blades that move through it, wholly in matter, or above it without touching anything. Each frame is
//! computed with the blades, and from the same particles without them, in turn, so that what else the machine does hits both; the least
//! time of each frame counts.

use eddy_frames::{Material, clock::Clock};
use eddy_mpm::{
    Body, Contact, Interval, Keyframe, MpmError, Outline, Scene, Settings, Shape, Simulation, Tool,
};

/// Cells on a side of the domain.
const CELLS: f32 = 160.0;
/// Particles along x and y.
const POOL: [usize; 2] = [280, 72];
/// When the blades are where they are measured (s), and for how long.
const BEGIN: f64 = 0.8;
const SECONDS: f64 = 0.16;
/// Times that every frame is measured.
const ROUNDS: usize = 3;

/// A blade that goes down to this height at x, and then sweeps by `by`.
fn blade(name: &str, x: f32, height: f32, by: f32) -> Tool {
    let keyframe = |time, x, y| Keyframe { time, position: [x, y], angle_degrees: 0.0 };
    Tool {
        name: name.into(),
        shape: Outline::Rectangle { size: [0.02, 0.14] },
        contact: Contact::Friction(0.3),
        keyframes: vec![
            keyframe(0.0, x, 0.8),
            keyframe(0.7, x, height),
            keyframe(BEGIN + SECONDS, x + by, height),
        ],
    }
}

fn scene(material: Material, height: Option<f32>) -> Scene {
    let size = POOL.map(|count| count as f32 * 0.5 / CELLS);
    let pool = Body {
        material,
        shape: Shape::Rectangle { size },
        position: [0.5, 0.02 + 0.5 * size[1]],
        angle_degrees: 0.0,
        velocity: [0.0; 2],
        particles: None,
    };
    let tools = height.map_or_else(Vec::new, |height| {
        vec![blade("left", 0.3, height, 0.1), blade("right", 0.7, height, -0.1)]
    });
    let mut scene =
        Scene { cell_width: 1.0 / CELLS, bodies: vec![pool], tools, ..Scene::default() };
    scene.frames.duration = BEGIN + SECONDS;
    // The same for all, so that they can be compared.
    scene.solver.substeps = Some(400);
    scene
}

/// The frames before the measurement.
fn begun(scene: Scene) -> Result<Simulation, MpmError> {
    let mut simulation = Simulation::new(scene, &Settings::default())?;
    while let Some(frame) = simulation.next_frame()? {
        if frame.stamp.seconds() >= BEGIN {
            break;
        }
    }
    Ok(simulation)
}

/// The mean time per substep (us) with tools, and without them.
fn times(mut with: Simulation, without: &Simulation) -> Result<[f64; 2], MpmError> {
    let (mut times, mut substeps) = ([0.0; 2], 0.0);
    while let Some(interval) = with.next_interval() {
        let bare = Interval { motions: Vec::new(), ..interval.clone() };
        let mut least = [f64::INFINITY; 2];
        for _ in 0..ROUNDS {
            let mut solvers = [with.solver().clone(), without.solver().clone()];
            let particles = with.solver().particles().to_vec();
            solvers[1].set_particles(particles).expect("they are in the domain");
            for ((solver, interval), least) in
                solvers.iter_mut().zip([&interval, &bare]).zip(&mut least)
            {
                let clock = Clock::start();
                solver.advance(interval, &|| false).expect("enough substeps");
                *least = least.min(clock.now().as_secs_f64());
            }
        }
        (0..2).for_each(|k| times[k] += least[k]);
        substeps += f64::from(interval.substeps);
        with.next_frame()?;
    }
    Ok(times.map(|time| time / substeps * 1e6))
}

fn main() -> Result<(), MpmError> {
    println!("time per substep (us) of {} particles", POOL[0] * POOL[1]);
    println!("material  blades  without  with  ratio");
    for material in [Material::Liquid, Material::Sand, Material::Snow] {
        let without = Simulation::new(scene(material, None), &Settings::default())?;
        for (place, height) in [("above", 0.75), ("within", 0.12)] {
            let [with, bare] = times(begun(scene(material, Some(height)))?, &without)?;
            println!(
                "{:8}  {place:6}  {bare:7.1}  {with:5.1}  {:5.3}",
                material.name(),
                with / bare
            );
        }
    }
    Ok(())
}
