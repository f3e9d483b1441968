//! Scenes from their start to their end.

use rayon::prelude::*;

use super::{
    super::{
        Body, Contact, Drain, Emitter, FRAME_INTERVAL, Keyframe, Outline, Preset, Shape,
        error::Limit,
        material::Materials,
        tool::{Pose, Tool},
    },
    *,
};
use eddy_frames::Material;

fn settings(duration: f64) -> Settings {
    Settings { duration: Some(duration), ..Settings::default() }
}

fn positions(scene: &Scene) -> Vec<[f32; 2]> {
    scene.particles().unwrap().iter().map(|particle| particle.position).collect()
}

fn frames_of(scene: Scene, settings: &Settings) -> Vec<Frame> {
    let mut simulation = Simulation::new(scene, settings).unwrap();
    std::iter::from_fn(|| simulation.next_frame().unwrap()).collect()
}

#[test]
fn the_same_seed_gives_the_same_bits() {
    let bits = || -> Vec<Vec<u32>> {
        let frames = frames_of(Scene::generate(Preset::MultiMaterial, 5, 7), &settings(0.08));
        let numbers = |frame: &Frame| [frame.position.clone(), frame.velocity.clone()].concat();
        let bits = |frame| numbers(frame).as_flattened().iter().map(|x| x.to_bits()).collect();
        frames.iter().map(bits).collect()
    };
    let first = bits();
    assert_eq!(first.len(), 5);
    assert_eq!(first, bits());
}

#[test]
fn frames_are_numbered_and_stamped_from_zero_at_16_ms() {
    let frames = frames_of(Scene::generate(Preset::Fluid, 1, 9), &settings(0.05));
    let numbers: Vec<(u64, u64, i64)> =
        frames.iter().map(|f| (f.stream, f.sequence, f.stamp.0)).collect();
    assert_eq!(numbers, [(9, 0, 0), (9, 1, 16_000_000), (9, 2, 32_000_000)]);
    assert!(frames.iter().all(|f| f.dt == FRAME_INTERVAL && f.domain == Domain::UNIT));
}

#[test]
fn a_hundred_scenes_of_each_preset_stay_finite_inside_the_walls() {
    let scenes: Vec<(Preset, u64)> = [Preset::MultiMaterial, Preset::Fluid]
        .into_iter()
        .flat_map(|preset| (0..100).map(move |id| (preset, id)))
        .collect();
    scenes.into_par_iter().for_each(|(preset, id)| {
        let scene = Scene::generate(preset, 11, id);
        // `Frame::new` refuses what is not finite.
        for frame in frames_of(scene, &settings(0.032)) {
            let wall = preset.dx();
            let inside = |x: &f32| (wall..=1.0 - wall).contains(x);
            assert!(frame.position.as_flattened().iter().all(inside), "{preset} {id}");
        }
    });
}

#[test]
fn a_scene_that_is_not_pulled_is_recorded_as_it_was_set_up() {
    let scene = (0..)
        .map(|id| Scene::generate(Preset::MultiMaterial, 1, id))
        .find(|scene| scene.attractor.is_none())
        .unwrap();
    let expected = positions(&scene);
    assert_eq!(frames_of(scene, &settings(0.016))[0].position, expected);
}

#[test]
fn the_attractor_acts_before_the_recording_only() {
    let scene = (0..)
        .map(|id| Scene::generate(Preset::MultiMaterial, 1, id))
        .find(|scene| scene.attractor.is_some())
        .unwrap();
    let start = positions(&scene);
    let mut simulation = Simulation::new(scene, &Settings::default()).unwrap();
    let first = simulation.next_frame().unwrap().unwrap();
    assert_ne!(first.position, start);
    assert_eq!(simulation.solver.attractor, None);
}

