//! Reference solver: the solver that produced the truth, restarted from the frame that a model observes.

use super::{
    Rollout,
    measure::{FlightSums, Flights},
};
use eddy_dataset::Stream;
use eddy_frames::{State, decimal};
use eddy_mpm::{GridShape, MpmError, Particle, Scene, Solver, SolverSettings, minimum_substeps};

/// MPM restarted from positions, velocities and materials of one frame: undeformed (F = I, Jp = 1),
/// without affine velocity (C = 0).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Restart {
    /// Substeps and grid of the truth.
    Full,
    /// Half as many substeps, which may be too few to be stable.
    HalfStep,
    /// Cells twice as wide between the same walls, and as many substeps as they need.
    HalfGrid,
    /// Cells four times as wide, likewise.
    QuarterGrid,
}

/// A restarted solver.
pub struct Restarted {
    solver: Solver,
    substeps: u32,
    /// Offset from coordinates of frames to those of the solver (domain lengths).
    shift: f32,
}

impl Restart {
    /// All variants.
    pub const ALL: [Self; 4] = [Self::Full, Self::HalfStep, Self::HalfGrid, Self::QuarterGrid];

    /// Its name in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Full => "MPM restarted",
            Self::HalfStep => "MPM restarted, half the substeps",
            Self::HalfGrid => "MPM restarted, half the grid",
            Self::QuarterGrid => "MPM restarted, a quarter of the grid",
        }
    }

    /// Its grid in `scene`, and the offset from coordinates of frames to those of the grid (domain lengths).
    ///
    /// # Errors
    /// [`MpmError`] when the scene has no grid, or one that cannot be halved, or halved twice.
    pub fn grid(self, scene: &Scene) -> Result<(GridShape, f32), MpmError> {
        let fine = scene.grid()?;
        let halvings = match self {
            Self::Full | Self::HalfStep => 0,
            Self::HalfGrid => 1,
            Self::QuarterGrid => 2,
        };
        let coarsened = (0..halvings).try_fold((fine, 0.0), |(grid, shift), _| {
            grid.coarsened().map(|(coarser, further)| (coarser, shift + further))
        });
        coarsened.ok_or_else(|| MpmError::Field {
            field: "domain".into(),
            found: format!("{:?} cells", fine.cells),
            expected: format!("numbers of cells divisible by {}", 1 << halvings),
        })
    }

    /// The solver at a state of `scene`, on one thread.
    ///
    /// # Errors
    /// As [`Restart::grid`]; [`MpmError::Diverged`] when a particle lies outside the grid.
    pub fn begin(
        self,
        scene: &Scene,
        stream: &Stream,
        state: &State,
    ) -> Result<Restarted, MpmError> {
        let (grid, shift) = self.grid(scene)?;
        let least = || {
            let interval = decimal(scene.frames.interval);
            let (present, speed) = (scene.materials(), scene.fastest());
            minimum_substeps(&present, &scene.materials, grid.dx, speed, interval).0
        };
        // Those of a finer solver are for smaller cells.
        let of_truth = || match scene.solver.resolve {
            None | Some(1) => scene.solver.substeps.unwrap_or_else(least),
            Some(_) => least(),
        };
        let substeps = match self {
            Self::Full => of_truth(),
            Self::HalfStep => of_truth().div_ceil(2),
            Self::HalfGrid | Self::QuarterGrid => least(),
        };
        let settings = SolverSettings {
            grid,
            spacing: scene.spacing(),
            materials: scene.materials,
            dt: (decimal(scene.frames.interval) / f64::from(substeps)) as f32,
            gravity: scene.solver.gravity,
            threads: 1,
        };
        let particles = state.position.iter().zip(&state.velocity).zip(&stream.material);
        let particles = particles.map(|((&[x, y], &velocity), &material)| Particle {
            velocity,
            ..Particle::at_rest([x + shift, y + shift], material)
        });
        let solver = Solver::new(particles.collect(), settings).map_err(|particle| {
            let (position, material) = (state.position[particle], stream.material[particle]);
            MpmError::Diverged { particle, material, position, time: 0.0 }
        })?;
        Ok(Restarted { solver, substeps, shift })
    }

    /// Predicts `reach` frames from each of the frames `starts` of a stream.
    ///
    /// # Errors
    /// The first error of [`Restart::begin`]. Starts without a solver get failed rollouts.
    pub fn roll_out(
        self,
        scene: &Scene,
        stream: &Stream,
        starts: &[usize],
        reach: usize,
        each: &mut dyn FnMut(usize, Rollout),
    ) -> Result<(), MpmError> {
        let mut outcome = Ok(());
        for (number, &start) in starts.iter().enumerate() {
            let observed = &stream.states[start];
            let rollout = match self.begin(scene, stream, observed) {
                Ok(mut restarted) => Rollout::collect(observed, reach, || restarted.next_state()),
                Err(reason) => {
                    outcome = outcome.and(Err(reason));
                    Rollout::lost(observed, reach)
                }
            };
            each(number, rollout);
        }
        outcome
    }

    /// Errors of one-step predictions of bodies in free flight; NaN where the solver fails.
    pub(super) fn fly(self, scene: &Scene, stream: &Stream, flights: &Flights) -> FlightSums {
        let mut sums = FlightSums::default();
        let lost = || vec![[f32::NAN; 2]; stream.material.len()];
        for index in flights.frames() {
            let restarted = self.begin(scene, stream, &stream.states[index]).ok();
            let state = restarted.and_then(|mut restarted| restarted.next_state());
            let state = state.unwrap_or_else(|| State { position: lost(), velocity: lost() });
            flights.add(index, &state.position, &state.velocity, &mut sums);
        }
        sums
    }
}

