//! Why a network cannot be used, or not for a frame.

use crate::checkpoint::CheckpointError;

/// Why a network cannot be used, or not for a frame.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The weights do not match the description.
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
    /// The frame contains a material that the training data did not have.
    #[error("material[{particle}]: found {found}, expected one of {expected} as in the checkpoint")]
    Material {
        /// First particle of that material.
        particle: usize,
        /// Its material.
        found: &'static str,
        /// The checkpoint's materials.
        expected: String,
    },
    /// The frame interval differs from the one in training.
    #[error("dt: found {found} s, expected {expected} s as in the checkpoint")]
    Interval {
        /// The frame's interval (s).
        found: f32,
        /// The checkpoint's (s).
        expected: f32,
    },
    /// The domain differs from the one in training (frame model only).
    #[error("lower, upper: found {found}, expected {expected} as in the checkpoint")]
    Domain {
        /// The frame's corners.
        found: String,
        /// The checkpoint's.
        expected: String,
    },
    /// The domain is not larger than its two walls together.
    #[error("lower, upper: found {found}, expected more than {expected:?} from corner to corner")]
    Narrow {
        /// The frame's corners.
        found: String,
        /// Thickness of both walls together, on each axis (domain lengths).
        expected: [f32; 2],
    },
    /// The domain is so large for its number of particles that empty grid cells would dominate the cost.
    #[error(
        "lower, upper: found {found}, {cells} of the checkpoint's cells, expected at most {most}"
    )]
    Wide {
        /// The frame's corners.
        found: String,
        /// Number of cells in it.
        cells: f32,
        /// Largest accepted number of cells.
        most: usize,
    },
}
