//! The solver: explicit MLS-MPM substeps.

use super::{
    accelerator::Interval,
    attractor::Attractor,
    bound::Bound,
    energy::Energy,
    error::Limit,
    fast::{Fast, Level, Watch},
    g2p,
    grid::{Grid, GridShape},
    material::{DENSITY, Materials},
    p2g,
    particle::Particle,
    state::ParticleState,
    step::Step,
    tool::{Barriers, Loads, Motion, Tool, ToolLoad, ToolMotion},
};

/// Settings of a [`Solver`].
#[derive(Clone, Copy, Debug)]
pub struct SolverSettings {
    /// The background grid.
    pub grid: GridShape,
    /// Distance between neighbouring particles of an undeformed body (domain lengths).
    pub spacing: f32,
    /// Material settings.
    pub materials: Materials,
    /// Length of a substep (s), not checked here: see [`minimum_substeps`](super::minimum_substeps).
    pub dt: f32,
    /// Acceleration along y, negative is down (domain lengths per s^2).
    pub gravity: f32,
    /// Threads that share the work of a substep, at least 1.
    pub threads: usize,
}

impl SolverSettings {
    /// Area of an undeformed particle (domain lengths^2).
    pub(super) fn volume(&self) -> f32 {
        self.spacing * self.spacing
    }
}

/// Why an interval was not run to its end.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Stop {
    /// A particle left the grid, moved further than a cell in a substep, or has a position that is not finite.
    Lost {
        /// Its index.
        particle: usize,
        /// Its state.
        state: Particle,
    },
    /// The substeps are too long for a particle.
    TooLong {
        /// Its index.
        particle: usize,
        /// By this factor.
        factor: f32,
        /// Why.
        limit: Limit,
    },
    /// The caller did not want further substeps.
    Cancelled,
}

/// Particles that interact through a grid.
#[derive(Clone, Debug)]
pub struct Solver {
    particles: Vec<Particle>,
    /// The particles at the start of the last interval, until it is accepted; then a scratch buffer.
    before: Vec<Particle>,
    /// Whether `before` has them.
    can_go_back: bool,
    settings: SolverSettings,
    fast: Fast,
    /// Acts while it is set.
    pub attractor: Option<Attractor>,
    /// Tools, whose keyframes do not count here.
    pub tools: Vec<Tool>,
    /// How the tools move in the course of [`Solver::run`] and [`Solver::run_plain`].
    pub motions: Vec<Motion>,
    loads: Loads,
}

impl Solver {
    /// A solver starting from these particles.
    ///
    /// # Errors
    /// The index of the first particle outside the grid.
    pub fn new(particles: Vec<Particle>, settings: SolverSettings) -> Result<Self, usize> {
        let fast = Fast::new(settings.grid, settings.threads, Level::widest());
        let mut solver = Self {
            particles: Vec::new(),
            before: Vec::new(),
            can_go_back: false,
            settings,
            fast,
            attractor: None,
            tools: Vec::new(),
            motions: Vec::new(),
            loads: Loads::default(),
        };
        solver.set_particles(particles)?;
        Ok(solver)
    }

    /// Replaces the particles: by a saved state, or with particles added or removed.
    ///
    /// # Errors
    /// As [`Solver::new`]; the particles then stay unchanged.
    pub fn set_particles(&mut self, particles: Vec<Particle>) -> Result<(), usize> {
        match particles.iter().position(|p| !self.settings.grid.contains(p.position)) {
            Some(outside) => Err(outside),
            None => {
                self.particles = particles;
                self.can_go_back = false;
                Ok(())
            }
        }
    }

    /// Runs a number of substeps. The results are bit-identical for any number of threads and any processor.
    ///
    /// # Errors
    /// The index of a particle that left the grid, moved further than a cell in one substep, or has a position that is not
    /// finite; the state is then invalid.
    pub fn run(&mut self, substeps: u32) -> Result<(), usize> {
        let Self { particles, before, settings, attractor, tools, motions, loads, .. } = self;
        let tools = (&ToolMotion { tools, motions, substeps, grid: settings.grid }, loads);
        match self.fast.run(particles, before, settings, *attractor, tools, None) {
            Ok(()) => {
                std::mem::swap(particles, before);
                Ok(())
            }
            Err(Stop::Lost { particle, state }) => {
                particles[particle] = state;
                Err(particle)
            }
            Err(Stop::TooLong { particle, .. }) => Err(particle),
            Err(Stop::Cancelled) => Ok(()),
        }
    }

