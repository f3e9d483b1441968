//! Frames without copies.

use super::{Domain, Frame, Material, Stamp};

/// A particle of `D` dimensions in shared memory: 20 bytes in the plane, 28 in space.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C)]
pub struct Particle<const D: usize = 2> {
    /// Position (domain lengths).
    pub position: [f32; D],
    /// Velocity (domain lengths per second).
    pub velocity: [f32; D],
    /// Number of the [`Material`].
    pub material: u32,
}

/// A view of a frame: of the arrays of a [`Frame`], or of the particles in memory that another program has written.
#[derive(Clone, Copy, Debug)]
pub struct FrameView<'a, const D: usize = 2> {
    /// Id of the simulated trajectory.
    pub stream: u64,
    /// Number of the frame in its stream; consecutive.
    pub sequence: u64,
    /// Simulation time of this frame.
    pub stamp: Stamp,
    /// Time between two frames of the stream (s).
    pub dt: f32,
    /// The box that contains the particles.
    pub domain: Domain<D>,
    /// Positions, velocities and materials.
    pub particles: Particles<'a, D>,
}

/// The particles of a frame, in one of two layouts.
#[derive(Clone, Copy, Debug)]
pub enum Particles<'a, const D: usize = 2> {
    /// One array per property, all of the same length.
    Lists {
        /// `[N, D]` (domain lengths).
        position: &'a [[f32; D]],
        /// `[N, D]` (domain lengths per second).
        velocity: &'a [[f32; D]],
        /// `[N]`.
        material: &'a [Material],
    },
    /// One struct per particle.
    Rows(&'a [Particle<D>]),
}

impl<'a, const D: usize> From<&'a Frame<D>> for FrameView<'a, D> {
    fn from(frame: &'a Frame<D>) -> Self {
        let Frame { stream, sequence, stamp, dt, domain, position, velocity, material } = frame;
        let particles = Particles::Lists { position, velocity, material };
        let (stream, sequence, stamp) = (*stream, *sequence, *stamp);
        Self { stream, sequence, stamp, dt: *dt, domain: *domain, particles }
    }
}

impl<'a, const D: usize> Particles<'a, D> {
    /// Number of particles (length of the materials).
    pub fn len(&self) -> usize {
        match self {
            Self::Lists { material, .. } => material.len(),
            Self::Rows(rows) => rows.len(),
        }
    }

    /// Whether there are no particles.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Position and velocity of a particle.
    #[inline(always)]
    pub fn motion(&self, particle: usize) -> ([f32; D], [f32; D]) {
        match self {
            Self::Lists { position, velocity, .. } => (position[particle], velocity[particle]),
            Self::Rows(rows) => {
                let Particle { position, velocity, .. } = rows[particle];
                (position, velocity)
            }
        }
    }

    /// Material of a particle, or its unknown number, saturated at 255.
    #[inline(always)]
    pub fn material(&self, particle: usize) -> Result<Material, u8> {
        match self {
            Self::Lists { material, .. } => Ok(material[particle]),
            Self::Rows(rows) => {
                Material::try_from(u8::try_from(rows[particle].material).unwrap_or(u8::MAX))
            }
        }
    }

    /// The known materials of the particles.
    pub fn materials(self) -> impl Iterator<Item = Material> + 'a {
        (0..self.len()).filter_map(move |particle| self.material(particle).ok())
    }

    /// Whether the particles have these materials, one by one.
    pub fn are_of(&self, materials: &[Material]) -> bool {
        match self {
            Self::Lists { material, .. } => *material == materials,
            Self::Rows(rows) => {
                rows.len() == materials.len()
                    && rows.iter().zip(materials).all(|(row, &kind)| row.material == kind as u32)
            }
        }
    }
}

impl<const D: usize> FrameView<'_, D> {
    /// Copies the frame. Unknown materials become liquid: a [checked](Self::check) frame has none, but another program may
    /// write to the shared memory again, and all arrays must keep the same length.
    pub fn to_frame(&self) -> Frame<D> {
        let Self { stream, sequence, stamp, dt, domain, particles } = *self;
        let motions = || (0..particles.len()).map(|particle| particles.motion(particle));
        Frame {
            stream,
            sequence,
            stamp,
            dt,
            domain,
            position: motions().map(|motion| motion.0).collect(),
            velocity: motions().map(|motion| motion.1).collect(),
            material: (0..particles.len())
                .map(|particle| particles.material(particle).unwrap_or(Material::Liquid))
                .collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_overwritten_material_leaves_all_arrays_at_the_same_length() {
        let rows =
            [0, 9, 3].map(|material| Particle { position: [0.5; 2], velocity: [0.0; 2], material });
        let view = FrameView {
            stream: 1,
            sequence: 2,
            stamp: Stamp(3),
            dt: 0.016,
            domain: Domain::UNIT,
            particles: Particles::Rows(&rows),
        };
        assert!(view.check().is_err());
        let frame = view.to_frame();
        assert_eq!([frame.position.len(), frame.velocity.len(), frame.material.len()], [3; 3]);
    }
}
