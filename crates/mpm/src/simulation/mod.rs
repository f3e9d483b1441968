//! Simulation of a scene, frame by frame. [`tools`] moves its tools.

mod tools;

use serde::{Deserialize, Serialize};

use super::{
    accelerator::Interval,
    attractor::Attractor,
    collapse,
    energy::Energy,
    error::{Limit, MpmError},
    flow::Flow,
    grid::GridShape,
    material::Law,
    order::ParticleOrder,
    particle::Particle,
    scene::Scene,
    solver::{Solver, SolverSettings, Stop},
    stability::{TRAVEL, minimum_substeps},
    state::ParticleState,
    tool::{Motion, ToolLoad},
};
use eddy_frames::{Domain, Frame, Stamp, decimal};

/// Maximum number of substeps per frame; the stiffest materials need a few hundred thousand.
const MAX_SUBSTEPS: u32 = 1_000_000;
/// How many times an interval is run again with more substeps.
const MAX_REFINEMENTS: u32 = 6;
/// By which factor their number grows at most: the state that asked for more may be the result of too few.
const MAX_FACTOR: f64 = 4.0;
/// Substeps of such an interval, relative to those that the state asked for in which it was interrupted.
const MARGIN: f64 = 1.25;

/// Overrides of a scene's own settings.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Young's modulus E of every material (density x velocity^2).
    pub stiffness: Option<f32>,
    /// The constitutive law of liquids.
    pub law: Option<Law>,
    /// Kinematic viscosity of liquids (domain lengths^2 per s).
    pub viscosity: Option<f32>,
    /// Substeps per frame.
    pub substeps: Option<u32>,
    /// By which factor cells and spacing of the solver are finer than those of the scene.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub resolve: Option<u32>,
    /// Simulated time (s); the scene then does not end earlier.
    pub duration: Option<f64>,
    /// The order in which particles are numbered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub order: Option<ParticleOrder>,
}

impl Settings {
    /// The scene with these overrides.
    pub fn over(&self, mut scene: Scene) -> Scene {
        let Self { stiffness, law, viscosity, substeps, resolve, duration, order } = *self;
        let materials = &mut scene.materials;
        materials.stiffness = stiffness.unwrap_or(materials.stiffness);
        materials.law = law.unwrap_or(materials.law);
        materials.viscosity = viscosity.unwrap_or(materials.viscosity);
        scene.solver.substeps = substeps.or(scene.solver.substeps);
        scene.solver.resolve = resolve.or(scene.solver.resolve);
        scene.order = order.unwrap_or(scene.order);
        if let Some(duration) = duration {
            (scene.frames.duration, scene.frames.shortest) = (duration, None);
        }
        scene
    }
}

/// What an interval has come to.
#[derive(Clone, Debug, PartialEq)]
pub enum Advance {
    /// The next frame.
    Frame(Frame),
    /// None: the attractor acts, or no particles are left.
    None,
    /// Its substeps were too long: it runs again, with more of them.
    Again,
}

/// A running simulation.
#[derive(Clone, Debug)]
pub struct Simulation {
    scene: Scene,
    solver: Solver,
    /// Offset from coordinates of frames to those of the solver (domain lengths); not 0 if that is finer.
    shift: f32,
    /// Emitters and drains, if any.
    flow: Option<Flow>,
    /// Substeps per frame, unless one needs more.
    substeps: u32,
    /// Substeps of the interval that runs next.
    attempt: u32,
    /// How many times it was begun again.
    refinements: u32,
    /// Intervals that needed more substeps, in order: their numbers, with those of the attractor, and their substeps.
    refined: Vec<[u64; 2]>,
    /// How the tools move by hand in the interval that runs next, if they do, in the coordinates of frames.
    by_hand: Option<Vec<Motion>>,
    /// How each tool has moved in the interval before the last frame, in the coordinates of frames.
    moved: Vec<Motion>,
    /// Energy that the particles had at the first frame or got since then; no interval is checked before.
    budget: Option<f64>,
    /// The energy of the last frame.
    energy: Energy,
    /// Threads of the solver.
    threads: usize,
    /// Minimum number of frames.
    fewest_frames: u64,
    /// Maximum number of frames.
    most_frames: u64,
    /// Intervals that the attractor has acted.
    attracted: u32,
    /// Sequence number of the next frame.
    sequence: u64,
    /// Set when the scene is at rest or empty, or after an error.
    ended: bool,
}

