//! Why a simulation cannot start or go on.

use std::fmt;

use crate::frame::{InvalidFrame, Material};

/// Why a simulation cannot start or go on.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MpmError {
    /// A setting is out of its range.
    #[error("{field}: found {found}, expected {expected}")]
    Setting {
        /// The setting.
        field: &'static str,
        /// Its value.
        found: f64,
        /// What it should be.
        expected: &'static str,
    },
    /// The substeps asked for are too few for the scene to stay stable.
    #[error(
        "substeps: found {requested}, expected at least {minimum} a frame because of {limit} \
         (E = {stiffness}, grid {cells}x{cells})"
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
        /// Cells on a side of the grid.
        cells: u32,
    },
    /// A particle has left the grid, or its position is no number.
    #[error(
        "particle {particle} ({}): found position {position:?} after {time:.3} s, expected one inside the walls; \
         more substeps or a smaller stiffness may help",
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
