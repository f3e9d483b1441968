//! The input features of the networks. Those of the particle model; pairs are along x and y:
//!
//! | inputs | feature |
//! |---|---|
//! | 2 | velocity, in units of u ([`velocity_unit`]) |
//! | 2 | velocity residual: velocity minus the one that the ballistic step expected one frame ago; 0 at first; likewise |
//! | 2 | wall impulse: velocity change at a wall in the coming ballistic step; likewise |
//! | 8 | proximity exp(-d / s) to the left, lower, right, upper wall at the scale s = [`CONTACT_SCALE`], then [`BODY_SCALE`] |
//! | 5 | shape of solids ([`rest_shape`](crate::kernels::rest_shape)): strain xx, yy, xy, bend along x and y |
//! | 4 | material, one-hot; as many as `material_inputs` says |
//! | 1 | stiffness of the stream, [`stiffness_feature`]; only of a network that is conditioned on it |
//!
//! [`stiffness_feature`]: crate::engine::scales::stiffness_feature
//!
//! The velocity residual distinguishes a particle that rests on others from one in free fall. No feature gives the position
//! in the domain, which may be larger than in training.
//!
//! 1. This file: the features of a block of particles, for predictions and for training.
//! 2. `trajectories`: all particles of some frames, for training, with the gradients.
//! 3. `frame`: the features of the frame model.
//! 4. `device.cu`, [`DEVICE`]: those of the particle model on GPUs, with the gradients.
//!
//! The definition in burn is `model/features.rs` of `eddy-learning`.

mod frame;
mod trajectories;

pub use frame::FrameFeatures;
pub(crate) use frame::STATE;
pub use trajectories::{Gradients, Trajectories};

use pulp::Simd;

use super::{
    ballistic::{Ballistic, Motion},
    linear::packed::{load, store},
};
use crate::{
    checkpoint::{Description, layout::particle_features},
    engine::scales::{BODY_SCALE, CONTACT_SCALE, velocity_unit},
    kernels::{
        math::exp,
        rest_shape::{RestShape, SHAPE_FEATURES},
    },
};
use eddy_frames::Domain;

/// The features of the particle model on GPUs.
pub const DEVICE: &str = include_str!("device.cu");

/// Proximity to four walls at two scales.
const PROXIMITIES: usize = 8;

/// Columns from which the features are computed, x and y of each: position, velocity, expected velocity, and position and
/// velocity after the ballistic step.
pub(crate) const STATE_COLUMNS: usize = 10;

/// First features of wall proximity, shape of solids, and material.
const WALLS: usize = 6;
const SHAPE: usize = WALLS + PROXIMITIES;
const MATERIAL: usize = SHAPE + SHAPE_FEATURES;

/// Scale of the features, and the ballistic step they refer to.
#[derive(Clone, Debug)]
pub struct ParticleFeatures {
    /// In the checkpoint's domain.
    ballistic: Ballistic,
    domain: Domain,
    /// F.
    pub(crate) count: usize,
    /// Unit of velocities (domain lengths per second).
    pub(crate) velocity_unit: f32,
}

/// The particles of a frame.
pub(crate) struct ParticleInputs<'a> {
    pub(crate) position: &'a [[f32; 2]],
    pub(crate) velocity: &'a [[f32; 2]],
    /// The ballistic step in the frame's domain.
    pub(crate) ballistic: Ballistic,
    pub(crate) material: &'a [u8],
    pub(crate) rest: &'a RestShape,
    /// The feature of the stream's stiffness, if the network is conditioned on it.
    pub(crate) stiffness: Option<f32>,
}

impl ParticleFeatures {
    /// Of the described network.
    pub fn new(description: &Description) -> Self {
        Self {
            ballistic: Ballistic::new(description),
            domain: description.domain,
            count: particle_features(description),
            velocity_unit: velocity_unit(&description.normalization),
        }
    }

    /// The ballistic step in a domain of any size: walls keep the distance from its corners that they have in the
    /// checkpoint's domain.
    pub(crate) fn ballistic(&self, domain: &Domain) -> Ballistic {
        self.ballistic.for_domain(&self.domain, domain)
    }