impl Simulation {
    /// Sets up a scene with overrides.
    ///
    /// # Errors
    /// As [`Scene::particles`]; [`MpmError::Unstable`] for too few substeps.
    pub fn new(scene: Scene, settings: &Settings) -> Result<Self, MpmError> {
        Self::on_threads(scene, settings, 1)
    }

    /// As [`Simulation::new`], on a number of threads (at least 1), which does not affect the results.
    ///
    /// # Errors
    /// As [`Simulation::new`].
    pub fn on_threads(scene: Scene, settings: &Settings, threads: usize) -> Result<Self, MpmError> {
        let scene = settings.over(scene);
        let resolve = scene.resolve();
        let mut particles = scene.resolved_particles(resolve)?;
        let flows = !(scene.emitters.is_empty() && scene.drains.is_empty());
        let mut flow = flows.then(|| Flow::new(&scene));
        particles = flow.as_mut().and_then(|flow| flow.apply(0, &particles)).unwrap_or(particles);
        let (grid, shift) = scene.grid()?.refined(resolve);
        for particle in &mut particles {
            particle.position = particle.position.map(|x| x + shift);
        }
        let substeps = substeps(&scene, grid)?;
        let solver_settings = SolverSettings {
            grid,
            spacing: scene.spacing() / resolve as f32,
            materials: scene.materials,
            dt: (decimal(scene.frames.interval) / f64::from(substeps)) as f32,
            gravity: scene.solver.gravity,
            threads,
        };
        let mut solver = Solver::new(particles.clone(), solver_settings)
            .map_err(|particle| diverged(&particles, particle, 0.0))?;
        solver.tools.clone_from(&scene.tools);
        let moved: Vec<Motion> =
            scene.tools.iter().map(|tool| Motion::rest(tool.pose(0.0))).collect();
        solver.motions = moved.iter().map(|motion| motion.shifted(shift)).collect();
        let intervals =
            |seconds: f64| ((seconds / decimal(scene.frames.interval)).round() as u64).max(1);
        let most_frames = intervals(scene.frames.duration);
        let fewest_frames = scene.frames.shortest.map_or(most_frames, intervals);
        let energy = solver.energy();
        Ok(Self {
            shift,
            scene,
            solver,
            flow,
            substeps,
            attempt: substeps,
            refinements: 0,
            refined: Vec::new(),
            by_hand: None,
            moved,
            budget: None,
            energy,
            threads,
            fewest_frames,
            most_frames,
            attracted: 0,
            sequence: 0,
            ended: false,
        })
    }

    /// The next frame, one interval after the last; `None` when the scene has ended. The first frame is the state after the
    /// attractor has acted.
    ///
    /// # Errors
    /// As [`Simulation::finish_interval`].
    pub fn next_frame(&mut self) -> Result<Option<Frame>, MpmError> {
        self.next_frame_unless(&|| false)
    }

