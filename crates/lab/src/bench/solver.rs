//! How long a substep of the solver takes.

use serde::Serialize;

use super::limit::Limit;
use eddy_frames::{Domain, Frame, InvalidFrame, Material, Stamp, clock::Clock};
use eddy_mpm::{
    FRAME_INTERVAL, GRAVITY, GridShape, Law, Materials, Particle, Solver, SolverSettings,
    minimum_substeps,
};

/// Particles, and cells on a side of their grid.
pub const CASES: [(usize, u32); 5] =
    [(1_000, 64), (2_500, 64), (10_000, 128), (100_000, 512), (1_000_000, 1024)];

/// Substeps after which the states are kept for a comparison with other programs.
pub const COMPARED: [u32; 3] = [0, 20, 200];

/// Bytes of the state of a particle; where all of them exceed a core's cache, memory is the limit.
const STATE: usize = 60;
/// A core's share of the caches (bytes).
const CACHE: usize = 2 << 20;
/// Rounds of which the fastest counts.
const ROUNDS: u32 = 5;

/// How fast the blocks fall at first (domain lengths per s).
const FALL: f32 = 2.0;
/// How fast they turn (rad/s).
const SPIN: f32 = 5.0;

/// Three blocks of liquid, snow and jelly that are thrown onto the floor of the unit square.
#[derive(Clone, Debug)]
pub struct Case {
    /// The start.
    pub particles: Vec<Particle>,
    /// What the solver computes with.
    pub settings: SolverSettings,
}

/// The time of a substep.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Timing {
    /// Particles.
    pub particles: usize,
    /// Cells on a side of the grid.
    pub cells: u32,
    /// Threads.
    pub threads: usize,
    /// Length of a substep (s).
    pub dt: f32,
    /// Time of a substep (microseconds).
    pub microseconds: f64,
    /// Time of a substep by particles (ns).
    pub nanoseconds_per_particle: f64,
    /// The estimated limit as a part of that time.
    pub share_of_limit: f64,
}

impl Case {
    /// So many particles, an equal number of each material, on a grid of so many cells a side.
    pub fn new(particles: usize, cells: u32, law: Law, threads: usize) -> Self {
        let grid = GridShape::unit(cells);
        let spacing = 0.5 * grid.dx;
        let blocks = [Material::Liquid, Material::Snow, Material::Jelly];
        let start = blocks.iter().enumerate().flat_map(|(k, &material)| {
            let count = (particles + k) / blocks.len();
            let side = (count as f32).sqrt() as usize;
            let left = [0.04 + 0.32 * k as f32, 3.0 * grid.dx];
            (0..count).map(move |p| {
                let place = [p % side, p / side].map(|n| (n as f32 + 0.5) * spacing);
                let position = [left[0] + place[0], left[1] + place[1]];
                // They slide apart, fall, and turn about their lower left corner.
                let velocity = [1.0 - k as f32 - SPIN * place[1], SPIN * place[0] - FALL];
                Particle { velocity, ..Particle::at_rest(position, material) }
            })
        });
        let materials = Materials { law, ..Materials::default() };
        let interval = f64::from(FRAME_INTERVAL);
        let (substeps, _) = minimum_substeps(&blocks, &materials, grid.dx, 6.0, interval);
        let dt = FRAME_INTERVAL / substeps as f32;
        let settings = SolverSettings { grid, spacing, materials, dt, gravity: GRAVITY, threads };
        Self { particles: start.collect(), settings }
    }

    /// A solver at the start.
    ///
    /// # Errors
    /// The index of a particle outside the grid.
    pub fn solver(&self) -> Result<Solver, usize> {
        Solver::new(self.particles.clone(), self.settings)
    }

    /// Times substeps for about so long (s), after the blocks have hit the floor.
    ///
    /// # Errors
    /// The index of a particle that left the grid.
    pub fn time(&self, seconds: f64, limit: &Limit) -> Result<Timing, usize> {
        let mut solver = self.solver()?;
        let clock = Clock::start();
        let warm_up = 32;
        solver.run(warm_up)?;
        let first = clock.now().as_secs_f64() / f64::from(warm_up);
        let substeps = (seconds / f64::from(ROUNDS) / first).clamp(64.0, 1e6) as u32;
        let mut fastest = f64::INFINITY;
        for _ in 0..ROUNDS {
            let clock = Clock::start();
            solver.run(substeps)?;
            fastest = fastest.min(clock.now().as_secs_f64() / f64::from(substeps));
        }
        let particles = self.particles.len();
        let per_particle = fastest / particles as f64;
        let in_memory = particles * STATE > CACHE * limit.threads;
        Ok(Timing {
            particles,
            cells: self.settings.grid.cells[0],
            threads: limit.threads,
            dt: self.settings.dt,
            microseconds: fastest * 1e6,
            nanoseconds_per_particle: per_particle * 1e9,
            share_of_limit: limit.per_particle(in_memory) / per_particle,
        })
    }

    /// The states after [`COMPARED`] substeps, as frames of one stream.
    ///
    /// # Errors
    /// A frame that is not whole: the blocks blew up.
    pub fn compared(&self) -> Result<Vec<Frame>, InvalidFrame> {
        let mut frames = Vec::new();
        let Ok(mut solver) = self.solver() else { return Ok(frames) };
        let mut done = 0;
        for (sequence, substeps) in COMPARED.into_iter().enumerate() {
            if solver.run(substeps - done).is_err() {
                break;
            }
            done = substeps;
            let seconds = f64::from(substeps) * f64::from(self.settings.dt);
            let particles = solver.particles();
            frames.push(Frame::new(
                0,
                sequence as u64,
                Stamp((seconds * 1e9) as i64),
                self.settings.dt,
                Domain::UNIT,
                particles.iter().map(|p| p.position).collect(),
                particles.iter().map(|p| p.velocity).collect(),
                particles.iter().map(|p| p.material).collect(),
            )?);
        }
        Ok(frames)
    }
}
