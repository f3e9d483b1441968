//! Why a network cannot be used, or not for a frame.

use crate::checkpoint::CheckpointError;
use eddy_frames::{Domain, InvalidFrame};

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
    /// The frame model was trained on another number of particles.
    #[error("particles: found {found}, expected {expected} as in the checkpoint")]
    Particles {
        /// Particles in the frame.
        found: usize,
        /// Particles of the network.
        expected: usize,
    },
    /// The frame contains a material that the training data did not have.
    #[error(
        "material[{particle}]: found {found}, expected one of {expected} as in the checkpoint: use one that knows it, or train on such data"
    )]
    Material {
        /// First particle of that material.
        particle: usize,
        /// Its material.
        found: &'static str,
        /// The checkpoint's materials.
        expected: String,
    },
    /// The frame interval differs from the one in training.
    #[error(
        "dt: found {found} s, expected {expected} s as in the checkpoint: publish frames that far apart, or train on such data"
    )]
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
        /// The frame's domain.
        found: Domain,
        /// The checkpoint's.
        expected: Domain,
    },
    /// The domain is not larger than its two walls together.
    #[error("lower, upper: found {found}, expected a width above {} and a height above {}, for the walls", expected[0], expected[1])]
    Narrow {
        /// The frame's domain.
        found: Domain,
        /// Thickness of both walls together, on each axis (domain lengths).
        expected: [f32; 2],
    },
    /// No simulation has such a state; probably the units are wrong.
    #[error(transparent)]
    Implausible(#[from] InvalidFrame),
    /// A particle is much faster than any in training; probably the units are wrong.
    #[error(
        "velocity[{particle}]: found {} domain lengths/s along an axis, expected at most {}, twice the largest in training: units?",
        significant(*found), significant(*expected)
    )]
    Fast {
        /// The first such particle.
        particle: usize,
        /// Its largest component (domain lengths/s).
        found: f32,
        /// The largest accepted one (the same).
        expected: f32,
    },
    /// The domain is so large for its number of particles that empty grid cells would dominate the cost.
    #[error(
        "lower, upper: found {found}, {cells:.0} cells of {cell_width} domain lengths, expected at most {most}: units?"
    )]
    Wide {
        /// The frame's domain.
        found: Domain,
        /// Number of cells in it.
        cells: f32,
        /// The checkpoint's cell width (domain lengths).
        cell_width: f32,
        /// Largest accepted number of cells.
        most: usize,
    },
}
