//! The state of one material point.

use super::matrix::Matrix2;
use eddy_frames::Material;

/// A material point: an area of one material that moves and deforms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Particle {
    /// Position (domain lengths).
    pub position: [f32; 2],
    /// Velocity (domain lengths per second).
    pub velocity: [f32; 2],
    /// Affine velocity matrix C of APIC: the local gradient of the velocity (1/s).
    pub affine: Matrix2,
    /// Elastic deformation gradient F.
    pub deformation: Matrix2,
    /// Plastic area ratio Jp of snow; of sand, 1 and the logarithm of the area that it gained when it parted; 1 for other materials.
    pub plastic: f32,
    /// Its material.
    pub material: Material,
}

impl Particle {
    /// An undeformed particle at rest.
    pub const fn at_rest(position: [f32; 2], material: Material) -> Self {
        Self {
            position,
            velocity: [0.0; 2],
            affine: Matrix2::ZERO,
            deformation: Matrix2::IDENTITY,
            plastic: 1.0,
            material,
        }
    }
}