#[test]
fn an_unstable_request_is_rejected_with_its_limit() {
    let scene = Scene::generate(Preset::MultiMaterial, 1, 0);
    let settings = Settings { substeps: Some(20), ..Settings::default() };
    let error = Simulation::new(scene.clone(), &settings).unwrap_err();
    assert_eq!(
        error.to_string(),
        "substeps: found 20, expected at least 153 per frame because of sound in snow \
         (E = 1000, grid 64x64); request more, or omit the setting"
    );
    assert!(matches!(error, MpmError::Unstable { limit: Limit::Sound(_), .. }));
    // The number in the message is accepted.
    let settings = Settings { substeps: Some(153), ..settings };
    assert!(Simulation::new(scene, &settings).is_ok());
}

#[test]
fn a_scene_with_too_many_substeps_is_rejected() {
    let mut scene = Scene::generate(Preset::Fluid, 1, 0);
    scene.bodies[0].velocity = [1e12, 0.0];
    let message = Simulation::new(scene, &Settings::default()).unwrap_err().to_string();
    assert!(message.contains("substeps needed in 0.016 s because of particles of"), "{message}");
    assert!(message.contains("at most 1000000"), "{message}");
}

#[test]
fn the_substeps_of_the_paper_are_stable_for_a_soft_jelly() {
    let mut scene = Scene::generate(Preset::MultiMaterial, 1, 1);
    scene.attractor = None;
    for body in &mut scene.bodies {
        body.material = Material::Jelly;
    }
    let settings = Settings { stiffness: Some(250.0), substeps: Some(20), ..settings(0.5) };
    assert_eq!(frames_of(scene, &settings).len(), 31);
}

#[test]
fn settings_override_those_of_the_scene() {
    let scene = Scene::generate(Preset::Stiff, 1, 0);
    let same = Settings::default().over(scene.clone());
    assert_eq!(same, scene);
    let settings = Settings { stiffness: Some(500.0), ..settings(1.0) };
    let scene = settings.over(Scene::generate(Preset::Fluid, 1, 0));
    assert_eq!(scene.materials.stiffness, 500.0);
    assert_eq!((scene.frames.duration, scene.frames.shortest), (1.0, None));
}

#[test]
fn settings_out_of_range_are_named() {
    let rejected = |settings: Settings| {
        let scene = Scene::generate(Preset::Fluid, 1, 0);
        Simulation::new(scene, &settings).unwrap_err().to_string()
    };
    assert_eq!(
        rejected(Settings { stiffness: Some(-1.0), ..Settings::default() }),
        "materials.stiffness: found -1, expected a positive number, at most 1e9"
    );
    assert_eq!(
        rejected(settings(f64::NAN)),
        "frames.duration: found NaN, expected a positive number, at most 1e6"
    );
}

#[test]
fn emitters_and_drains_act_between_frames() {
    let spacing = 1.0 / 128.0;
    let emitter = Emitter {
        material: Material::Liquid,
        position: [0.5, 0.3],
        width: 4.0 * spacing,
        velocity: [0.0, -1.0],
        particles: 60,
    };
    let drain = Drain { lower: [0.0; 2], upper: [1.0, 0.2] };
    let mut scene = Scene { emitters: vec![emitter], drains: vec![drain], ..Scene::default() };
    scene.frames.duration = 1.0;
    let frames = frames_of(scene, &Settings::default());
    let counts: Vec<usize> = frames.iter().map(Frame::len).collect();
    assert_eq!(counts[0], 4, "the first row is there at once");
    assert!(counts.iter().any(|&count| count > 30), "{counts:?}");
    assert!(frames.len() < 40, "the scene ends when nothing is left");
    assert!(frames.iter().all(|f| f.position.iter().all(|x| x[1] > 0.2)));
}

