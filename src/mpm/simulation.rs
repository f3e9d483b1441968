//! A scene, frame by frame.

use serde::{Deserialize, Serialize};

use super::{
    FRAME_INTERVAL, GRAVITY,
    error::MpmError,
    grid::GridShape,
    material::Materials,
    preset::Preset,
    scene::Scene,
    solver::{Solver, SolverSettings},
    stability::minimum_substeps,
};
use crate::frame::{Domain, Frame, Material, Stamp, decimal};

/// Largest stiffness that is accepted (density x velocity^2); at 1e9 a frame needs 1e5 substeps.
const STIFFEST: f32 = 1e9;

/// What can be chosen about a simulation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// What the particles are made of.
    pub materials: Materials,
    /// Substeps a frame; as many as stability needs if not given.
    pub substeps: Option<u32>,
    /// Simulated time (s); as the preset has it if not given.
    pub duration: Option<f64>,
}

/// A running simulation.
#[derive(Clone, Debug)]
pub struct Simulation {
    scene: Scene,
    solver: Solver,
    /// Substeps a frame.
    substeps: u32,
    /// Frames that every such scene has.
    fewest_frames: u64,
    /// Frames after which it ends whatever moves.
    most_frames: u64,
    /// Number of the next frame.
    sequence: u64,
    /// Set when little moves, or after an error.
    ended: bool,
}

impl Simulation {
    /// Sets a scene up.
    ///
    /// # Errors
    /// [`MpmError::Setting`] for a setting out of range, [`MpmError::Unstable`] for too few
    /// substeps, [`MpmError::Diverged`] for a particle outside the grid.
    pub fn new(scene: Scene, settings: &Settings) -> Result<Self, MpmError> {
        let materials = settings.materials;
        let stiffness = materials.stiffness;
        if !(stiffness > 0.0 && stiffness <= STIFFEST) {
            let expected = "a positive number, at most 1e9";
            return Err(MpmError::Setting {
                field: "stiffness",
                found: stiffness.into(),
                expected,
            });
        }
        let (fewest_frames, most_frames) = frames(scene.preset, settings.duration)?;
        let cells = scene.preset.cells();
        let dx = scene.preset.dx();
        let speed = scene.fastest(GRAVITY, FRAME_INTERVAL);
        let interval = decimal(FRAME_INTERVAL);
        let (minimum, limit) =
            minimum_substeps(&scene.materials(), &materials, dx, speed, interval);
        let substeps = settings.substeps.unwrap_or(minimum);
        if substeps < minimum {
            let requested = substeps;
            return Err(MpmError::Unstable { requested, minimum, limit, stiffness, cells });
        }
        let dt = (interval / f64::from(substeps)) as f32;
        let solver = SolverSettings {
            grid: GridShape::unit(cells),
            spacing: scene.preset.spacing(),
            materials,
            dt,
            gravity: GRAVITY,
            threads: 1,
        };
        let solver = Solver::new(scene.particles.clone(), solver)
            .map_err(|particle| diverged(&scene.particles, particle, 0.0))?;
        let (sequence, ended) = (0, false);
        Ok(Self { scene, solver, substeps, fewest_frames, most_frames, sequence, ended })
    }

    /// The next frame, [`FRAME_INTERVAL`] after the last; `None` when the scene is over. The first
    /// one is the state at the start of the recording, when the attractor has let go.
    ///
    /// # Errors
    /// [`MpmError::Diverged`] or [`MpmError::Frame`] when the state is no number any more. The
    /// simulation is over then.
    pub fn next_frame(&mut self) -> Result<Option<Frame>, MpmError> {
        if self.ended || self.sequence == self.most_frames {
            return Ok(None);
        }
        let frame = self.advance().and_then(|()| self.frame());
        self.sequence += 1;
        let rest = self.scene.preset.length().rest;
        let settled = self.sequence >= self.fewest_frames && self.solver.kinetic_energy() < rest;
        self.ended = frame.is_err() || settled;
        frame.map(Some)
    }

    /// Moves to the instant of the next frame.
    fn advance(&mut self) -> Result<(), MpmError> {
        if self.sequence > 0 {
            return self.substeps(1);
        }
        let Some(attractor) = self.scene.attractor else { return Ok(()) };
        self.solver.attractor = Some(attractor);
        let done = self.substeps(attractor.frames);
        self.solver.attractor = None;
        done
    }

    /// Runs the substeps of so many frame intervals.
    fn substeps(&mut self, frames: u32) -> Result<(), MpmError> {
        for frame in 0..frames {
            self.solver.run(self.substeps).map_err(|particle| {
                let before = self.scene.attractor.map_or(0, |attractor| attractor.frames);
                let begun = if self.sequence > 0 { before as u64 + self.sequence - 1 } else { 0 };
                let time = (begun + u64::from(frame)) as f64 * decimal(FRAME_INTERVAL);
                diverged(self.solver.particles(), particle, time)
            })?;
        }
        Ok(())
    }

    /// The present state as a frame.
    fn frame(&self) -> Result<Frame, MpmError> {
        let particles = self.solver.particles();
        // A scene has at most 25 s / 16 ms frames by default; a longer one saturates after 795 days.
        let steps = u32::try_from(self.sequence).unwrap_or(u32::MAX);
        Ok(Frame::new(
            self.scene.id,
            self.sequence,
            Stamp(0).advance(FRAME_INTERVAL, steps),
            FRAME_INTERVAL,
            self.domain(),
            particles.iter().map(|p| p.position).collect(),
            particles.iter().map(|p| p.velocity).collect(),
            particles.iter().map(|p| p.material).collect(),
        )?)
    }

