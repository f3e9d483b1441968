//! Tools: momentum, pressure, friction, and walls that hold.

use eddy_frames::Material;
use eddy_mpm::{
    Contact, GRAVITY, GridShape, Keyframe, Materials, Motion, Outline, Particle, Pose, Solver, Tool,
};

use super::{block, run_for, settings};

const GRID: GridShape = GridShape { cells: [64, 64], dx: 1.0 / 64.0 };

fn pose(x: f32, y: f32, degrees: f32) -> Pose {
    Pose { position: [x, y], angle: degrees.to_radians() }
}

fn tool(shape: Outline, contact: Contact) -> Tool {
    Tool { name: "tool".into(), shape, contact, keyframes: Vec::<Keyframe>::new() }
}

/// A solver with tools at rest.
fn with_tools(
    particles: Vec<Particle>,
    material: Material,
    materials: Materials,
    tools: Vec<(Tool, Pose)>,
) -> Solver {
    let mut solver = Solver::new(particles, settings(GRID, material, materials)).unwrap();
    (solver.tools, solver.motions) =
        tools.into_iter().map(|(tool, pose)| (tool, Motion::rest(pose))).unzip();
    solver
}

/// Mean force on the tools while it runs (density x domain lengths^3 per s^2), each.
fn forces(solver: &mut Solver, seconds: f32) -> Vec<[f64; 2]> {
    let substeps = (seconds / solver.settings().dt).round();
    solver.run(substeps as u32).unwrap();
    let time = f64::from(substeps * solver.settings().dt);
    solver.loads().iter().map(|load| load.impulse.map(|x| x / time)).collect()
}

fn momentum(solver: &Solver) -> [f64; 2] {
    let mass = f64::from(solver.settings().spacing).powi(2);
    let sum =
        |axis: usize| solver.particles().iter().map(|p| f64::from(p.velocity[axis])).sum::<f64>();
    [mass * sum(0), mass * sum(1)]
}

#[test]
fn momentum_of_matter_and_impulse_on_tools_are_gravity_s() {
    let spacing = 0.5 * GRID.dx;
    for material in Material::ALL {
        for contact in [Contact::Slip, Contact::Sticky, Contact::Friction(0.4)] {
            let mut particles = block([0.4, 0.56], [24, 16], spacing, material);
            particles.iter_mut().for_each(|p| p.velocity = [0.5, -1.0]);
            let disc = tool(Outline::Disc { radius: 0.1 }, contact);
            let plate = Outline::Rectangle { size: [0.3, 0.01] };
            let tools =
                vec![(disc, pose(0.4, 0.45, 0.0)), (tool(plate, contact), pose(0.7, 0.5, 30.0))];
            let mut solver = with_tools(particles, material, Materials::default(), tools);
            let before = momentum(&solver);
            let forces = forces(&mut solver, 0.05);
            let mass = 384.0 * f64::from(spacing).powi(2);
            for axis in 0..2 {
                let weight = if axis == 1 { mass * f64::from(GRAVITY) * 0.05 } else { 0.0 };
                let tools: f64 = forces.iter().map(|force| 0.05 * force[axis]).sum();
                let sum = momentum(&solver)[axis] - before[axis] + tools - weight;
                assert!(tools.abs() > 1e-3 * mass || axis == 0, "{material:?}: {tools}");
                // The interval is that of whole substeps.
                assert!(sum.abs() < 4e-3 * mass, "{material:?}, {contact:?}: {} of {mass}", sum);
            }
        }
    }
}

