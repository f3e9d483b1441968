//! Packs: sixteen particles as a structure of arrays.

use super::{
    super::{matrix::Matrix2, particle::Particle},
    simd::{LANES, Lanes},
};
use eddy_frames::Material;

/// The state of sixteen particles.
#[derive(Clone, Debug)]
#[repr(align(64))]
pub(super) struct Pack {
    /// Positions along x and y (domain lengths).
    pub(super) position: [Lanes; 2],
    /// Velocities along x and y (domain lengths per s).
    pub(super) velocity: [Lanes; 2],
    /// C of APIC: xx, xy, yx, yy (1/s).
    pub(super) affine: [Lanes; 4],
    /// F: xx, xy, yx, yy.
    pub(super) deformation: [Lanes; 4],
    /// Jp of snow.
    pub(super) plastic: Lanes,
    /// [`Material`] as its number.
    pub(super) material: Lanes,
    /// Index of each particle in the solver.
    pub(super) index: [u32; LANES],
}

impl Pack {
    /// A pack with the same particle in all lanes; unused lanes keep this copy.
    pub(super) fn filled(particle: &Particle, index: u32) -> Self {
        let Matrix2 { xx, xy, yx, yy } = particle.deformation;
        let affine = particle.affine;
        Self {
            position: particle.position.map(|x| [x; LANES]),
            velocity: particle.velocity.map(|v| [v; LANES]),
            affine: [affine.xx, affine.xy, affine.yx, affine.yy].map(|c| [c; LANES]),
            deformation: [xx, xy, yx, yy].map(|f| [f; LANES]),
            plastic: [particle.plastic; LANES],
            material: [f32::from(particle.material as u8); LANES],
            index: [index; LANES],
        }
    }

    /// Stores a particle in a lane.
    pub(super) fn set(&mut self, lane: usize, particle: &Particle, index: u32) {
        let (c, f) = (particle.affine, particle.deformation);
        for axis in 0..2 {
            self.position[axis][lane] = particle.position[axis];
            self.velocity[axis][lane] = particle.velocity[axis];
        }
        for (k, number) in [c.xx, c.xy, c.yx, c.yy].into_iter().enumerate() {
            self.affine[k][lane] = number;
        }
        for (k, number) in [f.xx, f.xy, f.yx, f.yy].into_iter().enumerate() {
            self.deformation[k][lane] = number;
        }
        self.plastic[lane] = particle.plastic;
        self.material[lane] = f32::from(particle.material as u8);
        self.index[lane] = index;
    }

    /// The particle in a lane.
    pub(super) fn get(&self, lane: usize) -> Particle {
        let matrix = |m: &[Lanes; 4]| Matrix2::new(m[0][lane], m[1][lane], m[2][lane], m[3][lane]);
        Particle {
            position: self.position.map(|x| x[lane]),
            velocity: self.velocity.map(|v| v[lane]),
            affine: matrix(&self.affine),
            deformation: matrix(&self.deformation),
            plastic: self.plastic[lane],
            // Stored by `set`, so valid.
            material: Material::ALL[self.material[lane] as usize % Material::ALL.len()],
        }
    }
}
