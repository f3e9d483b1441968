//! Bodies thrown at walls: substeps follow the impact, and too few are refused.

use eddy_frames::Material;
use eddy_mpm::{Body, Law, Limit, MpmError, Preset, Scene, Settings, Shape, Simulation};
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

/// Runs a scene to its end.
fn end(scene: &Scene, substeps: Option<u32>) -> Result<(), MpmError> {
    let settings = Settings { substeps, ..Settings::default() };
    let mut simulation = Simulation::new(scene.clone(), &settings)?;
    while simulation.next_frame()?.is_some() {}
    Ok(())
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

#[test]
#[ignore]
fn table() {
    use eddy_mpm::Emitter;
    fn end2(scene: &Scene, substeps: Option<u32>) -> Result<(f64, [f32; 4], u32), MpmError> {
        let settings = Settings { substeps, ..Settings::default() };
        let mut simulation = Simulation::new(scene.clone(), &settings)?;
        let start = simulation.energy().total();
        let mut last = None;
        while let Some(frame) = simulation.next_frame()? {
            last = Some(frame);
        }
        let frame = last.unwrap();
        let [[left, right], [bottom, top]] = [0, 1].map(|axis| {
            let mut places: Vec<f32> = frame.position.iter().map(|x| x[axis]).collect();
            places.sort_by(f32::total_cmp);
            [places[places.len() / 10], places[places.len() * 9 / 10]]
        });
        let refined = simulation.refined().iter().map(|&[_, substeps]| substeps as u32);
        let e = simulation.energy().total();
        Ok((if start > 0.0 { e / start } else { e }, [left, right, bottom, top], refined.max().unwrap_or(simulation.substeps_per_frame())))
    }
    let jet = |material, speed: f32| {
        let emitter = Emitter { material, position: [0.3, 0.5], width: 0.1, velocity: [-speed, 0.0], particles: 400 };
        let mut scene = Scene { emitters: vec![emitter], ..Scene::default() };
        scene.frames.duration = 0.2;
        scene
    };
    let pulled = |material, gravity: f32| {
        let mut scene = thrown(material, Law::Water, 1e-3);
        (scene.solver.gravity, scene.frames.duration) = (gravity, 0.2);
        scene
    };
    let mut cases = Vec::new();
    let matter = [(Material::Liquid, Law::Water), (Material::Liquid, Law::Taichi), (Material::Snow, Law::Water), (Material::Jelly, Law::Water), (Material::Rope, Law::Water)];
    for (m, law) in matter {
        for speed in [1.0, 5.0, 15.0, 20.0, 30.0, 60.0] { cases.push((format!("{} {law:?} thrown {speed}", m.name()), thrown(m, law, speed))); }
    }
    for (m, _) in matter { for g in [-300.0, -1000.0] { cases.push((format!("{} pulled {g}", m.name()), pulled(m, g))); }
        for s in [5.0, 20.0] { cases.push((format!("{} jet {s}", m.name()), jet(m, s))); } }
    let rows: Vec<String> = cases.iter().map(|(name, scene)| {
        match end2(scene, None) {
            Err(error) => format!("{name}: {error}"),
            Ok(a) => {
                let n = a.2;
                let usual = end2(scene, Some(n));
                let five = end2(scene, Some(5 * n));
                let more = if n < 400 { Some(end2(scene, Some(25 * n))) } else { None };
                let s = |e: Result<(f64,[f32;4],u32), MpmError>| match e { Ok(e) => format!("{:.3} {:.2?}", e.0, e.1), Err(e) => e.to_string() };
                format!("{name}: n {n}: {:.3} {:.2?} | all n {} | 5x {} | 25x {}", a.0, a.1, s(usual), s(five), more.map_or(String::new(), s))
            }
        }
    }).inspect(|row| println!("{row}")).collect();
    let _ = rows;
}