#[test]
fn a_piston_carries_the_weight_of_a_column_and_lifts_it() {
    // Between two walls, on a piston across: all of its weight, with the lever from where the piston is held.
    let spacing = 0.5 * GRID.dx;
    for material in [Material::Liquid, Material::Jelly] {
        let left = 2.0 * GRID.dx;
        let particles = block([left, 0.3 + 0.25 * spacing], [120, 40], spacing, material);
        let mass = particles.len() as f64 * f64::from(spacing).powi(2);
        let weight = mass * f64::from(-GRAVITY);
        let corners = vec![vec![[-0.4, -0.01], [0.9, -0.01], [0.9, 0.01], [-0.4, 0.01]]];
        let piston = tool(Outline::Polygons { corners }, Contact::Slip);
        let held = pose(0.3, 0.29, 0.0);
        let mut solver =
            with_tools(particles, material, Materials::default(), vec![(piston, held)]);
        run_for(&mut solver, 3.0);
        let [_, force] = forces(&mut solver, 1.0)[0];
        let lever = solver.loads()[0].angular / solver.loads()[0].impulse[1];
        println!("piston {material:?}: {} of the weight, lever {lever}", -force / weight);
        assert!((-force / weight - 1.0).abs() < 0.05, "{material:?}: {force}, {weight}");
        assert!((lever - 0.2).abs() < 0.01, "{material:?}: {lever}");
        assert_eq!(solver.loads()[0].work, 0.0);
        // Raised by .1 in a second.
        solver.motions = vec![Motion { start: held, end: pose(0.3, 0.39, 0.0) }];
        run_for(&mut solver, 1.0);
        let work = -solver.loads()[0].work / (weight * 0.1);
        println!("piston {material:?}: {work} of the work");
        assert!((work - 1.0).abs() < 0.05, "{material:?}: {work}");
    }
}

#[test]
fn water_presses_on_a_gate_with_its_depth() {
    // rho g d^2 / 2 on a vertical gate of which the water wets d, wherever its surface is between nodes (cells).
    let spacing = 0.5 * GRID.dx;
    let left = 2.0 * GRID.dx;
    let width = 60.0 * spacing;
    for beyond in [0.01, 0.3, 0.6, 0.95] {
        let particles = block([left, left], [60, 50], spacing, Material::Liquid);
        let gate = tool(Outline::Rectangle { size: [0.02, 1.2] }, Contact::Slip);
        let surface = left + width + beyond * GRID.dx;
        let tools = vec![(gate, pose(surface + 0.01, 0.5, 0.0))];
        let mut solver = with_tools(particles, Material::Liquid, Materials::default(), tools);
        run_for(&mut solver, 4.0);
        let [force, _] = forces(&mut solver, 1.0)[0];
        let area = 3000.0 * f64::from(spacing).powi(2);
        let depth = area / f64::from(width + beyond * GRID.dx);
        let ratio = force / (0.5 * f64::from(-GRAVITY) * depth * depth);
        // No pile of particles at the gate.
        let all = solver.particles();
        let within = all.iter().filter(|p| p.position[0] > surface - GRID.dx).count() as f64;
        let density = within * f64::from(spacing).powi(2) / (f64::from(GRID.dx) * depth);
        println!("gate {beyond}: {ratio} of the force, density {density}");
        assert!((ratio - 1.0).abs() < 0.05, "{beyond}: {ratio}");
        assert!(density < 1.25, "{beyond}: {density}");
        assert!(all.iter().all(|p| p.position[0] < surface), "a leak");
    }
}

/// Mean velocity along an incline of a block of jelly on it after a time, and its mean acceleration until then.
fn slid(incline: Outline, degrees: f32, friction: f32, seconds: f32) -> (f32, f32) {
    let spacing = 0.5 * GRID.dx;
    let (sin, cos) = degrees.to_radians().sin_cos();
    let surface = [0.5, 0.4];
    // Of the block in the frame of the incline.
    let corner = [-0.1, 0.25 * spacing];
    let particles = block([1.0, 1.0], [16, 8], spacing, Material::Jelly);
    let particles = particles.into_iter().map(|particle| {
        let [x, y] = [0, 1].map(|k| particle.position[k] - 1.0 + corner[k]);
        let position = [surface[0] + cos * x - sin * y, surface[1] + sin * x + cos * y];
        Particle { position, ..particle }
    });
    let plane = tool(incline, Contact::Friction(friction));
    let tools = vec![(plane, pose(surface[0], surface[1], degrees))];
    let materials = Materials { stiffness: 5e3, ..Materials::default() };
    let mut solver = with_tools(particles.collect(), Material::Jelly, materials, tools);
    let along = |solver: &Solver| {
        let all = solver.particles();
        let speed = |p: &Particle| 0.0 - cos * p.velocity[0] - sin * p.velocity[1];
        all.iter().map(speed).sum::<f32>() / all.len() as f32
    };
    run_for(&mut solver, 0.1);
    let before = along(&solver);
    run_for(&mut solver, seconds);
    (along(&solver), (along(&solver) - before) / seconds)
}