impl Restarted {
    /// The state one frame later; `None` when a particle left the grid.
    pub fn next_state(&mut self) -> Option<State> {
        self.solver.run(self.substeps).ok()?;
        let particles = self.solver.particles();
        let back = |[x, y]: [f32; 2]| [x - self.shift, y - self.shift];
        Some(State {
            position: particles.iter().map(|p| back(p.position)).collect(),
            velocity: particles.iter().map(|p| p.velocity).collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_frames::{Domain, Stamp};
    use eddy_mpm::Preset;

    /// A scene's initial particles.
    fn at_rest(scene: &Scene) -> State {
        let position: Vec<_> = scene.particles().unwrap().iter().map(|p| p.position).collect();
        State { velocity: vec![[0.0; 2]; position.len()], position }
    }

    fn stream(scene: &Scene, states: Vec<State>) -> Stream {
        Stream {
            id: 0,
            source: "test".into(),
            dt: scene.frames.interval,
            domain: Domain::UNIT,
            material: scene.particles().unwrap().iter().map(|p| p.material).collect(),
            first_sequence: 0,
            first_stamp: Stamp(0),
            stiffness: None,
            tools: None,
            states,
        }
    }

    #[test]
    fn every_restart_falls_freely_from_the_observed_state() {
        // Bodies of jelly that are not in contact yet.
        let scene = Scene::generate(Preset::Kinds, 1, 2);
        let stream = stream(&scene, vec![at_rest(&scene)]);
        let dt = scene.frames.interval;
        for restart in Restart::ALL {
            let mut restarted = restart.begin(&scene, &stream, &stream.states[0]).unwrap();
            // Substeps fall by g dt^2 (1 + 1/n) / 2.
            let rounding = 1.0 + 1.0 / restarted.substeps as f32;
            let fallen = -0.5 * scene.solver.gravity * dt * dt * rounding;
            let state = restarted.next_state().unwrap();
            for (after, before) in state.position.iter().zip(&stream.states[0].position) {
                let moved = [after[0] - before[0], after[1] + fallen - before[1]];
                assert!(moved[0].hypot(moved[1]) < 1e-5, "{restart:?}: {moved:?}");
            }
        }
    }

    #[test]
    fn a_start_without_a_solver_has_a_failed_rollout_and_the_next_one_is_computed() {
        let scene = Scene::generate(Preset::Kinds, 1, 2);
        let whole = at_rest(&scene);
        let mut torn = whole.clone();
        torn.position[3] = [-0.5, 0.5];
        let stream = stream(&scene, vec![torn, whole]);
        let mut diverged = Vec::new();
        let mut keep = |_: usize, rollout: Rollout| diverged.push(rollout.diverged);
        let done = Restart::Full.roll_out(&scene, &stream, &[0, 1], 2, &mut keep);
        assert!(matches!(done, Err(MpmError::Diverged { particle: 3, .. })), "{done:?}");
        assert_eq!(diverged, [true, false]);
    }
}
