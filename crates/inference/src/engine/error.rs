//! Why a network cannot be used, or not on these particles.

use crate::checkpoint::CheckpointError;

/// Why a network cannot be used, or not on these particles.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The weights do not fit the description.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The frame model was trained on another number of particles.
    #[error("particles: found {found}, expected {expected} as in the checkpoint")]
    Particles {
        /// Particles in the frame.
        found: usize,
        /// Particles of the network.
        expected: usize,
    },
    /// The frame has a material that the data set did not have.
    #[error("material[{particle}]: found {found}, expected one of {expected} as in the checkpoint")]
    Material {
        /// First particle concerned.
        particle: usize,
        /// Its material.
        found: &'static str,
        /// The checkpoint's materials.
        expected: String,
    },
    /// The frames are further apart, or closer, than in training.
    #[error("dt: found {found} s, expected {expected} s as in the checkpoint")]
    Interval {
        /// The frame's interval (s).
        found: f32,
        /// The checkpoint's (s).
        expected: f32,
    },
    /// The particles are in another box than in training (frame model only).
    #[error("lower, upper: found {found}, expected {expected} as in the checkpoint")]
    Domain {
        /// The frame's corners.
        found: String,
        /// The checkpoint's.
        expected: String,
    },
    /// The box has no room between its walls in effect.
    #[error("lower, upper: found {found}, expected more than {expected:?} from corner to corner")]
    Narrow {
        /// The frame's corners.
        found: String,
        /// Thickness of both walls together, on each axis (domain lengths).
        expected: [f32; 2],
    },
    /// The box is so large for so few particles that the grid's cells would take all the time.
    #[error(
        "lower, upper: found {found}, {cells} of the checkpoint's cells, expected at most {most}"
    )]
    Wide {
        /// The frame's corners.
        found: String,
        /// How many cells there are in it.
        cells: f32,
        /// How many there may be.
        most: usize,
    },
}