#[test]
fn a_block_slides_down_an_incline_that_is_steeper_than_its_friction() {
    for (degrees, friction) in [(20.0, 0.0), (20.0, 0.2), (30.0, 0.3), (20.0, 0.5), (30.0, 0.8)] {
        let (sin, cos) = f32::sin_cos(f32::to_radians(degrees));
        let expected = -GRAVITY * f32::max(sin - friction * cos, 0.0);
        let (speed, acceleration) = slid(Outline::HalfPlane, degrees, friction, 0.15);
        println!("incline {degrees}, {friction}: {acceleration} of {expected}, {speed}");
        assert!(
            (acceleration - expected).abs() < 0.05 * -GRAVITY * sin + 0.03,
            "{degrees}, {friction}: {acceleration}, {expected}"
        );
        if expected == 0.0 {
            assert!(speed.abs() < 0.02, "{degrees}, {friction}: it creeps with {speed}");
        }
    }
}

#[test]
fn a_block_slides_over_seams_as_over_one_surface() {
    let plank = |from: f32, to: f32| vec![[from, -0.05], [to, -0.05], [to, 0.0], [from, 0.0]];
    let planks = |count: usize| {
        let at = |k: usize| -0.5 + k as f32 / count as f32;
        Outline::Polygons { corners: (0..count).map(|k| plank(at(k), at(k + 1))).collect() }
    };
    let (_, one) = slid(planks(1), 25.0, 0.2, 0.15);
    let (_, many) = slid(planks(37), 25.0, 0.2, 0.15);
    println!("incline of one plank: {one}, of many: {many}");
    assert!((one - many).abs() < 0.01 * one, "{one}, {many}");
}

/// A closed box of four walls .47 of a cell thick; inside it, matter is below `height - wall`.
fn cup(width: f32, height: f32) -> Outline {
    let t = 0.47 * GRID.dx;
    let (x, y) = (0.5 * width, height);
    let wall = |from: f32, to: f32, low: f32, high: f32| {
        vec![[from, low], [to, low], [to, high], [from, high]]
    };
    Outline::Polygons {
        corners: vec![
            wall(-x - t, x + t, -t, 0.0),
            wall(-x - t, -x, -t, y),
            wall(x, x + t, -t, y),
            wall(-x - t, x + t, y - t, y),
        ],
    }
}

#[test]
fn a_thin_cup_that_is_shaken_holds_what_it_has() {
    let spacing = 0.5 * GRID.dx;
    for material in [Material::Liquid, Material::Sand, Material::Snow, Material::Jelly] {
        let particles = block([0.41, 0.451], [23, 20], spacing, material);
        let count = particles.len();
        let tools = vec![(tool(cup(0.2, 0.4), Contact::Friction(0.3)), pose(0.5, 0.45, 0.0))];
        let mut solver = with_tools(particles, material, Materials::default(), tools);
        let mut at = pose(0.5, 0.45, 0.0);
        for frame in 0..100 {
            let phase = 0.5 * frame as f32;
            let next = pose(
                0.5 + 0.03 * phase.sin(),
                0.45 + 0.02 * (1.7 * phase).sin(),
                8.0 * (0.7 * phase).sin(),
            );
            solver.motions = vec![Motion { start: at, end: next }];
            run_for(&mut solver, 0.016);
            at = next;
        }
        let (sin, cos) = at.angle.sin_cos();
        let outside = solver.particles().iter().filter(|p| {
            let [x, y] = [0, 1].map(|k| p.position[k] - at.position[k]);
            let [along, up] = [cos * x + sin * y, cos * y - sin * x];
            along.abs() > 0.1 || !(0.0..=0.4 - 0.47 * GRID.dx).contains(&up)
        });
        assert_eq!(outside.count(), 0, "{material:?}: of {count} particles");
    }
}