    /// As [`Simulation::next_frame`], unless it is cancelled: asked at least every 64 substeps.
    ///
    /// # Errors
    /// As [`Simulation::finish_interval`]; [`MpmError::Cancelled`].
    pub fn next_frame_unless(
        &mut self,
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> Result<Option<Frame>, MpmError> {
        while let Some(interval) = self.next_interval() {
            let outcome = self.solver.advance(&interval, cancelled);
            match self.finish_interval(outcome) {
                Ok(Advance::Frame(frame)) => return Ok(Some(frame)),
                Ok(Advance::Again | Advance::None) => {}
                Err(error) => return Err(self.with_enough_substeps(error, cancelled)),
            }
        }
        Ok(None)
    }

    /// An error of [`Simulation::finish_interval`]; if the number of substeps was requested, with one that suffices to the end of the
    /// scene. That takes as long as a simulation.
    pub fn with_enough_substeps(
        &self,
        reason: MpmError,
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> MpmError {
        let Some(requested) = self.scene.solver.substeps else { return reason };
        // How tools were moved by hand is not known any more.
        if reason == MpmError::Cancelled || self.by_hand.is_some() {
            return reason;
        }
        match self.enough_substeps(cancelled) {
            // The scene is chaotic: it may have ended otherwise for another reason than the number.
            Ok(enough) => {
                let enough = enough.max(requested.saturating_add(1));
                MpmError::TooFew { requested, enough, reason: Box::new(reason) }
            }
            Err(error) => error,
        }
    }

    /// Substeps per frame with which every interval of the scene is short enough.
    fn enough_substeps(&self, cancelled: &(dyn Fn() -> bool + Sync)) -> Result<u32, MpmError> {
        let mut scene = self.scene.clone();
        scene.solver.substeps = None;
        let mut other = Self::on_threads(scene, &Settings::default(), self.threads)?;
        while other.next_frame_unless(cancelled)?.is_some() {}
        let refined = other.refined.iter().map(|&[_, substeps]| substeps as u32);
        let most = refined.max().unwrap_or(other.substeps);
        Ok((f64::from(most) * MARGIN).ceil() as u32)
    }

    /// What the solver is to run next; `None` when the scene has ended.
    pub fn next_interval(&self) -> Option<Interval> {
        if self.ended || self.sequence == self.most_frames {
            return None;
        }
        let dt = (self.interval() / f64::from(self.attempt)) as f32;
        let motions = self.motions().into_iter().map(|motion| motion.shifted(self.shift)).collect();
        if self.sequence > 0 {
            return Some(Interval { substeps: self.attempt, dt, attractor: None, motions });
        }
        let attractor = self.scene.attractor.filter(|it| self.attracted < it.frames);
        let attractor =
            attractor.map(|it| Attractor { centre: it.centre.map(|x| x + self.shift), ..it });
        // The first frame of a scene is its start, unless an attractor acts before.
        let substeps = if attractor.is_some() { self.attempt } else { 0 };
        Some(Interval { substeps, dt, attractor, motions })
    }

    /// Whether there was a first frame.
    pub fn has_begun(&self) -> bool {
        self.sequence > 0
    }

    /// Goes on when the solver has run an interval with this outcome ([`Solver::advance`]): checks the particles, applies emitters and
    /// drains, and returns the next frame. If the substeps were too long, the solver is as it was before the interval.
    ///
    /// # Errors
    /// [`MpmError::TooLong`], [`MpmError::Diverged`], [`MpmError::Collapsed`] or [`MpmError::Frame`] when the requested number of
    /// substeps did not give a sound state, or no number; the simulation then ends.
    pub fn finish_interval(&mut self, outcome: Result<(), Stop>) -> Result<Advance, MpmError> {
        let advance = self.after_interval(outcome);
        self.ended |= advance.is_err();
        advance
    }

    fn after_interval(&mut self, outcome: Result<(), Stop>) -> Result<Advance, MpmError> {
        if let Err((factor, error)) = self.inspect(outcome) {
            self.refine(factor, error)?;
            return Ok(Advance::Again);
        }
        self.solver.accept();
        self.budget = self.budget.map(|budget| budget + self.driven());
        if self.attempt > self.substeps {
            let number = u64::from(self.attracted) + self.sequence;
            self.refined.push([number, self.attempt.into()]);
        }
        (self.attempt, self.refinements) = (self.substeps, 0);
        self.moved = self.motions();
        for motion in self.by_hand.iter_mut().flatten() {
            *motion = Motion::rest(motion.end);
        }
        if let (0, Some(attractor)) = (self.sequence, self.scene.attractor) {
            self.attracted = (self.attracted + 1).min(attractor.frames);
            if self.attracted < attractor.frames {
                return Ok(Advance::None);
            }
        }
        if self.sequence > 0 {
            self.exchange()?;
        }
        if self.solver.particles().is_empty() {
            self.ended = true;
            return Ok(Advance::None);
        }
        self.budget.get_or_insert(self.energy.total());
        let frame = self.frame()?;
        self.sequence += 1;
        let rest = self.scene.frames.rest;
        self.ended =
            self.sequence >= self.fewest_frames && self.solver.mean_kinetic_energy() < rest;
        Ok(Advance::Frame(frame))
    }

    /// Checks what an interval has come to.
    ///
    /// # Errors
    /// By which factor the substeps should be shorter, and the error if they cannot be.
    fn inspect(&mut self, outcome: Result<(), Stop>) -> Result<(), (f64, MpmError)> {
        let (time, substeps) = (self.begun(), self.attempt);
        match outcome {
            Ok(()) => {}
            Err(Stop::Cancelled) => return Err((1.0, MpmError::Cancelled)),
            Err(Stop::Lost { particle, state: Particle { position, material, .. } }) => {
                let (particle, position) = self.of_frame(particle, position);
                return Err((2.0, MpmError::Diverged { particle, material, position, time }));
            }
            Err(Stop::TooLong { particle, factor, limit }) => {
                let particle = particle / self.parts();
                let error = MpmError::TooLong { particle, limit, time, substeps };
                return Err((f64::from(factor) * MARGIN, error));
            }
        }
        self.energy = self.solver.energy();
        let Some(budget) = self.budget else { return Ok(()) };
        let particles = self.solver.particles();
        let budget = budget + self.driven();
        let sound = collapse::check(particles, self.solver.settings(), &self.energy, budget);
        sound.map_err(|(particle, cause)| {
            let Particle { position, material, .. } = particles[particle];
            let (particle, position) = self.of_frame(particle, position);
            let error = MpmError::Collapsed { particle, material, position, time, substeps, cause };
            (2.0, error)
        })
    }

    /// Energy that the tools have given to matter in the last interval.
    fn driven(&self) -> f64 {
        self.solver.loads().iter().map(|load| f64::max(0.0, -load.work)).sum()
    }

    /// Returns to the start of the interval, to run it with `factor` times as many substeps.
    ///
    /// # Errors
    /// `error` if their number is fixed, or would be too large.
    fn refine(&mut self, factor: f64, error: MpmError) -> Result<(), MpmError> {
        let more = (f64::from(self.attempt) * factor.min(MAX_FACTOR)).ceil();
        let is_last = self.refinements == MAX_REFINEMENTS || more > f64::from(MAX_SUBSTEPS);
        if error == MpmError::Cancelled || self.scene.solver.substeps.is_some() || is_last {
            return Err(error);
        }
        self.solver.go_back();
        self.refinements += 1;
        // The cast is exact: checked above.
        self.attempt = (more as u32).max(self.attempt + 1);
        Ok(())
    }

    /// Applies emitters and drains for the next frame.
    fn exchange(&mut self) -> Result<(), MpmError> {
        let Some(flow) = &mut self.flow else { return Ok(()) };
        match flow.apply(self.sequence, self.solver.particles()) {
            Some(particles) => self.replace(particles),
            None => Ok(()),
        }
    }

    /// Continues with these particles; the energy that they differ by is not growth.
    fn replace(&mut self, particles: Vec<Particle>) -> Result<(), MpmError> {
        let time = self.begun();
        self.solver
            .set_particles(particles.clone())
            .map_err(|particle| diverged(&particles, particle, time))?;
        let before = std::mem::replace(&mut self.energy, self.solver.energy());
        self.budget = self.budget.map(|most| most + self.energy.total() - before.total());
        Ok(())
    }

    /// Displaces every particle by a vector from `by` (domain lengths), to study the growth of small differences.
    ///
    /// # Errors
    /// [`MpmError::Diverged`] when a particle leaves the grid; no particle is moved then.
    pub fn displace(&mut self, mut by: impl FnMut() -> [f32; 2]) -> Result<(), MpmError> {
        let mut particles = self.solver.particles().to_vec();
        for parts in particles.chunks_mut(self.parts()) {
            let [dx, dy] = by();
            for Particle { position: [x, y], .. } in parts {
                (*x, *y) = (*x + dx, *y + dy);
            }
        }
        self.replace(particles)
    }

    /// The current state as a frame.
    fn frame(&self) -> Result<Frame, MpmError> {
        let recorded = || self.solver.particles().iter().step_by(self.parts());
        let interval = self.scene.frames.interval;
        // Frames beyond 2^32 would need more than two years of simulated time.
        let steps = u32::try_from(self.sequence).unwrap_or(u32::MAX);
        Ok(Frame::new(
            self.scene.id,
            self.sequence,
            Stamp(0).advance(interval, steps),
            interval,
            self.domain(),
            recorded().map(|p| p.position.map(|x| x - self.shift)).collect(),
            recorded().map(|p| p.velocity).collect(),
            recorded().map(|p| p.material).collect(),
        )?)
    }

    /// The scene with its overrides.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Substeps per frame, unless one needs more.
    pub fn substeps_per_frame(&self) -> u32 {
        self.substeps
    }

    /// Intervals so far that needed more substeps: their numbers and substeps. Intervals are numbered from 0; those of the attractor
    /// come first, then the one that ends with frame 1, unless there is an attractor.
    pub fn refined(&self) -> &[[u64; 2]] {
        &self.refined
    }

    /// Maximum number of frames.
    pub fn most_frames(&self) -> u64 {
        self.most_frames
    }

    /// The solver.
    pub fn solver(&self) -> &Solver {
        &self.solver
    }

    /// The solver, whose particles another one has advanced.
    pub fn solver_mut(&mut self) -> &mut Solver {
        &mut self.solver
    }

    /// The number of a particle of the solver and its position, as in frames.
    fn of_frame(&self, particle: usize, position: [f32; 2]) -> (usize, [f32; 2]) {
        (particle / self.parts(), position.map(|x| x - self.shift))
    }

    /// What each tool of the scene has got from matter in the interval before the last frame.
    pub fn loads(&self) -> Vec<ToolLoad> {
        self.solver.loads()
    }

    /// Current number of particles of a frame.
    pub fn particles(&self) -> usize {
        self.solver.particles().len() / self.parts()
    }

    /// Particles of the solver for each of a frame.
    fn parts(&self) -> usize {
        self.scene.resolve().pow(2) as usize
    }

    /// The energy of the last frame.
    pub fn energy(&self) -> Energy {
        self.energy
    }

    /// Pressure and energy of every particle of the last frame.
    pub fn particle_state(&self) -> ParticleState {
        let ParticleState { pressure, energy } = self.solver.particle_state();
        let recorded = |of: Vec<f32>| of.into_iter().step_by(self.parts()).collect();
        ParticleState { pressure: recorded(pressure), energy: recorded(energy) }
    }

    /// The box that holds the particles.
    pub fn domain(&self) -> Domain {
        Domain { lower: [0.0; 2], upper: self.scene.domain }
    }

    /// Start of the interval that runs next: simulated time since the start of the scene (s).
    fn begun(&self) -> f64 {
        let intervals = u64::from(self.attracted) + self.sequence.saturating_sub(1);
        intervals as f64 * self.interval()
    }

    /// Time between two frames (s).
    fn interval(&self) -> f64 {
        decimal(self.scene.frames.interval)
    }
}

/// Substeps per frame: the requested number if stable, or the minimum.
fn substeps(scene: &Scene, GridShape { cells, dx }: GridShape) -> Result<u32, MpmError> {
    let materials = &scene.materials;
    let interval = decimal(scene.frames.interval);
    let (mut minimum, mut limit) =
        minimum_substeps(&scene.materials(), materials, dx, scene.fastest(), interval);
    let speed = scene.fastest_tool();
    // The cast saturates.
    let of_tools = (f64::from(speed) * interval / f64::from(dx) / TRAVEL).ceil() as u32;
    if of_tools > minimum {
        (minimum, limit) = (of_tools, Limit::Tool(speed));
    }
    if minimum > MAX_SUBSTEPS {
        return Err(MpmError::Field {
            field: "frames.interval".into(),
            found: format!("{minimum} substeps needed in {interval} s because of {limit}"),
            expected: format!("at most {MAX_SUBSTEPS}: reduce speeds, stiffness or the interval"),
        });
    }
    match scene.solver.substeps {
        Some(requested) if requested > MAX_SUBSTEPS => Err(MpmError::Field {
            field: "solver.substeps".into(),
            found: requested.to_string(),
            expected: format!("at most {MAX_SUBSTEPS}"),
        }),
        Some(requested) if requested < minimum => {
            let stiffness = materials.stiffness;
            Err(MpmError::Unstable { requested, minimum, limit, stiffness, cells })
        }
        requested => Ok(requested.unwrap_or(minimum)),
    }
}

fn diverged(particles: &[Particle], particle: usize, time: f64) -> MpmError {
    let Particle { position, material, .. } = particles[particle];
    MpmError::Diverged { particle, material, position, time }
}

#[cfg(test)]
mod tests;
