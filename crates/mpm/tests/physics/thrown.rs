//! Bodies thrown at walls at 1 to 60 lengths/s: what a scene ends with is right beside a run with five times the substeps, or it is
//! refused.

use eddy_frames::{Frame, Material};
use eddy_mpm::{
    Body, Collapse, Emitter, Law, Limit, MpmError, Preset, Scene, Settings, Shape, Simulation,
};
use rayon::prelude::*;

/// A body without gravity, in the middle of the domain, that flies towards a wall.
fn thrown(material: Material, law: Law, speed: f32) -> Scene {
    let body = Body {
        material,
        shape: Shape::Rectangle { size: [0.2, 0.2] },
        position: [0.3, 0.5],
        angle_degrees: 0.0,
        velocity: [-speed, 0.0],
        particles: None,
    };
    let mut scene = Scene { bodies: vec![body], ..Scene::default() };
    scene.solver.gravity = 0.0;
    scene.materials.law = law;
    // Until the body is a body length away from the wall again, or what is left of it has spread.
    scene.frames.duration = (0.8 / f64::from(speed)).max(0.064);
    scene
}

/// How a scene ends.
#[derive(Debug)]
struct End {
    /// The total energy, relative to the start.
    energy: f64,
    /// Places below which 10 % and 90 % of the particles are, along x and y (domain lengths).
    shape: [f32; 4],
    /// The most substeps of a frame.
    substeps: u32,
}

fn end(scene: &Scene, substeps: Option<u32>) -> Result<End, MpmError> {
    let settings = Settings { substeps, ..Settings::default() };
    let mut simulation = Simulation::new(scene.clone(), &settings)?;
    let start = simulation.energy().total();
    let mut last = None;
    while let Some(frame) = simulation.next_frame()? {
        last = Some(frame);
    }
    let refined = simulation.refined().iter().map(|&[_, substeps]| substeps as u32);
    Ok(End {
        energy: simulation.energy().total() / start,
        shape: shape(&last.expect("a scene has frames")),
        substeps: refined.max().unwrap_or(simulation.substeps_per_frame()),
    })
}

fn shape(frame: &Frame) -> [f32; 4] {
    let [[left, right], [bottom, top]] = [0, 1].map(|axis| {
        let mut places: Vec<f32> = frame.position.iter().map(|x| x[axis]).collect();
        places.sort_by(f32::total_cmp);
        [places[places.len() / 10], places[places.len() * 9 / 10]]
    });
    [left, right, bottom, top]
}

#[test]
fn a_thrown_body_ends_as_with_five_times_the_substeps_or_is_refused() {
    const SPEEDS: [f32; 6] = [1.0, 5.0, 15.0, 20.0, 30.0, 60.0];
    let laws = [Law::Water, Law::Taichi].map(|law| (Material::Liquid, law));
    let solids = [Material::Snow, Material::Jelly, Material::Rope].map(|solid| (solid, Law::Water));
    let matter: Vec<_> = laws.into_iter().chain(solids).collect();
    let cases: Vec<_> = matter
        .iter()
        .flat_map(|&(material, law)| SPEEDS.map(|speed| (material, law, speed)))
        .collect();
    let refused: Vec<bool> = cases
        .par_iter()
        .map(|&(material, law, speed)| {
            let scene = thrown(material, law, speed);
            let case = format!("{} of {law:?} at {speed}", material.name());
            let found = match end(&scene, None) {
                Ok(found) => found,
                Err(error @ MpmError::Collapsed { cause: Collapse::Crushed(_), .. }) => {
                    assert!(error.to_string().contains("reduce speeds"), "{error}");
                    return true;
                }
                Err(error) => panic!("{case}: {error}"),
            };
            let expected = end(&scene, Some(5 * found.substeps)).unwrap();
            // Each substep dissipates a little: the finer run has less energy left, and rebounds more slowly.
            let less = found.energy - expected.energy;
            assert!((-0.02..0.25).contains(&less), "{case}: {found:?} instead of {expected:?}");
            let moved = found.shape.iter().zip(&expected.shape).map(|(a, b)| (a - b).abs());
            let moved = moved.fold(0.0, f32::max);
            assert!(moved < 0.1, "{case}: {found:?} instead of {expected:?}");
            false
        })
        .collect();
    let refused = |wanted: (Material, Law)| -> Vec<f32> {
        let found = cases.iter().zip(&refused);
        let found =
            found.filter(|((material, law, _), refused)| (*material, *law) == wanted && **refused);
        found.map(|((_, _, speed), _)| *speed).collect()
    };
    // Water resists any impact; the stress of the other laws vanishes in matter that is crushed.
    assert!(refused((Material::Liquid, Law::Water)).is_empty());
    for matter in [(Material::Jelly, Law::Water), (Material::Liquid, Law::Taichi)] {
        let found = refused(matter);
        assert!(found.contains(&20.0) && !found.contains(&5.0), "{matter:?}: {found:?}");
    }
    assert!(refused((Material::Rope, Law::Water)).iter().all(|&speed| speed >= 30.0));
}

