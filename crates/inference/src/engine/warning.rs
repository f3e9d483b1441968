//! Inputs that a network can predict, but was not trained for, and assumptions it makes about them.

use std::fmt;

use crate::{
    checkpoint::{Architecture, Description},
    kernels::spacing::spacing,
};
use eddy_frames::{Frame, Material};

/// Factor by which the spacing of particles may differ from training without a warning. In a splash, spacing is uneven.
const SPACING_FACTOR: f32 = 1.5;

/// A warning about the first frame of a stream.
#[derive(Clone, Debug, PartialEq)]
pub enum Warning {
    /// The domain has another size than in training: its walls are assumed to be as thick.
    Domain {
        /// Width and height in the frame (domain lengths).
        found: [f32; 2],
        /// Width and height in training (domain lengths).
        expected: [f32; 2],
    },
    /// Particles are closer together or further apart than in training: forces between them will be wrong.
    Spacing {
        /// Median distance to the nearest particle in the frame (domain lengths).
        found: f32,
        /// The same at rest in training (domain lengths).
        expected: f32,
    },
    /// The stream was not observed from its beginning and contains solids: their shape in this frame is taken as their rest
    /// shape.
    RestShape {
        /// Sequence number of the frame.
        sequence: u64,
    },
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Domain { found: [x, y], expected: [u, v] } => write!(
                f,
                "domain is {x} x {y}, model was trained on {u} x {v}; assuming walls of the same thickness"
            ),
            Self::Spacing { found, expected } => write!(
                f,
                "particle spacing is {found:.5}, model was trained on {expected:.5}; predictions will be poor"
            ),
            Self::RestShape { sequence } => write!(
                f,
                "joined at sequence {sequence}; assuming that jelly and rope are unstrained in this frame"
            ),
        }
    }
}

/// Warnings about a stream that begins with `frame`.
pub(super) fn warnings(description: &Description, frame: &Frame) -> Vec<Warning> {
    let mut warnings = Vec::new();
    let Some(grid) = &description.grid else { return warnings };
    debug_assert_eq!(description.architecture, Architecture::Particle);
    let size = |lower: [f32; 2], upper: [f32; 2]| [upper[0] - lower[0], upper[1] - lower[1]];
    let found = size(frame.domain.lower, frame.domain.upper);
    let expected = size(description.domain.lower, description.domain.upper);
    if (0..2).any(|axis| (found[axis] - expected[axis]).abs() > 1e-6 * expected[axis]) {
        warnings.push(Warning::Domain { found, expected });
    }
    let (found, expected) = (spacing(&frame.position), grid.spacing);
    if found.is_finite() && !(1.0 / SPACING_FACTOR..SPACING_FACTOR).contains(&(found / expected)) {
        warnings.push(Warning::Spacing { found, expected });
    }
    let solid = |material: &Material| matches!(material, Material::Jelly | Material::Rope);
    if frame.sequence > 0 && frame.material.iter().any(solid) {
        warnings.push(Warning::RestShape { sequence: frame.sequence });
    }
    warnings
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::{Core, Sizes};
    use eddy_frames::{Domain, Stamp};

    /// A lattice of one material.
    fn frame(step: f32, material: Material, sequence: u64) -> Frame {
        let position: Vec<_> =
            (0..36).map(|k| [0.3 + step * (k % 6) as f32, 0.3 + step * (k / 6) as f32]).collect();
        Frame {
            stream: 0,
            sequence,
            stamp: Stamp(0),
            dt: 0.016,
            domain: Domain::UNIT,
            velocity: vec![[0.0; 2]; position.len()],
            material: vec![material; position.len()],
            position,
        }
    }

    fn displayed(frame: &Frame) -> Vec<String> {
        let sizes = Sizes { encoder: 4, hidden: 4, layers: 1, particles: None };
        let description = Description::untrained(Architecture::Particle, Core::MinGru, sizes);
        warnings(&description, frame).iter().map(ToString::to_string).collect()
    }

    #[test]
    fn data_like_the_training_data_causes_no_warning() {
        assert!(displayed(&frame(1.0 / 128.0, Material::Jelly, 0)).is_empty());
        assert!(displayed(&frame(1.0 / 128.0, Material::Liquid, 7)).is_empty());
    }

    #[test]
    fn another_domain_another_spacing_and_a_late_start_cause_warnings() {
        let mut frame = frame(0.02, Material::Rope, 57);
        frame.domain.upper = [2.0, 1.0];
        assert_eq!(
            displayed(&frame),
            [
                "domain is 2 x 1, model was trained on 1 x 1; assuming walls of the same thickness",
                "particle spacing is 0.02000, model was trained on 0.00781; predictions will be poor",
                "joined at sequence 57; assuming that jelly and rope are unstrained in this frame",
            ]
        );
    }
}
