//! What a network will predict although it was not made for it, or for which it takes something as given.

use std::fmt;

use crate::{
    checkpoint::{Architecture, Description},
    kernels::spacing::spacing,
};
use eddy_frames::{Frame, Material};

/// By which factor particles may be closer together or further apart than in training before it is
/// remarked upon. Those of a splash, in the middle of a scene, are not all a spacing apart.
const SPACING_FACTOR: f32 = 1.5;

/// A remark on the first frame of a stream.
#[derive(Clone, Debug, PartialEq)]
pub enum Remark {
    /// The box is of another size than in training: its walls are taken to be as thick.
    Domain {
        /// Width and height in the frame (domain lengths).
        found: [f32; 2],
        /// Width and height in training (domain lengths).
        expected: [f32; 2],
    },
    /// Particles are closer together, or further apart, than in training: forces between them will be
    /// wrong.
    Spacing {
        /// Median distance to the nearest particle in the frame (domain lengths).
        found: f32,
        /// The same at rest in training (domain lengths).
        expected: f32,
    },
    /// The stream is not seen from its beginning, and has solids: they are taken to be at rest, neither
    /// stretched nor bent.
    RestShape {
        /// Sequence number of the frame.
        sequence: u64,
    },
}

impl fmt::Display for Remark {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Domain { found: [x, y], expected: [u, v] } => write!(
                f,
                "domain: found {x} x {y}, trained in {u} x {v}: walls are taken to be as thick"
            ),
            Self::Spacing { found, expected } => write!(
                f,
                "spacing of particles: found {found:.5}, trained with {expected:.5}: predictions will be poor"
            ),
            Self::RestShape { sequence } => write!(
                f,
                "joined at sequence {sequence}: jelly and rope are taken to be unstrained there, and keep that shape"
            ),
        }
    }
}

/// What there is to say about a stream that begins with `frame`.
pub(super) fn remarks(description: &Description, frame: &Frame) -> Vec<Remark> {
    let mut remarks = Vec::new();
    let Some(surroundings) = &description.surroundings else { return remarks };
    debug_assert_eq!(description.architecture, Architecture::Particle);
    let size = |lower: [f32; 2], upper: [f32; 2]| [upper[0] - lower[0], upper[1] - lower[1]];
    let found = size(frame.domain.lower, frame.domain.upper);
    let expected = size(description.domain.lower, description.domain.upper);
    if (0..2).any(|axis| (found[axis] - expected[axis]).abs() > 1e-6 * expected[axis]) {
        remarks.push(Remark::Domain { found, expected });
    }
    let (found, expected) = (spacing(&frame.position), surroundings.spacing);
    if found.is_finite() && !(1.0 / SPACING_FACTOR..SPACING_FACTOR).contains(&(found / expected)) {
        remarks.push(Remark::Spacing { found, expected });
    }
    let solid = |material: &Material| matches!(material, Material::Jelly | Material::Rope);
    if frame.sequence > 0 && frame.material.iter().any(solid) {
        remarks.push(Remark::RestShape { sequence: frame.sequence });
    }
    remarks
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

    fn remarked(frame: &Frame) -> Vec<String> {
        let sizes = Sizes { encoder: 4, hidden: 4, layers: 1, particles: None };
        let description = Description::untrained(Architecture::Particle, Core::MinGru, sizes);
        remarks(&description, frame).iter().map(ToString::to_string).collect()
    }

    #[test]
    fn what_a_network_was_made_for_is_not_remarked_upon() {
        assert!(remarked(&frame(1.0 / 128.0, Material::Jelly, 0)).is_empty());
        assert!(remarked(&frame(1.0 / 128.0, Material::Liquid, 7)).is_empty());
    }

    #[test]
    fn another_domain_another_spacing_and_a_late_beginning_are_named() {
        let mut frame = frame(0.02, Material::Rope, 57);
        frame.domain.upper = [2.0, 1.0];
        assert_eq!(
            remarked(&frame),
            [
                "domain: found 2 x 1, trained in 1 x 1: walls are taken to be as thick",
                "spacing of particles: found 0.02000, trained with 0.00781: predictions will be poor",
                "joined at sequence 57: jelly and rope are taken to be unstrained there, and keep that shape",
            ]
        );
    }
}
