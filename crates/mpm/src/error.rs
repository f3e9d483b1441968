//! Why a simulation cannot start or go on.

use std::fmt;

use eddy_frames::{InvalidFrame, Material};

/// Why a simulation cannot start or go on.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MpmError {
    /// A field of a scene is out of its range.
    #[error("{field}: found {found}, expected {expected}")]
    Field {
        /// The field, as a file names it.
        field: String,
        /// Its value.
        found: String,
        /// What it should be.
        expected: String,
    },
    /// A body reaches into a wall or out of the domain.
    #[error(
        "bodies[{body}]: found a particle at {position:?}, expected all between the walls, {:?} to {:?}; \
         move the body, make it smaller or the domain larger", room[0], room[1]
    )]
    Outside {
        /// Number of the body, from 0.
        body: usize,
        /// Where the first such particle is (domain lengths).
        position: [f32; 2],
        /// The corners of the room between the walls (domain lengths).
        room: [[f32; 2]; 2],
    },
    /// Two bodies are in the same place.
    #[error(
        "bodies[{}] and bodies[{}]: found both near {position:?}, expected bodies that do not overlap; \
         move one or make it smaller", bodies[0], bodies[1]
    )]
    Overlap {
        /// Numbers of the two bodies, from 0.
        bodies: [usize; 2],
        /// Where a particle of the first is (domain lengths).
        position: [f32; 2],
    },
    /// The substeps asked for are too few for the scene to stay stable.
    #[error(
        "substeps: found {requested}, expected at least {minimum} a frame because of {limit} \
         (E = {stiffness}, grid {}x{}); ask for more, or leave them out", cells[0], cells[1]
    )]
    Unstable {
        /// Substeps a frame that were asked for.
        requested: u32,
        /// Substeps a frame that are needed.
        minimum: u32,
        /// What needs them.
        limit: Limit,
        /// Young's modulus E (density x velocity^2).
        stiffness: f32,
        /// Cells of the grid along x and y.
        cells: [u32; 2],
    },
    /// A particle has left the grid, moved further than a cell in a substep, or its position is no
    /// number.
    #[error(
        "particle {particle} ({}): found position {position:?} after {time:.3} s, expected one inside the walls, \
         within a cell of that a substep before; more substeps or another stiffness may help",
        material.name()
    )]
    Diverged {
        /// Index of the particle.
        particle: usize,
        /// What it is made of.
        material: Material,
        /// Where it is.
        position: [f32; 2],
        /// Begin of the frame interval in which it happened: simulated time since the scene was set
        /// up, the time before the recording included (s).
        time: f64,
    },
    /// The state is no whole frame: a velocity is no number.
    #[error(transparent)]
    Frame(#[from] InvalidFrame),
}

/// What sets the smallest number of substeps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Limit {
    /// Sound must not cross more than half a cell in a substep.
    Sound(Material),
    /// Particles must not cross more than half a cell in a substep; their largest speed (domain
    /// lengths per second).
    Speed(f32),
    /// Momentum must not spread over more than half a cell in a substep: `dt <= dx^2 / (4 nu)`, with
    /// this kinematic viscosity nu (domain lengths^2 per s).
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
