//! What two tools cost: time per substep with them beside the same matter without them, on one thread.
//!
//!     cargo run --release -p eddy-mpm --example tool_cost
//!
//! A pool of 20,000 particles, and two blades that move through it, wholly in matter, or above it without touching anything. Scenes
//! take turns, frame by frame, so that what else the machine does hits all of them; the least time of each frame counts.

use eddy_frames::{Material, clock::Clock};
use eddy_mpm::{
    Body, Contact, Keyframe, MpmError, Outline, Scene, Settings, Shape, Simulation, Tool,
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

fn main() -> Result<(), MpmError> {
    println!("time per substep (us) of {} particles", POOL[0] * POOL[1]);
    println!("material  no tools  above  within  above/none  within/none");
    for material in [Material::Liquid, Material::Sand, Material::Snow] {
        let starts = [None, Some(0.75), Some(0.12)].map(|height| begun(scene(material, height)));
        let starts: Vec<Simulation> = starts.into_iter().collect::<Result<_, _>>()?;
        let mut least = vec![Vec::new(); starts.len()];
        for _ in 0..ROUNDS {
            let mut running = starts.clone();
            for frame in 0.. {
                let mut goes_on = true;
                for (simulation, least) in running.iter_mut().zip(&mut least) {
                    let clock = Clock::start();
                    goes_on &= simulation.next_frame()?.is_some();
                    let time = clock.now().as_secs_f64();
                    match least.get_mut(frame) {
                        Some(known) => *known = f64::min(*known, time),
                        None => least.push(time),
                    }
                }
                if !goes_on {
                    break;
                }
            }
        }
        let substeps = f64::from(starts[0].substeps_per_frame());
        let mean =
            |times: &Vec<f64>| times.iter().sum::<f64>() / times.len() as f64 / substeps * 1e6;
        let [none, above, within] = [0, 1, 2].map(|k| mean(&least[k]));
        println!(
            "{:8}  {none:8.1}  {above:5.1}  {within:6.1}  {:10.3}  {:11.3}",
            material.name(),
            above / none,
            within / none
        );
    }
    Ok(())
}