    /// Runs an interval with substeps of its length, and checks that they are short enough for the particles as they are, meanwhile
    /// and at its end. Results and errors are the same for any number of threads and any processor. [`Solver::go_back`] returns to
    /// its start.
    ///
    /// # Errors
    /// The particles are then unchanged.
    pub fn advance(
        &mut self,
        interval: &Interval,
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> Result<(), Stop> {
        self.settings.dt = interval.dt;
        let Self { particles, before, settings, tools, loads, .. } = self;
        let watch = Watch { bound: Bound::of(settings), cancelled };
        let Interval { substeps, attractor, ref motions, .. } = *interval;
        let tools = (&ToolMotion { tools, motions, substeps, grid: settings.grid }, loads);
        self.fast.run(particles, before, settings, attractor, tools, Some(&watch))?;
        std::mem::swap(particles, before);
        self.can_go_back = true;
        Ok(())
    }

    /// The outcome of an interval that an [`Accelerator`](super::Accelerator) has run with this one, as that of [`Solver::advance`],
    /// except that the substeps are checked from the particles at the end only.
    ///
    /// # Errors
    /// As [`Solver::advance`].
    pub fn outcome(&self, interval: &Interval, lost: Result<(), usize>) -> Result<(), Stop> {
        lost.map_err(|particle| Stop::Lost { particle, state: self.particles[particle] })?;
        let bound = Bound::of(&SolverSettings { dt: interval.dt, ..self.settings });
        bound.check(self.particles.iter().enumerate())
    }

    /// Returns to the start of the last interval.
    pub(super) fn go_back(&mut self) {
        if std::mem::take(&mut self.can_go_back) {
            std::mem::swap(&mut self.particles, &mut self.before);
        }
    }

    /// Forgets the start of the last interval.
    pub(super) fn accept(&mut self) {
        self.can_go_back = false;
    }

    /// As [`Solver::run`], but particle by particle and node by node: the reference implementation.
    ///
    /// # Errors
    /// As [`Solver::run`], except that particles may move further than a cell.
    pub fn run_plain(&mut self, substeps: u32) -> Result<(), usize> {
        let step = &Step::of(&self.settings);
        let volume = self.settings.volume();
        let mut grid = Grid::new(self.settings.grid);
        let motion = ToolMotion {
            tools: &self.tools,
            motions: &self.motions,
            substeps,
            grid: self.settings.grid,
        };
        self.loads = Loads::new(self.tools.len());
        let mut before = Barriers::new(&motion, 0, step);
        for substep in 0..substeps {
            let particles = &mut self.particles;
            grid.clear();
            let hidden = p2g::scatter(particles, &mut grid, step, volume, &before, &mut self.loads);
            grid.update(step, self.attractor.as_ref(), &before, &mut self.loads);
            let after = Barriers::new(&motion, substep + 1, step);
            g2p::gather(particles, &grid, step, &hidden, [&before, &after])?;
            before = after;
        }
        Ok(())
    }

    /// Selects vector instructions and threads.
    #[cfg(test)]
    pub(super) fn with_level(mut self, level: Level, threads: usize) -> Self {
        self.fast = Fast::new(self.settings.grid, threads, level);
        self
    }

    /// The particles, in their original order.
    pub fn particles(&self) -> &[Particle] {
        &self.particles
    }

    /// The particles, for who advances them in place of [`Solver::advance`].
    pub fn particles_mut(&mut self) -> &mut [Particle] {
        self.before.clone_from(&self.particles);
        self.can_go_back = true;
        &mut self.particles
    }

    /// What each tool has got from matter in the last interval, or call of [`Solver::run`].
    pub fn loads(&self) -> Vec<ToolLoad> {
        let mass = f64::from(DENSITY * self.settings.volume());
        self.loads.0.iter().map(|load| load.of_mass(mass)).collect()
    }

    /// The settings.
    pub fn settings(&self) -> &SolverSettings {
        &self.settings
    }

    /// The energy of the particles.
    pub fn energy(&self) -> Energy {
        Energy::of(&self.particles, &self.settings)
    }

    /// Pressure and energy of every particle.
    pub fn particle_state(&self) -> ParticleState {
        ParticleState::of(&self.particles, &self.settings)
    }

    /// Mean kinetic energy per mass, `|v|^2 / 2` (domain lengths^2 per s^2).
    pub(super) fn mean_kinetic_energy(&self) -> f64 {
        let sum: f64 = self
            .particles
            .iter()
            .map(|p| p.velocity.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>())
            .sum();
        0.5 * sum / self.particles.len() as f64
    }
}

#[cfg(test)]
mod tests {
    use super::{
        super::{
            Energy, GRAVITY,
            material::{DENSITY, Law},
            matrix::Matrix2,
            minimum_substeps,
        },
        *,
    };
    use eddy_frames::Material;

    const CELLS: u32 = 64;
    /// Taichi's law conserves energy in tension too.
    const MATERIALS: Materials = Materials {
        stiffness: 1e3,
        law: Law::Taichi,
        viscosity: 0.0,
        wall_friction: 0.0,
        friction_angle_degrees: 31.0,
    };

    /// A square of 20 x 20 particles at the centre of the domain.
    fn square(material: Material) -> Vec<Particle> {
        let spacing = 0.5 / CELLS as f32;
        (0..400)
            .map(|k| {
                let place = |n: usize| 0.5 + (n as f32 - 9.5) * spacing;
                Particle::at_rest([place(k % 20), place(k / 20)], material)
            })
            .collect()
    }

