//! Scenes: initial conditions and settings of a simulation, from a file or random.

use serde::{Deserialize, Serialize};

use super::{
    FRAME_INTERVAL, GRAVITY,
    attractor::Attractor,
    body::Body,
    error::MpmError,
    flow::{Drain, Emitter},
    grid::{GridShape, WALL_CELLS},
    material::Materials,
    order::{self, ParticleOrder},
    particle::Particle,
    placement,
    tool::{self, Tool},
};
use eddy_frames::{
    Material, plane,
    tool::{MAX_FRICTION, Tools},
};

/// Maximum number of particles per cell width.
const MAX_PARTICLES_PER_CELL_WIDTH: f32 = 64.0;
/// Minimum number of cells on each side of a domain: two walls and as much between them.
const MIN_CELLS: f64 = 3.0 * WALL_CELLS as f64;

/// Number of cells on a side that is too large.
const MOST_CELLS: f64 = 65_536.0;

/// Maximum factor by which the solver is finer.
const MAX_RESOLVE: u32 = 8;

/// Maximum stiffness (density x velocity^2); at 1e9 a frame needs 1e5 substeps.
pub(super) const MAX_STIFFNESS: f64 = 1e9;
/// Maximum angle of internal friction of sand (degrees).
const MAX_FRICTION_ANGLE: f64 = 60.0;
/// Memory per particle (bytes): its state in the scene, in the solver and in two sets of packs, in a frame, its message
/// and the bag's chunk.
const PARTICLE_BYTES: f64 = 384.0;
/// Memory per node (bytes): the plain grid, and the fields and chunks of the fast path.
const NODE_BYTES: f64 = 64.0;
/// Maximum simulated time (s).
const MAX_TIME: f64 = 1e6;

/// Initial conditions and settings of a simulation. Missing keys have their defaults.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Scene {
    /// Id of the scene and of the stream of its frames; 0 by default.
    pub id: u64,
    /// Width and height (domain lengths), whole cells; 1 x 1 by default. The outermost three cells
    /// are walls.
    #[serde(deserialize_with = "plane::pair")]
    pub domain: [f32; 2],
    /// Width of a cell of the grid (domain lengths); 1/64 by default.
    pub cell_width: f32,
    /// Distance between neighbouring particles (domain lengths); half a cell by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spacing: Option<f32>,
    /// Solver settings.
    pub solver: SolverChoices,
    /// Timing of frames.
    pub frames: Frames,
    /// Material settings.
    pub materials: Materials,
    /// An attractor that acts before the recording; none by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub attractor: Option<Attractor>,
    /// The order in which the bodies' particles are numbered; body by body by default.
    #[serde(skip_serializing_if = "order::is_usual")]
    pub order: ParticleOrder,
    /// Bodies, in the order of their particles.
    pub bodies: Vec<Body>,
    /// Emitters of particles; none by default.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub emitters: Vec<Emitter>,
    /// Drains of particles; none by default.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub drains: Vec<Drain>,
    /// Tools that push matter, at most eight; none by default.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tools: Vec<Tool>,
}

/// Solver settings of a scene.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SolverChoices {
    /// Acceleration along y (domain lengths per s^2): 0, or negative, which is down; -9.8 by default.
    pub gravity: f32,
    /// Substeps per frame; the minimum for stability by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub substeps: Option<u32>,
    /// By which factor cells and spacing of the solver are finer than those of the scene, 1 to 8: one of so many particles along each axis
    /// is recorded; 1 by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub resolve: Option<u32>,
}

/// Timing of frames.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Frames {
    /// Time between two frames (s); 0.016 by default.
    pub interval: f32,
    /// Simulated time after which the scene ends (s); 10 by default.
    pub duration: f64,
    /// Simulated time after which the scene ends as soon as it is at rest (s); the duration by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shortest: Option<f64>,
    /// The scene is at rest when the mean kinetic energy per mass, `|v|^2 / 2`, is below this (domain
    /// lengths^2 per s^2); 0.001 by default.
    pub rest: f64,
}

