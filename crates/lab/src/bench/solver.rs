//! Time per substep of the solver.

use serde::Serialize;

use super::limit::Limit;
use eddy_frames::{Domain, Frame, InvalidFrame, Material, Stamp, clock::Clock};
use eddy_mpm::{
    FRAME_INTERVAL, GRAVITY, GridShape, Law, Materials, Particle, Solver, SolverSettings,
    minimum_substeps,
};

/// Numbers of particles and of cells on a side of the grid.
pub const CASES: [(usize, u32); 5] =
    [(1_000, 64), (2_500, 64), (10_000, 128), (100_000, 512), (1_000_000, 1024)];

/// Substeps after which states are saved for comparison with other programs.
pub const COMPARED: [u32; 3] = [0, 20, 200];

/// Size of a particle's state (bytes); if all states exceed the caches, memory is the limit.
const STATE: usize = 60;
/// Cache per core (bytes).
const CACHE: usize = 2 << 20;
/// Repetitions, of which the fastest counts.
const ROUNDS: u32 = 5;

/// Initial downward speed of the blocks (domain lengths per s).
const FALL: f32 = 2.0;
/// Initial rotation of the blocks (rad/s).
const SPIN: f32 = 5.0;

/// Materials of the blocks by default.
pub const MIXED: [Material; 3] = [Material::Liquid, Material::Snow, Material::Jelly];

/// Three blocks that are thrown onto the floor of the unit square.
#[derive(Clone, Debug)]
pub struct Case {
    /// Initial particles.
    pub particles: Vec<Particle>,
    /// Settings of the solver.
    pub settings: SolverSettings,
}

/// Time per substep.
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
    /// Time per substep (microseconds).
    pub microseconds: f64,
    /// Time per substep and particle (ns).
    pub nanoseconds_per_particle: f64,
    /// Estimated minimum time relative to the measured one.
    pub share_of_limit: f64,
}

impl Case {
    /// Equal numbers of particles in each block, on a grid with `cells` cells on a side.
    pub fn new(
        particles: usize,
        cells: u32,
        blocks: [Material; 3],
        law: Law,
        threads: usize,
    ) -> Self {
        let grid = GridShape::unit(cells);
        let spacing = 0.5 * grid.dx;
        let start = blocks.iter().enumerate().flat_map(|(k, &material)| {
            let count = (particles + k) / blocks.len();
            let side = (count as f32).sqrt() as usize;
            let left = [0.04 + 0.32 * k as f32, 3.0 * grid.dx];
            (0..count).map(move |p| {
                let place = [p % side, p / side].map(|n| (n as f32 + 0.5) * spacing);
                let position = [left[0] + place[0], left[1] + place[1]];
                // The blocks slide apart, fall, and rotate about their lower left corners.
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

    /// A solver at the initial state.
    ///
    /// # Errors
    /// The index of a particle outside the grid.
    pub fn solver(&self) -> Result<Solver, usize> {
        Solver::new(self.particles.clone(), self.settings)
    }

    /// Times substeps for about `seconds`, after a warm-up.
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
    /// An invalid frame: the blocks blew up.
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