    /// Writes a block's features to `columns`, `[F, length]`, and what they are computed from to `states`,
    /// `[STATE_COLUMNS, length]`, for the given particles. `expected_velocity` is the velocity that the ballistic step
    /// predicted for a particle one frame ago.
    #[inline(always)]
    pub(crate) fn fill<S: Simd>(
        &self,
        simd: S,
        inputs: &ParticleInputs,
        particles: &[u32],
        expected_velocity: impl Fn(usize) -> [f32; 2],
        (states, length): (&mut [f32], usize),
        columns: &mut [f32],
    ) {
        let ParticleInputs { position, velocity, material, rest, stiffness, .. } = inputs;
        let (shape, last) = columns.split_at_mut(MATERIAL * length);
        last.fill(0.0);
        if let Some(stiffness) = stiffness {
            // The last feature.
            last[(self.count - 1 - MATERIAL) * length..].fill(*stiffness);
        }
        for (place, &particle) in particles.iter().enumerate() {
            let particle = particle as usize;
            let seen = [position[particle], velocity[particle], expected_velocity(particle)];
            for (column, number) in seen.as_flattened().iter().enumerate() {
                states[column * length + place] = *number;
            }
            let shape_features = rest.shape_of(particle, position);
            for (column, number) in shape_features.iter().enumerate() {
                shape[(SHAPE + column) * length + place] = *number;
            }
            last[usize::from(material[particle]) * length + place] = 1.0;
        }
        let vectors = particles.len().div_ceil(S::F32_LANES);
        self.motion_features(simd, &inputs.ballistic, vectors, (states, length), columns);
    }

    /// The ballistic step and the features of motion and walls, for a number of vectors of particles.
    #[inline(always)]
    fn motion_features<S: Simd>(
        &self,
        simd: S,
        ballistic: &Ballistic,
        vectors: usize,
        (states, length): (&mut [f32], usize),
        columns: &mut [f32],
    ) {
        let Ballistic { gravity, dt, lower, upper } = *ballistic;
        let (zero, half) = (simd.splat_f32s(0.0), simd.splat_f32s(0.5));
        let per_unit = simd.splat_f32s(1.0 / self.velocity_unit);
        let interval = simd.splat_f32s(dt);
        for axis in 0..2 {
            let fall = simd.splat_f32s(gravity[axis] * dt);
            let (low, high) = (simd.splat_f32s(lower[axis]), simd.splat_f32s(upper[axis]));
            for vector in 0..vectors {
                let place = |column: usize| {
                    let begin = column * length + vector * S::F32_LANES;
                    begin..begin + S::F32_LANES
                };
                let x = load(simd, &states[place(axis)]);
                let v = load(simd, &states[place(2 + axis)]);
                let expected_velocity = load(simd, &states[place(4 + axis)]);
                // As `Ballistic::step`, including NaN.
                let free = simd.add_f32s(v, fall);
                let mean = simd.mul_f32s(half, simd.add_f32s(v, free));
                let to = simd.add_f32s(x, simd.mul_f32s(mean, interval));
                let clamped = simd.select_f32s(simd.greater_than_f32s(to, low), to, low);
                let clamped = simd.select_f32s(simd.less_than_f32s(clamped, high), clamped, high);
                let stopped = simd.select_f32s(simd.equal_f32s(clamped, to), free, zero);
                store(simd, &mut states[place(6 + axis)], clamped);
                store(simd, &mut states[place(8 + axis)], stopped);

                let residual = simd.sub_f32s(v, expected_velocity);
                let wall_impulse = simd.sub_f32s(stopped, free);
                store(simd, &mut columns[place(axis)], simd.mul_f32s(v, per_unit));
                store(simd, &mut columns[place(2 + axis)], simd.mul_f32s(residual, per_unit));
                store(simd, &mut columns[place(4 + axis)], simd.mul_f32s(wall_impulse, per_unit));
                let sides = [simd.sub_f32s(x, low), simd.sub_f32s(high, x)];
                for (side, distance) in sides.into_iter().enumerate() {
                    let inside = simd.greater_than_f32s(distance, zero);
                    let distance = simd.select_f32s(inside, distance, zero);
                    for (scale, reach) in [CONTACT_SCALE, BODY_SCALE].into_iter().enumerate() {
                        let apart = simd.mul_f32s(distance, simd.splat_f32s(-1.0 / reach));
                        let column = WALLS + 4 * scale + 2 * side + axis;
                        store(simd, &mut columns[place(column)], exp(simd, apart));
                    }
                }
            }
        }
    }
}

/// The motion of a particle after the ballistic step, from the `states` of [`ParticleFeatures::fill`].
#[inline(always)]
pub(crate) fn ballistic_motion(states: &[f32], length: usize, place: usize) -> Motion {
    let of = |column: usize| states[column * length + place];
    ([of(6), of(7)], [of(8), of(9)])
}
