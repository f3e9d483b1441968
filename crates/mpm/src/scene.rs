//! A scene: everything that a simulation starts from, as people write it and programs draw it.

use serde::{Deserialize, Serialize};

use super::{
    FRAME_INTERVAL, GRAVITY,
    attractor::Attractor,
    body::Body,
    error::MpmError,
    flow::{Drain, Emitter},
    grid::{GridShape, WALL_CELLS},
    material::Materials,
    particle::Particle,
    placement,
};
use eddy_frames::Material;

/// The finest spacing of particles, as a part of a cell.
const FINEST: f32 = 64.0;
/// The most frame intervals that an attractor acts.
const LONGEST_PULL: u32 = 1000;
/// Cells that a domain has at least on each side: two walls and as much between them.
const FEWEST_CELLS: f64 = 3.0 * WALL_CELLS as f64;

/// Largest stiffness (density x velocity^2); at 1e9 a frame needs 1e5 substeps.
const STIFFEST: f64 = 1e9;
/// Memory of a particle (bytes): its state in the scene, in the solver and in two sets of packs, then
/// as a frame, its message and a part of the bag's chunk.
const PARTICLE_BYTES: f64 = 384.0;
/// Memory of a node (bytes): of the grid of the plain path, the fields of the fast one and its chunks.
const NODE_BYTES: f64 = 64.0;
/// Longest simulated time (s).
const LONGEST: f64 = 1e6;

/// Everything that a simulation starts from. What a file does not say has its default.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Scene {
    /// Number of the scene: the stream of its frames; 0 by default.
    pub id: u64,
    /// Width and height (domain lengths), whole cells; 1 x 1 by default. The outermost three cells
    /// are walls.
    pub domain: [f32; 2],
    /// Width of a cell of the grid (domain lengths); 1/64 by default.
    pub cell_width: f32,
    /// Distance between neighbouring particles (domain lengths); half a cell by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spacing: Option<f32>,
    /// How it is solved.
    pub solver: SolverChoices,
    /// When frames are taken.
    pub frames: Frames,
    /// What the particles are made of.
    pub materials: Materials,
    /// What pulls before the recording starts; nothing by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub attractor: Option<Attractor>,
    /// The bodies, in the order of their particles.
    pub bodies: Vec<Body>,
    /// Where particles come in; nowhere by default.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub emitters: Vec<Emitter>,
    /// Where particles go out; nowhere by default.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub drains: Vec<Drain>,
}

/// How a scene is solved.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SolverChoices {
    /// Acceleration in -y (domain lengths per s^2); 9.8 by default.
    pub gravity: f32,
    /// Substeps a frame; as many as stability needs by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub substeps: Option<u32>,
}

/// When frames are taken.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Frames {
    /// Time between two frames (s); 0.016 by default.
    pub interval: f32,
    /// Simulated time after which the scene ends (s); 10 by default.
    pub duration: f64,
    /// Simulated time after which it ends as soon as it rests (s); the duration by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shortest: Option<f64>,
    /// It rests when the mean kinetic energy per mass, `|v|^2 / 2`, is below this (domain
    /// lengths^2 per s^2); 0.001 by default.
    pub rest: f64,
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
            bodies: Vec::new(),
            emitters: Vec::new(),
            drains: Vec::new(),
        }
    }
}

impl Default for SolverChoices {
    fn default() -> Self {
        Self { gravity: GRAVITY, substeps: None }
    }
}

impl Default for Frames {
    fn default() -> Self {
        Self { interval: FRAME_INTERVAL, duration: 10.0, shortest: None, rest: 1e-3 }
    }
}

impl Scene {
    /// Distance between neighbouring particles (domain lengths).
    pub fn spacing(&self) -> f32 {
        self.spacing.unwrap_or(0.5 * self.cell_width)
    }