/// An open cup with walls .47 of a cell thick, .4 wide and high inside: its floor and its sides.
fn open_cup() -> Outline {
    let Outline::Polygons { mut corners } = cup(2.0 * HALF, HIGH) else { unreachable!() };
    corners.pop();
    Outline::Polygons { corners }
}

const HALF: f32 = 0.2;
const HIGH: f32 = 0.4;

/// Where a point is, as seen from the cup.
fn seen_from(at: Pose, [x, y]: [f32; 2]) -> [f32; 2] {
    let (sin, cos) = at.angle.sin_cos();
    let [x, y] = [x - at.position[0], y - at.position[1]];
    [cos * x + sin * y, cos * y - sin * x]
}

/// The pose of the cup in the test below, by time (s): at rest, shaken, and emptied.
fn carried(time: f32) -> Pose {
    let (shaken, poured) = ((time - 0.3).clamp(0.0, 1.0), (time - 1.3).clamp(0.0, 0.8) / 0.8);
    let phase = 30.0 * shaken * std::f32::consts::PI;
    pose(
        0.35 + 0.015 * phase.sin(),
        0.54 + 0.01 * (2.0 * phase).sin(),
        6.0 * phase.sin() - 125.0 * poured,
    )
}

#[test]
fn matter_in_a_thin_cup_that_rests_is_shaken_and_poured_passes_its_walls_nowhere() {
    /// Between looks at all particles (s).
    const LOOK: f32 = 0.002;
    // Particles less than a cell from a wall, times substeps.
    let mut passages = 0;
    // Snow would stick in a rough cup.
    let (rough, smooth) = (Contact::Friction(0.3), Contact::Slip);
    for (material, contact) in
        [(Material::Liquid, rough), (Material::Sand, rough), (Material::Snow, smooth)]
    {
        let spacing = 0.5 * GRID.dx;
        let particles = block([0.155, 0.545], [49, 40], spacing, material);
        let tools = vec![(tool(open_cup(), contact), carried(0.0))];
        let mut solver = with_tools(particles, material, Materials::default(), tools);
        let is_inside = |[along, up]: [f32; 2]| along.abs() <= HALF && (0.0..=HIGH).contains(&up);
        let mut inside = vec![true; solver.particles().len()];
        let looks = (2.8 / LOOK) as usize;
        for look in 0..looks {
            let [start, end] = [look, look + 1].map(|k| carried(k as f32 * LOOK));
            solver.motions = vec![Motion { start, end }];
            run_for(&mut solver, LOOK);
            let substeps = (LOOK / solver.settings().dt).round() as usize;
            for (particle, was_inside) in solver.particles().iter().zip(&mut inside) {
                let [along, up] = seen_from(end, particle.position);
                let beside = (HALF - along.abs()).abs().min(up.abs()) < GRID.dx;
                passages += if beside && up < HIGH { substeps } else { 0 };
                let is_inside = is_inside([along, up]);
                assert!(
                    is_inside == *was_inside || up > HIGH - GRID.dx,
                    "{material:?} at {look} of {looks}: through a wall at {along}, {up}"
                );
                *was_inside = is_inside;
            }
        }
        let left = inside.iter().filter(|inside| **inside).count();
        println!("{material:?}: {left} of {} particles are left in the cup", inside.len());
        assert!(left < inside.len() / 2, "{material:?} is poured");
    }
    println!("{passages} passages");
    assert!(passages > 1_000_000);
}