#[test]
fn an_impact_has_more_substeps_in_its_frames_and_the_same_ones_again() {
    let run = || {
        let scene = thrown(Material::Liquid, Law::Water, 20.0);
        let mut simulation = Simulation::on_threads(scene, &Settings::default(), 2).unwrap();
        let mut last = None;
        while let Some(frame) = simulation.next_frame().unwrap() {
            last = Some(frame);
        }
        (simulation.substeps_per_frame(), simulation.refined().to_vec(), last)
    };
    let (usual, refined, last) = run();
    assert!(!refined.is_empty() && refined.iter().all(|&[_, most]| most > u64::from(usual)));
    assert!(refined.len() < 4, "only the frames of the impact: {refined:?}");
    assert_eq!((usual, refined, last), run());
}

#[test]
fn a_jet_and_a_strong_pull_are_right_or_refused() {
    let jet = |material, speed: f32| {
        let emitter = Emitter {
            material,
            position: [0.3, 0.5],
            width: 0.1,
            velocity: [-speed, 0.0],
            particles: 400,
        };
        let mut scene = Scene { emitters: vec![emitter], ..Scene::default() };
        scene.frames.duration = 0.2;
        scene
    };
    let pulled = |material, gravity: f32| {
        let mut scene = thrown(material, Law::Water, 1e-3);
        (scene.solver.gravity, scene.frames.duration) = (gravity, 0.2);
        scene
    };
    let scenes: Vec<Scene> = Material::ALL
        .into_iter()
        .flat_map(|material| {
            [jet(material, 20.0), pulled(material, -300.0), pulled(material, -1000.0)]
        })
        .collect();
    scenes.par_iter().for_each(|scene| match end(scene, None) {
        Ok(found) => {
            let expected = end(scene, Some(5 * found.substeps)).unwrap();
            assert!((found.energy / expected.energy - 1.0).abs() < 0.35, "{found:?}, {expected:?}");
        }
        Err(MpmError::Collapsed { .. }) => {}
        Err(error) => panic!("{:?}: {error}", scene.materials()),
    });
}

#[test]
fn a_requested_number_that_is_too_low_is_refused_with_one_that_suffices() {
    let scene = thrown(Material::Liquid, Law::Water, 20.0);
    let error = end(&scene, Some(75)).unwrap_err();
    let MpmError::TooFew { requested: 75, enough, ref reason } = error else { panic!("{error}") };
    assert!(matches!(**reason, MpmError::TooLong { .. }), "{reason}");
    let said = error.to_string();
    assert!(
        said.starts_with(&format!("substeps: found 75, expected at least {enough} ")),
        "{said}"
    );
    end(&scene, Some(enough)).unwrap();
}

#[test]
fn a_simulation_is_cancelled_within_a_frame() {
    let mut scene = thrown(Material::Jelly, Law::Water, 1.0);
    scene.solver.substeps = Some(1_000_000);
    let mut simulation = Simulation::new(scene.clone(), &Settings::default()).unwrap();
    simulation.next_frame().unwrap();
    let found = simulation.next_frame_unless(&|| true);
    assert_eq!(found, Err(MpmError::Cancelled));
    scene.solver.substeps = Some(1_000_001);
    let said = Simulation::new(scene, &Settings::default()).unwrap_err().to_string();
    assert_eq!(said, "solver.substeps: found 1000001, expected at most 1000000");
}

#[test]
fn scenes_of_the_presets_need_no_more_substeps_than_at_their_start() {
    let scenes = [(Preset::Kinds, 5), (Preset::MultiMaterial, 2), (Preset::Fluid, 1)];
    let scenes = scenes
        .into_iter()
        .flat_map(|(preset, count)| (0..count).map(move |id| Scene::generate(preset, 3, id)));
    scenes.collect::<Vec<_>>().into_par_iter().for_each(|scene| {
        let settings = Settings { duration: Some(1.2), ..Settings::default() };
        let mut simulation = Simulation::new(scene, &settings).unwrap();
        while simulation.next_frame().unwrap().is_some() {}
        assert_eq!(simulation.refined(), [[0; 2]; 0], "{:?}", simulation.scene().materials());
    });
    let shown = Limit::Strain(Material::Rope).to_string();
    assert_eq!(shown, "fast strain in rope");
}