#[test]
fn a_fluid_scene_ends_when_little_moves() {
    let rest = 1e-3;
    let scene = Scene::generate(Preset::Fluid, 1, 0);
    let mut simulation = Simulation::new(scene, &Settings::default()).unwrap();
    simulation.fewest_frames = 2;
    let mut still = simulation.solver.particles().to_vec();
    for particle in &mut still {
        particle.velocity = [0.0; 2];
    }
    let grid = GridShape::unit(128);
    let settings = SolverSettings {
        grid,
        spacing: 0.5 * grid.dx,
        materials: Materials { stiffness: 1.0, ..Materials::default() },
        dt: 1e-7,
        gravity: 0.0,
        threads: 1,
    };
    simulation.solver = Solver::new(still, settings).unwrap();
    simulation.scene.attractor = None;
    assert!(simulation.next_frame().unwrap().is_some());
    assert!(simulation.next_frame().unwrap().is_some(), "no scene is shorter than its least");
    assert!(simulation.next_frame().unwrap().is_none());
    assert!(simulation.solver.mean_kinetic_energy() < rest);
}

/// What is recorded of a finer solver: the same bodies between the same walls, which fall alike.
#[test]
fn a_resolved_scene_has_the_bodies_of_the_scene_between_its_walls() {
    let scene = |resolve| {
        let mut scene = Scene::generate(Preset::Kinds, 5, 4);
        scene.solver.resolve = resolve;
        scene
    };
    let fall = |resolve| {
        let settings = Settings { duration: Some(1.6), ..Settings::default() };
        let mut simulation = Simulation::new(scene(resolve), &settings).unwrap();
        let first = simulation.next_frame().unwrap().unwrap();
        let parts = simulation.solver().particles().len() / first.len();
        assert_eq!(simulation.particles(), first.len());
        assert_eq!(simulation.particle_state().pressure.len(), first.len());
        let mut last = first.clone();
        while let Some(frame) = simulation.next_frame().unwrap() {
            last = frame;
        }
        (parts, first, last)
    };
    let (one, usual, settled) = fall(None);
    let spacing = scene(None).spacing();
    for (times, parts) in [(2, 4), (3, 9)] {
        let (found, first, last) = fall(Some(times));
        assert_eq!((one, found), (1, parts));
        assert_eq!(first.material, usual.material);
        // Of the attractor's pull, which has acted before the first frame, little depends on the cells.
        let centre = |frame: &Frame, axis: usize| {
            frame.position.iter().map(|x| x[axis]).sum::<f32>() / frame.len() as f32
        };
        for axis in 0..2 {
            let apart = centre(&first, axis) - centre(&usual, axis);
            assert!(apart.abs() < 4.0 * spacing, "{times} {axis}: {apart}");
        }
        let lowest = |frame: &Frame| frame.position.iter().map(|x| x[1]).fold(1.0, f32::min);
        let apart = lowest(&last) - lowest(&settled);
        assert!(apart.abs() < 3.0 * spacing, "{times}: lowest {apart} apart");
    }
}

#[test]
fn a_factor_out_of_range_or_with_emitters_is_refused() {
    let mut scene = Scene::generate(Preset::Fluid, 1, 1);
    scene.solver.resolve = Some(9);
    let error = scene.check().unwrap_err().to_string();
    assert!(error.contains("solver.resolve: found 9, expected 1 to 8"), "{error}");
    scene.solver.resolve = Some(2);
    scene.check().unwrap();
    scene.drains.push(Drain { lower: [0.0; 2], upper: [0.1; 2] });
    let error = scene.check().unwrap_err().to_string();
    assert!(error.contains("found 2 with emitters or drains"), "{error}");
}

/// A disc that is pushed into a block of jelly.
fn pushed() -> Scene {
    let keyframe = |time, x| Keyframe { time, position: [x, 0.2], angle_degrees: 0.0 };
    let body = Body {
        material: Material::Jelly,
        shape: Shape::Rectangle { size: [0.2, 0.2] },
        position: [0.5, 0.2],
        angle_degrees: 0.0,
        velocity: [0.0; 2],
        particles: None,
    };
    Scene {
        bodies: vec![body],
        tools: vec![Tool {
            name: "disc".into(),
            shape: Outline::Disc { radius: 0.05 },
            contact: Contact::Friction(0.2),
            keyframes: vec![keyframe(0.0, 0.3), keyframe(0.16, 0.4)],
        }],
        ..Scene::default()
    }
}