impl Frames {
    /// Checks the numbers.
    fn check(&self) -> Result<(), MpmError> {
        let Self { interval, duration, shortest, rest } = *self;
        positive("frames.interval", interval.into(), MAX_TIME)?;
        positive("frames.duration", duration, MAX_TIME)?;
        positive("frames.shortest", shortest.unwrap_or(duration), duration)?;
        finite("frames.rest", rest)
    }
}

impl Default for Scene {
    fn default() -> Self {
        Self {
            id: 0,
            domain: [1.0; 2],
            cell_width: 1.0 / 64.0,
            spacing: None,
            solver: SolverChoices::default(),
            frames: Frames::default(),
            materials: Materials::default(),
            attractor: None,
            order: ParticleOrder::Bodies,
            bodies: Vec::new(),
            emitters: Vec::new(),
            drains: Vec::new(),
            tools: Vec::new(),
        }
    }
}

impl Default for SolverChoices {
    fn default() -> Self {
        Self { gravity: GRAVITY, substeps: None, resolve: None }
    }
}

impl Default for Frames {
    fn default() -> Self {
        Self { interval: FRAME_INTERVAL, duration: 10.0, shortest: None, rest: 1e-3 }
    }
}

impl Scene {
    /// Reads the older form of scenes, in which gravity was along -y: a positive number becomes its negative. Returns what the user
    /// should know if the scene had that form.
    pub fn read_older_form(&mut self) -> Option<String> {
        let found = self.solver.gravity;
        if found.is_nan() || found <= 0.0 {
            return None;
        }
        self.solver.gravity = -found;
        Some(format!(
            "solver.gravity: found {found}, read as {}: gravity is along y, and negative is down",
            -found
        ))
    }

    /// By which factor cells and spacing of the solver are finer.
    pub(super) fn resolve(&self) -> u32 {
        self.solver.resolve.unwrap_or(1)
    }

    /// Distance between neighbouring particles (domain lengths).
    pub fn spacing(&self) -> f32 {
        self.spacing.unwrap_or(0.5 * self.cell_width)
    }

    /// The grid that covers the domain.
    ///
    /// # Errors
    /// [`MpmError::Field`] for an invalid domain, cell width or spacing.
    pub fn grid(&self) -> Result<GridShape, MpmError> {
        let Self { domain, cell_width: dx, .. } = *self;
        positive("cell_width", dx.into(), f64::MAX)?;
        let cells = domain.map(|side| f64::from(side) / f64::from(dx));
        // A cell that is too small for the domain, or the domain for it: which of the two, only the user knows.
        if let Some(most) =
            cells.into_iter().filter(|&cells| cells >= MOST_CELLS).max_by(f64::total_cmp)
        {
            let least = f64::from(dx) * most / MOST_CELLS;
            return Err(MpmError::Field {
                field: "cell_width".into(),
                found: format!("{dx}, {most:.3e} cells in a domain of {domain:?}"),
                expected: format!(
                    "at most 65535 cells on each side: more than {least:.3e}, for example {}",
                    domain[0] / 64.0
                ),
            });
        }
        let whole = |cells: f64| (cells - cells.round()).abs() < 1e-3;
        if !cells.into_iter().all(|cells| whole(cells) && cells.round() >= MIN_CELLS) {
            let next = cells.map(|cells| cells.round().max(MIN_CELLS) as f32 * dx);
            return Err(MpmError::Field {
                field: "domain".into(),
                found: format!("{domain:?}"),
                expected: format!(
                    "{MIN_CELLS} to 65535 whole cells of {dx} on each side, for example {next:?}"
                ),
            });
        }
        if cells.iter().map(|cells| cells.round() + 5.0).product::<f64>() > f64::from(i32::MAX) {
            return Err(MpmError::Field {
                field: "domain".into(),
                found: format!("{domain:?} in cells of {dx}"),
                expected: "fewer than 2^31 nodes".into(),
            });
        }
        let spacing = self.spacing();
        if !(spacing >= dx / MAX_PARTICLES_PER_CELL_WIDTH && spacing <= dx) {
            return Err(MpmError::Field {
                field: "spacing".into(),
                found: spacing.to_string(),
                expected: format!(
                    "between a {MAX_PARTICLES_PER_CELL_WIDTH}th of a cell and a cell ({dx})"
                ),
            });
        }
        Ok(GridShape { cells: cells.map(|cells| cells.round() as u32), dx })
    }

