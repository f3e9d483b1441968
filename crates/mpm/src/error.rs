//! Why a simulation cannot start or continue.

use std::fmt;

use eddy_frames::{InvalidFrame, Material, tool::InvalidTool};

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
        "particle {particle} ({}): found position {position:?} in the frame after {time:.3} s, expected one inside the walls, \
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
    /// Substeps were too long for a particle in the course of the scene.
    #[error(
        "particle {particle}: found {substeps} substeps per frame in the frame after {time:.3} s, too few because of {limit}; \
         reduce speeds, gravity or stiffness"
    )]
    TooLong {
        /// Index of the particle.
        particle: usize,
        /// Its limit.
        limit: Limit,
        /// Start of the frame interval, as in [`MpmError::Diverged`] (s).
        time: f64,
        /// Substeps per frame.
        substeps: u32,
    },
    /// The requested substeps were too few in the course of the scene.
    #[error(
        "substeps: found {requested}, expected at least {enough} per frame; request them, or omit the setting ({reason})"
    )]
    TooFew {
        /// Requested substeps per frame.
        requested: u32,
        /// Substeps per frame with which the scene runs to its end.
        enough: u32,
        /// What happened with the requested ones.
        reason: Box<Self>,
    },
    /// Matter is in a state that the laws do not describe, with any number of substeps.
    #[error(
        "particle {particle} ({}) at {position:?}: found {cause} in the frame after {time:.3} s, with up to {substeps} substeps per frame; {}",
        material.name(), cause.remedy()
    )]
    Collapsed {
        /// Index of a particle.
        particle: usize,
        /// Its material.
        material: Material,
        /// Its position (domain lengths).
        position: [f32; 2],
        /// Start of the frame interval, as in [`MpmError::Diverged`] (s).
        time: f64,
        /// The most substeps that the interval was run with.
        substeps: u32,
        /// What is wrong.
        cause: Collapse,
    },
    /// The simulation was cancelled within a frame.
    #[error("interrupted")]
    Cancelled,
    /// The device that runs the substeps has failed.
    #[error("{0}")]
    Device(String),
    /// The state is not a valid frame: a velocity is not finite.
    #[error(transparent)]
    Frame(#[from] InvalidFrame),
}

impl From<InvalidTool> for MpmError {
    fn from(InvalidTool { field, found, expected }: InvalidTool) -> Self {
        Self::Field { field, found, expected }
    }
}

/// A state that the laws of matter do not describe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Collapse {
    /// Matter compressed to this fraction of its area.
    Crushed(f32),
    /// This many particles in a cell, and as many as it has in undeformed matter.
    Dense(u32, f32),
    /// The energy of all particles, and all that they have had or got (density x domain lengths^4 per s^2).
    Energy(f64, f64),
}

impl Collapse {
    /// What the user can do.
    fn remedy(self) -> &'static str {
        match self {
            Self::Crushed(_) | Self::Dense(..) => {
                "the impact is too violent for matter of this stiffness: reduce speeds or gravity, or increase the stiffness"
            }
            Self::Energy(..) => "reduce speeds or gravity, or request more substeps from the start",
        }
    }
}

impl fmt::Display for Collapse {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Crushed(area) if *area > 0.0 => {
                write!(f, "matter crushed to {area:.2} of its area")
            }
            Self::Crushed(_) => write!(f, "matter turned inside out"),
            Self::Dense(found, usual) => {
                write!(f, "{found} particles in a cell instead of {usual:.0}")
            }
            Self::Energy(found, most) => {
                write!(f, "the energy grown to {found:.3e}, expected at most {most:.3e}")
            }
        }
    }
}

/// What determines the minimum number of substeps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Limit {
    /// Sound must not cross more than half a cell in a substep.
    Sound(Material),
    /// Particles must not cross more than half a cell in a substep, given their maximum speed (domain lengths per second).
    Speed(f32),
    /// Tools must not move further than half a cell in a substep, given the largest speed of their surfaces (domain lengths per
    /// second).
    Tool(f32),
    /// Matter must not be strained by more than a quarter in a substep.
    Strain(Material),
    /// Momentum must not diffuse over more than half a cell in a substep: `dt <= dx^2 / (4 nu)`, with this kinematic
    /// viscosity nu (domain lengths^2 per s).
    Viscosity(f32),
}

impl fmt::Display for Limit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Sound(material) => write!(f, "sound in {}", material.name()),
            Self::Speed(speed) => write!(f, "particles of up to {speed:.1} lengths/s"),
            Self::Tool(speed) => write!(f, "a tool that moves with {speed:.1} lengths/s"),
            Self::Strain(material) => write!(f, "fast strain in {}", material.name()),
            Self::Viscosity(viscosity) => write!(f, "a viscosity of {viscosity} lengths^2/s"),
        }
    }
}