    /// The scene as it was set up.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Substeps a frame.
    pub fn substeps_per_frame(&self) -> u32 {
        self.substeps
    }

    /// The most frames that can come.
    pub fn most_frames(&self) -> u64 {
        self.most_frames
    }

    /// The materials that occur.
    pub fn materials(&self) -> Vec<Material> {
        self.scene.materials()
    }

    /// Cells on a side of the grid.
    pub fn cells(&self) -> u32 {
        self.scene.preset.cells()
    }

    /// The box that holds the particles.
    pub fn domain(&self) -> Domain {
        Domain::UNIT
    }
}

/// The fewest and the most frames of a scene. A `duration` (s) is kept to the nearest frame, whatever
/// moves; it has as many frames as intervals fit, the first one at time zero.
fn frames(preset: Preset, duration: Option<f64>) -> Result<(u64, u64), MpmError> {
    let intervals = |seconds: f64| ((seconds / decimal(FRAME_INTERVAL)).round() as u64).max(1);
    match duration {
        None => {
            let length = preset.length();
            Ok((intervals(length.shortest), intervals(length.longest)))
        }
        Some(seconds) if seconds > 0.0 && seconds <= 1e6 => Ok((u64::MAX, intervals(seconds))),
        Some(found) => {
            let expected = "a positive number of seconds, at most 1e6";
            Err(MpmError::Setting { field: "duration", found, expected })
        }
    }
}

fn diverged(particles: &[super::Particle], particle: usize, time: f64) -> MpmError {
    let super::Particle { position, material, .. } = particles[particle];
    MpmError::Diverged { particle, material, position, time }
}

#[cfg(test)]
mod tests {
    use rayon::prelude::*;

    use super::{super::error::Limit, *};

    fn settings(duration: f64) -> Settings {
        Settings { duration: Some(duration), ..Settings::default() }
    }

    fn frames_of(scene: Scene, settings: &Settings) -> Vec<Frame> {
        let mut simulation = Simulation::new(scene, settings).unwrap();
        std::iter::from_fn(|| simulation.next_frame().unwrap()).collect()
    }

    #[test]
    fn the_same_seed_gives_the_same_bytes() {
        let bytes = || -> Vec<Vec<u8>> {
            let scene = Scene::generate(Preset::MultiMaterial, 5, 7);
            frames_of(scene, &settings(0.08)).iter().map(Frame::to_cdr).collect()
        };
        let first = bytes();
        assert_eq!(first.len(), 5);
        assert_eq!(first, bytes());
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
        let expected: Vec<[f32; 2]> = scene.particles.iter().map(|p| p.position).collect();
        assert_eq!(frames_of(scene, &settings(0.016))[0].position, expected);
    }

    #[test]
    fn the_attractor_acts_before_the_recording_only() {
        let scene = (0..)
            .map(|id| Scene::generate(Preset::MultiMaterial, 1, id))
            .find(|scene| scene.attractor.is_some())
            .unwrap();
        let start: Vec<[f32; 2]> = scene.particles.iter().map(|p| p.position).collect();
        let mut simulation = Simulation::new(scene, &Settings::default()).unwrap();
        let first = simulation.next_frame().unwrap().unwrap();
        assert_ne!(first.position, start);
        assert_eq!(simulation.solver.attractor, None);
    }

    #[test]
    fn an_unstable_request_is_refused_with_its_limit() {
        let scene = Scene::generate(Preset::MultiMaterial, 1, 0);
        let settings = Settings { substeps: Some(20), ..Settings::default() };
        let error = Simulation::new(scene.clone(), &settings).unwrap_err();
        assert_eq!(
            error.to_string(),
            "substeps: found 20, expected at least 153 a frame because of sound in snow \
             (E = 1000, grid 64x64)"
        );
        assert!(matches!(error, MpmError::Unstable { limit: Limit::Sound(_), .. }));
        // What the message asks for is accepted.
        let settings = Settings { substeps: Some(153), ..settings };
        assert!(Simulation::new(scene, &settings).is_ok());
    }

    #[test]
    fn the_substeps_of_the_paper_carry_a_soft_jelly() {
        let mut scene = Scene::generate(Preset::MultiMaterial, 1, 8);
        scene.attractor = None;
        let materials = Materials { stiffness: 250.0, ..Materials::default() };
        let settings = Settings { materials, substeps: Some(20), duration: Some(0.5) };
        assert_eq!(frames_of(scene, &settings).len(), 31);
    }

    #[test]
    fn settings_out_of_range_are_named() {
        let refused = |settings: Settings| {
            let scene = Scene::generate(Preset::Fluid, 1, 0);
            Simulation::new(scene, &settings).unwrap_err().to_string()
        };
        let message = refused(Settings {
            materials: Materials { stiffness: -1.0, ..Materials::default() },
            ..Settings::default()
        });
        assert_eq!(message, "stiffness: found -1, expected a positive number, at most 1e9");
        let message = refused(settings(f64::NAN));
        assert_eq!(
            message,
            "duration: found NaN, expected a positive number of seconds, at most 1e6"
        );
    }

    #[test]
    fn a_fluid_scene_ends_when_little_moves() {
        let rest = Preset::Fluid.length().rest;
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
        assert!(simulation.solver.kinetic_energy() < rest);
    }
}