    fn settings(grid: GridShape, dt: f32, gravity: f32) -> SolverSettings {
        SolverSettings {
            grid,
            spacing: 0.5 * grid.dx,
            materials: MATERIALS,
            dt,
            gravity,
            threads: 1,
        }
    }

    fn solver(particles: Vec<Particle>, dt: f32, gravity: f32) -> Solver {
        Solver::new(particles, settings(GridShape::unit(CELLS), dt, gravity)).unwrap()
    }

    /// Linear momentum per mass, and angular momentum per mass about the origin including the affine part of APIC
    /// (`x x v + dx^2/4 (C_yx - C_xy)`).
    fn momenta(solver: &Solver) -> ([f64; 2], f64) {
        let inertia = f64::from(solver.settings.grid.dx).powi(2) / 4.0;
        let mut linear = [0.0; 2];
        let mut angular = 0.0;
        for particle in solver.particles() {
            let [x, y] = particle.position.map(f64::from);
            let [u, v] = particle.velocity.map(f64::from);
            linear = [linear[0] + u, linear[1] + v];
            angular += x * v - y * u;
            angular += inertia * f64::from(particle.affine.yx - particle.affine.xy);
        }
        (linear, angular)
    }

    #[test]
    fn the_grid_carries_the_mass_of_the_particles() {
        let settings = settings(GridShape::unit(CELLS), 1e-4, 0.0);
        let mut grid = Grid::new(settings.grid);
        let (step, volume) = (Step::of(&settings), settings.volume());
        let (barriers, mut loads) = (Barriers::default(), Loads::default());
        let mut particles = square(Material::Jelly);
        p2g::scatter(&mut particles, &mut grid, &step, volume, &barriers, &mut loads);
        let found: f64 = grid.nodes().iter().map(|node| f64::from(node.mass)).sum();
        let expected = 400.0 * f64::from(DENSITY * settings.volume());
        assert!((found / expected - 1.0).abs() < 1e-6, "found {found}, expected {expected}");
    }

    #[test]
    fn momentum_is_conserved_without_walls_and_gravity() {
        for material in Material::ALL {
            let mut particles = square(material);
            for particle in &mut particles {
                // A spin of 5 rad/s, away from the walls.
                let [x, y] = particle.position;
                particle.velocity = [1.0 - 5.0 * (y - 0.5), 0.5 + 5.0 * (x - 0.5)];
                particle.affine = Matrix2::new(0.0, -5.0, 5.0, 0.0);
            }
            let mut solver = solver(particles, 1e-4, 0.0);
            let (linear, angular) = momenta(&solver);
            solver.run(1000).unwrap();
            let (linear_after, angular_after) = momenta(&solver);
            for axis in 0..2 {
                let drift = (linear_after[axis] / linear[axis] - 1.0).abs();
                assert!(drift < 1e-6, "{material:?}: linear {drift}");
            }
            let drift = (angular_after / angular - 1.0).abs();
            assert!(drift < 1e-5, "{material:?}: angular {drift}");
        }
    }

    #[test]
    fn a_falling_body_follows_the_discrete_formula() {
        let (dt, substeps) = (1e-4, 200);
        let start = square(Material::Rope);
        let mut solver = solver(start.clone(), dt, GRAVITY);
        solver.run(substeps).unwrap();
        let n = substeps as f32;
        let fallen = -GRAVITY * dt * dt * n * (n + 1.0) / 2.0;
        for (before, after) in start.iter().zip(solver.particles()) {
            assert!((before.position[1] - after.position[1] - fallen).abs() < 1e-6);
            assert!((before.position[0] - after.position[0]).abs() < 1e-6);
        }
    }

    #[test]
    fn energy_does_not_grow_when_bodies_hit_the_floor() {
        for material in Material::ALL {
            let mut particles = square(material);
            for particle in &mut particles {
                particle.position[1] -= 0.3;
                particle.velocity[1] = -2.0;
            }
            let interval = 0.016;
            let (substeps, _) =
                minimum_substeps(&[material], &MATERIALS, 1.0 / CELLS as f32, 4.0, interval);
            let mut solver = solver(particles, interval as f32 / substeps as f32, GRAVITY);
            let energy = |solver: &Solver| {
                let grid = GridShape::unit(CELLS);
                let settings = settings(grid, solver.settings.dt, GRAVITY);
                Energy::of(solver.particles(), &settings).total()
            };
            let start = energy(&solver);
            for _ in 0..30 {
                solver.run(substeps).unwrap();
                let now = energy(&solver);
                assert!(now <= 1.01 * start, "{material:?}: from {start} to {now}");
            }
        }
    }

    #[test]
    fn a_state_that_is_not_finite_is_an_error() {
        let mut particles = square(Material::Jelly);
        particles[17].deformation.xx = f32::NAN;
        let mut solver = solver(particles, 1e-4, GRAVITY);
        assert!(solver.run(1).is_err());
    }
}