#[test]
fn tools_that_are_moved_by_hand_along_their_keyframes_move_the_same() {
    let mut by_keyframes = Simulation::new(pushed(), &Settings::default()).unwrap();
    let mut by_hand = Simulation::new(pushed(), &Settings::default()).unwrap();
    assert_eq!(by_hand.next_frame().unwrap(), by_keyframes.next_frame().unwrap());
    let tool = pushed().tools.remove(0);
    let mut impulse = 0.0;
    for frame in 1..15 {
        by_hand.move_tools(&[tool.pose(f64::from(frame) * decimal(FRAME_INTERVAL))]).unwrap();
        let [found, expected] =
            [&mut by_hand, &mut by_keyframes].map(|simulation| simulation.next_frame().unwrap());
        assert_eq!(found, expected, "frame {frame}");
        assert_eq!(by_hand.loads(), by_keyframes.loads());
        impulse += by_hand.loads()[0].impulse[0];
    }
    // The disc has pushed the jelly, which pushes back.
    assert!(impulse < -1e-3, "{impulse}");
    // It rests where it was left.
    let pose = by_hand.poses()[0];
    by_hand.next_frame().unwrap();
    assert_eq!(by_hand.poses(), [pose]);
}

#[test]
fn a_frame_of_tools_says_where_they_are_how_they_move_and_what_matter_does() {
    let mut simulation = Simulation::new(pushed(), &Settings::default()).unwrap();
    for sequence in 0..15 {
        let frame = simulation.next_frame().unwrap().unwrap();
        let tools = simulation.tool_frame(&frame);
        let time = frame.stamp.seconds();
        assert_eq!((tools.sequence, tools.stamp), (sequence, frame.stamp));
        assert_eq!(tools.states[0].pose, pushed().tools[0].pose(time));
        // 0.1 in 0.16 s.
        let speed = if (1..=10).contains(&sequence) { 0.625 } else { 0.0 };
        assert!((tools.states[0].velocity[0] - speed).abs() < 1e-4, "frame {sequence}");
        match tools.wrenches[..] {
            [] => assert_eq!(sequence, 0),
            [wrench] => {
                let impulse = wrench.force.map(|force| force * decimal(FRAME_INTERVAL));
                let expected = simulation.loads()[0].impulse;
                assert!((0..2).all(|k| (impulse[k] - expected[k]).abs() < 1e-12));
            }
            _ => panic!("{} wrenches of one tool", tools.wrenches.len()),
        }
    }
}

#[test]
fn a_way_by_hand_that_cannot_be_is_refused_and_nothing_moves() {
    let mut simulation = Simulation::new(pushed(), &Settings::default()).unwrap();
    let pose = pushed().tools[0].pose(0.0);
    let refused = |simulation: &mut Simulation, poses: &[Pose], expected: &str| {
        let error = simulation.move_tools(poses).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}, expected {expected}");
    };
    refused(&mut simulation, &[pose], "tools: found poses before the first frame");
    simulation.next_frame().unwrap();
    refused(&mut simulation, &[], "tools: found 0 poses, expected 1, one for each tool");
    let [nan, far] = [f32::NAN, 1e9].map(|x| Pose { position: [x, 0.2], ..pose });
    refused(&mut simulation, &[nan], "tools[0]: found a pose of [NaN, 0.2]");
    refused(&mut simulation, &[far], "tools[0]: found a way of");
    assert_eq!(simulation.poses(), [pose]);
    // A fast one has more substeps.
    let fast = Pose { position: [0.3, 0.9], ..pose };
    simulation.move_tools(&[fast]).unwrap();
    assert!(simulation.next_interval().unwrap().substeps >= 89);
    simulation.next_frame().unwrap();
    assert_eq!(simulation.poses(), [fast]);
}