    /// Checks the range of every number. [`Scene::particles`] checks that bodies fit.
    ///
    /// # Errors
    /// [`MpmError::Field`] with the first field that is out of range.
    pub fn check(&self) -> Result<(), MpmError> {
        self.grid()?;
        let gravity = self.solver.gravity;
        if !(gravity.is_finite() && gravity <= 0.0) {
            return Err(MpmError::Field {
                field: "solver.gravity".into(),
                found: gravity.to_string(),
                expected: "0 or a negative number: gravity is along y, and negative is down".into(),
            });
        }
        let resolve = self.resolve();
        let flows = !(self.emitters.is_empty() && self.drains.is_empty());
        if !(1..=MAX_RESOLVE).contains(&resolve) || resolve > 1 && flows {
            let with = if flows { " with emitters or drains" } else { "" };
            return Err(MpmError::Field {
                field: "solver.resolve".into(),
                found: format!("{resolve}{with}"),
                expected: format!("1 to {MAX_RESOLVE}, 1 with emitters or drains"),
            });
        }
        self.frames.check()?;
        let Materials { stiffness, viscosity, wall_friction, friction_angle_degrees, .. } =
            self.materials;
        positive("materials.stiffness", stiffness.into(), MAX_STIFFNESS)?;
        if viscosity != 0.0 {
            positive("materials.viscosity", viscosity.into(), MAX_STIFFNESS)?;
        }
        if wall_friction != 0.0 {
            positive("materials.wall_friction", wall_friction.into(), MAX_FRICTION)?;
        }
        let degrees = friction_angle_degrees.into();
        positive("materials.friction_angle_degrees", degrees, MAX_FRICTION_ANGLE)?;
        self.attractor.iter().try_for_each(Attractor::check)?;
        for (index, body) in self.bodies.iter().enumerate() {
            body.check(&format!("bodies[{index}]"))?;
        }
        for (index, emitter) in self.emitters.iter().enumerate() {
            emitter.check(&format!("emitters[{index}]"), self)?;
        }
        for (index, drain) in self.drains.iter().enumerate() {
            drain.check(&format!("drains[{index}]"))?;
        }
        tool::check(&self.tools, self)?;
        if self.bodies.is_empty() && self.emitters.is_empty() {
            return Err(MpmError::Field {
                field: "bodies".into(),
                found: "none".into(),
                expected: "at least one body or emitter".into(),
            });
        }
        Ok(())
    }

    /// The initial particles of the bodies.
    ///
    /// # Errors
    /// As [`Scene::check`]; [`MpmError::Field`] for a body without particles,
    /// [`MpmError::Outside`] and [`MpmError::Overlap`] for bodies that overlap a wall or each other.
    pub fn particles(&self) -> Result<Vec<Particle>, MpmError> {
        self.resolved_particles(1)
    }

    /// The same with `times`^2 particles, side by side, in the place of each.
    pub(super) fn resolved_particles(&self, times: u32) -> Result<Vec<Particle>, MpmError> {
        self.check()?;
        let mut particles = Vec::new();
        let mut owners = Vec::new();
        for (index, body) in self.bodies.iter().enumerate() {
            let positions = body.positions(self.spacing());
            let least = body.particles.unwrap_or(1).max(1);
            if positions.len() < least {
                return Err(MpmError::Field {
                    field: format!("bodies[{index}].shape"),
                    found: format!("room for {} particles", positions.len()),
                    expected: format!("for at least {least}: enlarge it, or reduce the spacing"),
                });
            }
            owners.resize(particles.len() + positions.len(), index);
            particles.extend(positions.into_iter().map(|position| Particle {
                velocity: body.velocity,
                ..Particle::at_rest(position, body.material)
            }));
        }
        placement::check(&self.bodies, &particles, &owners, self.grid()?, self.spacing())?;
        let mut numbered: Vec<_> = particles.into_iter().zip(owners).collect();
        self.order.sort(&mut numbered, self.spacing());
        let parts = |(particle, owner): (Particle, usize)| {
            let offsets = self.bodies[owner].offsets(self.spacing(), times);
            offsets.map(move |[x, y]| Particle {
                position: [particle.position[0] + x, particle.position[1] + y],
                ..particle
            })
        };
        let bodies: Vec<usize> = numbered.iter().map(|(_, owner)| *owner).collect();
        let particles: Vec<Particle> = numbered.into_iter().flat_map(parts).collect();
        tool::check_room(&self.tools, &particles, &bodies)?;
        Ok(particles)
    }

