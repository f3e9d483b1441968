//! Why a network cannot be used, or not for a frame.

use crate::checkpoint::CheckpointError;

/// A number of any size with about three digits.
fn significant(number: f32) -> String {
    let digits = usize::from(number < 100.0) * 2;
    if number < 1e6 { format!("{number:.digits$}") } else { format!("{number:.1e}") }
}

/// Why a network cannot be used, or not for a frame.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The weights do not match the description.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The device that predicts has failed.
    #[error("{0}")]
    Device(String),
    /// The factors cannot be multiplied in bfloat16.
    #[error("precision: found bf16, expected {expected}")]
    Precision {
        /// What can.
        expected: &'static str,
    },
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
    /// A stream's stiffness that the network cannot use, or none where it is conditioned on one.
    #[error("stiffness: found {found}, expected {expected}")]
    Stiffness {
        /// The stiffness, or nothing.
        found: String,
        /// What it should be.
        expected: &'static str,
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
    /// Particles are far outside of the frame's domain; probably the units are wrong.
    #[error("positions reach {} domain lengths, expected at most {expected}: units?", significant(*found))]
    Outside {
        /// Largest distance of a particle from a wall of the domain (widths or heights of the domain).
        found: f32,
        /// Largest accepted distance (the same).
        expected: f32,
    },
    /// Particles are much faster than any in training; probably the units are wrong.
    #[error(
        "velocities reach {} domain lengths/s, {} times the largest in training ({}): units?",
        significant(*found),
        significant(*found / *learned),
        significant(*learned)
    )]
    Fast {
        /// Largest component of a velocity (domain lengths/s).
        found: f32,
        /// The same in training.
        learned: f32,
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
