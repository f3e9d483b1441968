//! Why a simulation cannot start or continue.

use std::fmt;

use eddy_frames::{InvalidFrame, Material};

/// Why a simulation cannot start or continue.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MpmError {
    /// A field of a scene is out of its range.
    #[error("{field}: found {found}, expected {expected}")]
    Field {
        /// The field as in scene files.
        field: String,
        /// Its value.
        found: String,
        /// What it should be.
        expected: String,
    },
    /// A body reaches into a wall or out of the domain.
    #[error(
        "bodies[{body}]: found a particle at {position:?}, expected all between the walls, {:?} to {:?}; \
         move or shrink the body, or enlarge the domain", room[0], room[1]
    )]
    Outside {
        /// Index of the body.
        body: usize,
        /// Position of the first such particle (domain lengths).
        position: [f32; 2],
        /// Corners of the region between the walls (domain lengths).
        room: [[f32; 2]; 2],
    },
    /// Two bodies overlap.
    #[error(
        "bodies[{}] and bodies[{}] overlap near {position:?}; \
         move or shrink one of them", bodies[0], bodies[1]
    )]
    Overlap {
        /// Indices of the two bodies.
        bodies: [usize; 2],
        /// Position of a particle of the first one (domain lengths).
        position: [f32; 2],
    },
    /// Too few substeps for stability.
    #[error(
        "substeps: found {requested}, expected at least {minimum} per frame because of {limit} \
         (E = {stiffness}, grid {}x{}); request more, or omit the setting", cells[0], cells[1]
    )]
    Unstable {
        /// Requested substeps per frame.
        requested: u32,
        /// Required substeps per frame.
        minimum: u32,
        /// The limit that requires them.
        limit: Limit,
        /// Young's modulus E (density x velocity^2).
        stiffness: f32,
        /// Cells of the grid along x and y.
        cells: [u32; 2],
    },
    /// A particle has left the grid, moved further than a cell in a substep, or has a position that is not finite.
    #[error(
        "particle {particle} ({}): found position {position:?} after {time:.3} s, expected one inside the walls, \
         within a cell of the previous substep; more substeps or another stiffness may help",
        material.name()
    )]
    Diverged {
        /// Index of the particle.
        particle: usize,
        /// Its material.
        material: Material,
        /// Its position (domain lengths).
        position: [f32; 2],
        /// Start of the frame interval in which it happened: simulated time since the start of the scene, including the
        /// time before the recording (s).
        time: f64,
    },
    /// The device that runs the substeps has failed.
    #[error("{0}")]
    Device(String),
    /// The state is not a valid frame: a velocity is not finite.
    #[error(transparent)]
    Frame(#[from] InvalidFrame),
}

/// What determines the minimum number of substeps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Limit {
    /// Sound must not cross more than half a cell in a substep.
    Sound(Material),
    /// Particles must not cross more than half a cell in a substep, given their maximum speed (domain lengths per second).
    Speed(f32),
    /// Momentum must not diffuse over more than half a cell in a substep: `dt <= dx^2 / (4 nu)`, with this kinematic
    /// viscosity nu (domain lengths^2 per s).
    Viscosity(f32),
}

impl fmt::Display for Limit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Sound(material) => write!(f, "sound in {}", material.name()),
            Self::Speed(speed) => write!(f, "particles of up to {speed:.1} lengths/s"),
            Self::Viscosity(viscosity) => write!(f, "a viscosity of {viscosity} lengths^2/s"),
        }
    }
}