    /// Approximate maximum number of particles, without creating them.
    pub fn estimate(&self) -> f64 {
        let bodies: f64 = self.bodies.iter().map(|body| body.estimate(self.spacing())).sum();
        let emitted: f64 = self.emitters.iter().map(|emitter| f64::from(emitter.particles)).sum();
        bodies + emitted
    }

    /// Approximate memory of a simulation (bytes).
    ///
    /// # Errors
    /// As [`Scene::grid`].
    pub fn memory(&self) -> Result<u64, MpmError> {
        let nodes: f64 = self.grid()?.cells.map(|cells| f64::from(cells) + 1.0).iter().product();
        let parts = f64::from(self.resolve()).powi(2);
        // The cast saturates.
        Ok((parts * (self.estimate() * PARTICLE_BYTES + nodes * NODE_BYTES)) as u64)
    }

    /// The materials that occur, in the order of their numbers.
    pub fn materials(&self) -> Vec<Material> {
        let occurs = |material: &Material| {
            self.bodies.iter().any(|body| body.material == *material)
                || self.emitters.iter().any(|emitter| emitter.material == *material)
        };
        Material::ALL.into_iter().filter(occurs).collect()
    }

    /// What its tools are, if it has any.
    pub fn tools_of_stream(&self) -> Option<Tools> {
        let tools: Vec<_> = self.tools.iter().map(Tool::body).collect();
        (!tools.is_empty()).then_some(Tools { stream: self.id, tools })
    }

    /// The largest speed of a tool's surface, as far as it lies in the domain (domain lengths per s).
    pub(super) fn fastest_tool(&self) -> f32 {
        self.tools.iter().map(|tool| tool.fastest(self.domain)).fold(0.0, f32::max)
    }

    /// Estimated maximum speed of bodies: the sum of the highest initial speed, the attractor's pull and a fall through
    /// the whole domain (domain lengths per second). Jets of splashes reached 3.2 times this speed.
    pub fn fastest(&self) -> f32 {
        let speed = |[u, v]: [f32; 2]| u.hypot(v);
        let bodies = self.bodies.iter().map(|body| speed(body.velocity));
        let emitters = self.emitters.iter().map(|emitter| speed(emitter.velocity));
        let start = bodies.chain(emitters).fold(0.0, f32::max);
        let pulled = self
            .attractor
            .map_or(0.0, |a| a.strength.abs() * a.frames as f32 * self.frames.interval);
        start + pulled + (2.0 * self.solver.gravity.abs() * self.domain[1]).sqrt()
    }
}

/// Checks that a number is positive and at most `most`.
pub(super) fn positive(field: &str, found: f64, most: f64) -> Result<(), MpmError> {
    if found > 0.0 && found <= most {
        return Ok(());
    }
    let expected = match most {
        f64::MAX => "a positive number".to_owned(),
        1e6.. => format!("a positive number, at most {most:e}"),
        _ => format!("a positive number, at most {most}"),
    };
    Err(MpmError::Field { field: field.into(), found: found.to_string(), expected })
}

/// Checks that a number is finite.
pub(super) fn finite(field: &str, found: f64) -> Result<(), MpmError> {
    if found.is_finite() {
        return Ok(());
    }
    let expected = "a finite number".into();
    Err(MpmError::Field { field: field.into(), found: found.to_string(), expected })
}
