//! Bodies thrown at walls: substeps follow the impact; what a scene ends with is right beside a run with five times the substeps, or the
//! scene is refused.

use eddy_frames::{Frame, Material};
use eddy_mpm::{
    Body, Collapse, Emitter, Law, Limit, MpmError, Preset, Scene, Settings, Shape, Simulation,
};
use rayon::prelude::*;

/// Every material with the laws that it has.
const MATTER: [(Material, Law); 6] = [
    (Material::Liquid, Law::Water),
    (Material::Liquid, Law::Taichi),
    (Material::Snow, Law::Water),
    (Material::Jelly, Law::Water),
    (Material::Rope, Law::Water),
    (Material::Liquid, Law::Settling),
];
/// By which factor a violent scene may be further from its run with five times the substeps than a slow one.
const SPREAD: f64 = 1.2;
/// By which factor its energy may be smaller: that of the law `settling` was .88 where it is pulled by a hundred times gravity, all others
/// .98 or more.
const LEAST: f64 = 0.85;
/// Energy beside which differences do not count (relative to the start): snow keeps less than a hundredth.
const LITTLE: f64 = 0.02;
/// What the shapes may differ by at least (domain lengths): 2.5 cells.
const LEAST_MOVED: f64 = 0.08;
/// A speed at which all matter stays far within the limits of a substep (domain lengths per s).
const SLOW: f32 = 1.0;

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
    /// Its energy, relative to the start (without a unit), or to nothing if there were no particles.
    energy: f64,
    /// Places below which 10 % and 90 % of the particles are, along x and y (domain lengths).
    shape: [f32; 4],
    /// The most substeps of a frame.
    substeps: u32,
}

impl End {
    /// How a scene ends.
    fn of(scene: &Scene, substeps: Option<u32>) -> Result<Self, MpmError> {
        let settings = Settings { substeps, ..Settings::default() };
        let mut simulation = Simulation::new(scene.clone(), &settings)?;
        let start = simulation.energy().total();
        let mut last = None;
        while let Some(frame) = simulation.next_frame()? {
            last = Some(frame);
        }
        let refined = simulation.refined().iter().map(|&[_, substeps]| substeps as u32);
        Ok(Self {
            energy: simulation.energy().total() / if start > 0.0 { start } else { 1.0 },
            shape: shape(&last.expect("a scene has frames")),
            substeps: refined.max().unwrap_or(simulation.substeps_per_frame()),
        })
    }

    /// How far it is from a run with five times the substeps: the ratio of their energies, and the largest distance of their shapes.
    fn difference(&self, scene: &Scene) -> (f64, f32) {
        let finer = Self::of(scene, Some(5 * self.substeps)).unwrap();
        let moved = self.shape.iter().zip(&finer.shape).map(|(a, b)| (a - b).abs());
        ((self.energy + LITTLE) / (finer.energy + LITTLE), moved.fold(0.0, f32::max))
    }
}

fn shape(frame: &Frame) -> [f32; 4] {
    let [[left, right], [bottom, top]] = [0, 1].map(|axis| {
        let mut places: Vec<f32> = frame.position.iter().map(|x| x[axis]).collect();
        places.sort_by(f32::total_cmp);
        [places[places.len() / 10], places[places.len() * 9 / 10]]
    });
    [left, right, bottom, top]
}

/// A jet of matter under gravity.
fn jet(material: Material, law: Law, speed: f32) -> Scene {
    let emitter = Emitter {
        material,
        position: [0.6, 0.5],
        width: 0.1,
        velocity: [-speed, 0.0],
        particles: 400,
    };
    let mut scene = Scene { emitters: vec![emitter], ..Scene::default() };
    (scene.materials.law, scene.frames.duration) = (law, 0.2);
    scene
}

/// A body under strong gravity (domain lengths per s^2).
fn pulled(material: Material, law: Law, gravity: f32) -> Scene {
    let mut scene = thrown(material, law, 1e-3);
    (scene.solver.gravity, scene.frames.duration) = (gravity, 0.2);
    scene
}

/// Each substep passes the velocities to the grid and back, which dissipates energy: five times the substeps end with less, in slow
/// scenes, too, and by most there (rope at 1 length/s has 1.6 times as much energy as with five times the substeps, snow 1.8). So the
/// difference of a slow scene, in which no limit is near, is the tolerance of the same matter in violent ones.
#[test]
fn a_violent_scene_ends_as_with_five_times_the_substeps_or_is_refused() {
    let slow: Vec<_> = MATTER
        .par_iter()
        .map(|&(material, law)| {
            let scene = thrown(material, law, SLOW);
            End::of(&scene, None).unwrap().difference(&scene)
        })
        .collect();
    let of_matter = |number: usize| {
        let (material, law) = MATTER[number];
        let thrown = [5.0, 15.0, 20.0, 30.0, 60.0]
            .map(|speed| (number, format!("thrown at {speed}"), thrown(material, law, speed)));
        let jets = [5.0, 20.0]
            .map(|speed| (number, format!("a jet at {speed}"), jet(material, law, speed)));
        let pulled = [-300.0, -1000.0]
            .map(|by| (number, format!("pulled by {by}"), pulled(material, law, by)));
        thrown.into_iter().chain(jets).chain(pulled)
    };
    let cases: Vec<_> = (0..MATTER.len()).flat_map(of_matter).collect();
    let refused = |(number, case, scene): &(usize, String, Scene)| {
        let (ratio, moved) = slow[*number];
        let (ratio, moved) = (SPREAD * ratio, f64::from(moved).max(LEAST_MOVED) * SPREAD);
        let case = format!("{:?}, {case}", MATTER[*number]);
        match End::of(scene, None) {
            Ok(end) => {
                let found = end.difference(scene);
                let fits = (LEAST..ratio).contains(&found.0) && f64::from(found.1) < moved;
                assert!(fits, "{case}: {end:?}, {found:?} from five times the substeps");
                None
            }
            Err(error @ MpmError::Collapsed { cause: Collapse::Crushed(_), .. }) => {
                assert!(error.to_string().contains("reduce speeds"), "{error}");
                Some((*number, case))
            }
            Err(error) => panic!("{case}: {error}"),
        }
    };
    let refused: Vec<_> = cases.par_iter().filter_map(refused).collect();
    let is_refused =
        |number, case| refused.iter().any(|(of, name)| *of == number && name.ends_with(case));
    // Water resists any impact; the stress of the other laws vanishes in matter that is crushed.
    assert!(refused.iter().all(|(number, _)| *number != 0), "{refused:?}");
    for number in [1, 3] {
        assert!(is_refused(number, "thrown at 20"), "{refused:?}");
        assert!(!is_refused(number, "thrown at 15"), "{refused:?}");
    }
    assert!(!is_refused(4, "thrown at 30") && is_refused(4, "thrown at 60"), "{refused:?}");
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
    let error = End::of(&scene, Some(75)).unwrap_err();
    let MpmError::TooFew { requested: 75, enough, ref reason } = error else { panic!("{error}") };
    assert!(matches!(**reason, MpmError::TooLong { .. }), "{reason}");
    let said = error.to_string();
    assert!(
        said.starts_with(&format!("substeps: found 75, expected at least {enough} ")),
        "{said}"
    );
    End::of(&scene, Some(enough)).unwrap();
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