    /// The grid that covers the domain.
    ///
    /// # Errors
    /// [`MpmError::Field`] for a domain, cell width or spacing that no grid fits.
    pub fn grid(&self) -> Result<GridShape, MpmError> {
        let Self { domain, cell_width: dx, .. } = *self;
        positive("cell_width", dx.into(), f64::MAX)?;
        let cells = domain.map(|side| f64::from(side) / f64::from(dx));
        let whole = |cells: f64| (cells - cells.round()).abs() < 1e-3 && cells < 65_536.0;
        if !cells.into_iter().all(|cells| whole(cells) && cells.round() >= FEWEST_CELLS) {
            let next = cells.map(|cells| cells.round().max(FEWEST_CELLS) as f32 * dx);
            return Err(MpmError::Field {
                field: "domain".into(),
                found: format!("{domain:?}"),
                expected: format!(
                    "{FEWEST_CELLS} to 65535 whole cells of {dx} on each side, for example {next:?}"
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
        if !(spacing >= dx / FINEST && spacing <= dx) {
            return Err(MpmError::Field {
                field: "spacing".into(),
                found: spacing.to_string(),
                expected: format!("between a {FINEST}th of a cell and a cell ({dx})"),
            });
        }
        Ok(GridShape { cells: cells.map(|cells| cells.round() as u32), dx })
    }

    /// Checks every number on its own. Whether bodies fit is found out by [`Scene::particles`].
    ///
    /// # Errors
    /// [`MpmError::Field`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), MpmError> {
        self.grid()?;
        finite("solver.gravity", self.solver.gravity.into())?;
        let Frames { interval, duration, shortest, rest } = self.frames;
        positive("frames.interval", interval.into(), LONGEST)?;
        positive("frames.duration", duration, LONGEST)?;
        positive("frames.shortest", shortest.unwrap_or(duration), duration)?;
        finite("frames.rest", rest)?;
        let Materials { stiffness, viscosity, .. } = self.materials;
        positive("materials.stiffness", stiffness.into(), STIFFEST)?;
        if viscosity != 0.0 {
            positive("materials.viscosity", viscosity.into(), STIFFEST)?;
        }
        if let Some(Attractor { centre, strength, frames, period }) = self.attractor {
            positive("attractor.period", period.unwrap_or(1.0).into(), f64::MAX)?;
            if frames > LONGEST_PULL {
                return Err(MpmError::Field {
                    field: "attractor.frames".into(),
                    found: frames.to_string(),
                    expected: format!("at most {LONGEST_PULL}"),
                });
            }
            for (name, number) in
                [("centre", centre[0]), ("centre", centre[1]), ("strength", strength)]
            {
                finite(&format!("attractor.{name}"), number.into())?;
            }
        }
        for (index, body) in self.bodies.iter().enumerate() {
            let [x, y] = body.position;
            let [u, v] = body.velocity;
            let field = |name: &str| format!("bodies[{index}].{name}");
            if let Some((name, found, expected)) = body.shape.fault() {
                return Err(MpmError::Field {
                    field: field(name),
                    found,
                    expected: expected.into(),
                });
            }
            for (name, number) in [
                ("position", x),
                ("position", y),
                ("angle_degrees", body.angle_degrees),
                ("velocity", u),
                ("velocity", v),
            ] {
                finite(&field(name), number.into())?;
            }
        }
        for (index, emitter) in self.emitters.iter().enumerate() {
            emitter.check(&format!("emitters[{index}]"), self)?;
        }
        for (index, drain) in self.drains.iter().enumerate() {
            drain.check(&format!("drains[{index}]"))?;
        }
        if self.bodies.is_empty() && self.emitters.is_empty() {
            return Err(MpmError::Field {
                field: "bodies".into(),
                found: "none".into(),
                expected: "at least one body or emitter".into(),
            });
        }
        Ok(())
    }

    /// The particles of the bodies, at the start.
    ///
    /// # Errors
    /// As [`Scene::check`]; [`MpmError::Field`] for a body without particles,
    /// [`MpmError::Outside`] and [`MpmError::Overlap`] for bodies in a wall or in each other.
    pub fn particles(&self) -> Result<Vec<Particle>, MpmError> {
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
                    expected: format!(
                        "for at least {least}: make it larger, or the spacing smaller"
                    ),
                });
            }
            owners.resize(particles.len() + positions.len(), index);
            particles.extend(positions.into_iter().map(|position| Particle {
                velocity: body.velocity,
                ..Particle::at_rest(position, body.material)
            }));
        }
        placement::check(&self.bodies, &particles, &owners, self.grid()?, self.spacing())?;
        Ok(particles)
    }

    /// The most particles that it will hold, about; none are made to find out.
    pub fn estimate(&self) -> f64 {
        let bodies: f64 = self.bodies.iter().map(|body| body.estimate(self.spacing())).sum();
        let emitted: f64 = self.emitters.iter().map(|emitter| f64::from(emitter.particles)).sum();
        bodies + emitted
    }

    /// About how much memory a simulation of it takes (bytes).
    ///
    /// # Errors
    /// As [`Scene::grid`].
    pub fn memory(&self) -> Result<u64, MpmError> {
        let nodes: f64 = self.grid()?.cells.map(|cells| f64::from(cells) + 1.0).iter().product();
        // The cast saturates.
        Ok((self.estimate() * PARTICLE_BYTES + nodes * NODE_BYTES) as u64)
    }

    /// The materials that occur, in the order of their numbers.
    pub fn materials(&self) -> Vec<Material> {
        let occurs = |material: &Material| {
            self.bodies.iter().any(|body| body.material == *material)
                || self.emitters.iter().any(|emitter| emitter.material == *material)
        };
        Material::ALL.into_iter().filter(occurs).collect()
    }

    /// A bound on the speed of bodies: the fastest start, the pull of the attractor, and a fall
    /// through the whole domain added up (domain lengths per second). Jets of a splash were seen to
    /// be 3.2 times as fast.
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

/// Refuses what is not above zero, or above `most`.
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

/// Refuses NaN and the infinities.
pub(super) fn finite(field: &str, found: f64) -> Result<(), MpmError> {
    if found.is_finite() {
        return Ok(());
    }
    let expected = "a finite number".into();
    Err(MpmError::Field { field: field.into(), found: found.to_string(), expected })
}
