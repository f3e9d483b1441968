//! What the particle model sees of each particle: `model/features.rs` for a block of slots.

use pulp::Simd;

use crate::{
    checkpoint::{Description, layout::PARTICLE_FEATURES},
    frame::{Domain, Frame},
    kernels::{
        math::exp,
        rest::{Rest, SHAPE_FEATURES},
    },
    model::{
        Ballistic,
        features::{FAR, NEAR, velocity_unit},
    },
};

/// F.
pub(super) const FEATURES: usize = PARTICLE_FEATURES;

/// Nearness of four walls at two scales.
const NEARNESSES: usize = 8;

/// Particles whose nearnesses are computed at once: as many as fill the longest vectors.
const TOGETHER: usize = 2;

/// Where nearness, the shape of solids and the material are among the features.
const WALLS: usize = 6;
const SHAPE: usize = WALLS + NEARNESSES;
const MATERIAL: usize = SHAPE + SHAPE_FEATURES;

/// Position and velocity of a particle.
pub(super) type State = ([f32; 2], [f32; 2]);

/// Scales of the features, and the ballistic step they refer to.
#[derive(Debug)]
pub(super) struct Features {
    /// In the checkpoint's domain.
    ballistic: Ballistic,
    domain: Domain,
    /// Unit of velocities (domain lengths per second).
    pub(super) velocity_unit: f32,
}

/// What is known of the particles before the network.
pub(super) struct Known<'a> {
    pub(super) frame: &'a Frame,
    /// The ballistic step in the frame's domain.
    pub(super) ballistic: Ballistic,
    pub(super) material: &'a [u8],
    pub(super) rest: &'a Rest,
}

impl Features {
    pub(super) fn new(description: &Description) -> Self {
        Self {
            ballistic: Ballistic::of(description),
            domain: description.domain,
            velocity_unit: velocity_unit(&description.normalization),
        }
    }

    /// The ballistic step in a domain of any size: walls in effect are as far from its corners as in the
    /// checkpoint's.
    pub(super) fn ballistic(&self, domain: &Domain) -> Ballistic {
        let mut moved = self.ballistic;
        for axis in 0..2 {
            // A domain like the checkpoint's has its very numbers.
            if domain.lower[axis] != self.domain.lower[axis] {
                let thickness = self.ballistic.lower[axis] - self.domain.lower[axis];
                moved.lower[axis] = domain.lower[axis] + thickness;
            }
            if domain.upper[axis] != self.domain.upper[axis] {
                let thickness = self.domain.upper[axis] - self.ballistic.upper[axis];
                moved.upper[axis] = domain.upper[axis] - thickness;
            }
        }
        moved
    }

    /// Fills `rows`, `[count, F]`, for the particles with these numbers, and `fallen` with their ballistic
    /// step. `foretold` gives the velocity the step foretold one frame ago for a particle.
    #[inline(always)]
    pub(super) fn fill<S: Simd>(
        &self,
        simd: S,
        known: &Known,
        particles: &[u32],
        foretold: impl Fn(usize) -> [f32; 2],
        fallen: &mut [State],
        rows: &mut [f32],
    ) {
        let Known { frame, ballistic, material, rest } = known;
        let Ballistic { gravity, dt, lower, upper } = *ballistic;
        let (rows, _) = rows.as_chunks_mut::<FEATURES>();
        let per_unit = 1.0 / self.velocity_unit;
        // Walls of several particles fill a vector.
        let mut walls = [[0.0; NEARNESSES]; TOGETHER];
        let groups = rows.chunks_mut(TOGETHER).zip(fallen.chunks_mut(TOGETHER));
        for ((rows, fallen), particles) in groups.zip(particles.chunks(TOGETHER)) {
            let all = rows.iter_mut().zip(fallen).zip(particles);
            for (((row, fallen), &particle), walls) in all.zip(&mut walls) {
                let particle = particle as usize;
                let (x, v) = (frame.position[particle], frame.velocity[particle]);
                *fallen = ballistic.step(x, v);
                let foretold = foretold(particle);
                for axis in 0..2 {
                    let stopped = fallen.1[axis] - (v[axis] + gravity[axis] * dt);
                    row[axis] = v[axis] * per_unit;
                    row[2 + axis] = (v[axis] - foretold[axis]) * per_unit;
                    row[4 + axis] = stopped * per_unit;
                    let below = (x[axis] - lower[axis]).max(0.0);
                    let above = (upper[axis] - x[axis]).max(0.0);
                    for (half, distance) in [(0, below), (2, above)] {
                        walls[half + axis] = distance * (-1.0 / NEAR);
                        walls[4 + half + axis] = distance * (-1.0 / FAR);
                    }
                }
                let shape = rest.shape_of(particle, &frame.position);
                row[SHAPE..MATERIAL].copy_from_slice(&shape);
                row[MATERIAL..].fill(0.0);
                row[MATERIAL + usize::from(material[particle])] = 1.0;
            }
            let (vectors, _) = S::as_mut_simd_f32s(walls.as_flattened_mut());
            for vector in vectors {
                *vector = exp(simd, *vector);
            }
            for (row, walls) in rows.iter_mut().zip(&walls) {
                row[WALLS..SHAPE].copy_from_slice(walls);
            }
        }
    }
}
