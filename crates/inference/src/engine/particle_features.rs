//! What the particle model sees of each particle: `model/features.rs` for a block of slots.

use pulp::Simd;

use super::{
    Ballistic,
    linear::{load, store},
    scales::{FAR, NEAR, velocity_unit},
};
use crate::{
    checkpoint::{Description, layout::PARTICLE_FEATURES},
    kernels::{
        math::exp,
        rest::{Rest, SHAPE_FEATURES},
    },
};
use eddy_frames::Domain;

/// F.
pub(super) const FEATURES: usize = PARTICLE_FEATURES;

/// Nearness of four walls at two scales.
const NEARNESSES: usize = 8;

/// Columns of numbers of a block before they are features: positions, velocities and the velocities
/// that were foretold, then what the ballistic step makes of the first two, along x and y each.
pub(super) const STATES: usize = 10;

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
    /// In the order of the stream's memory, as all else here.
    pub(super) position: &'a [[f32; 2]],
    pub(super) velocity: &'a [[f32; 2]],
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
        self.ballistic.moved(&self.domain, domain)
    }

    /// Fills the columns of a block's features, `[F, length]`, and of its `states`, `[STATES, length]`, for
    /// the particles with these numbers. `foretold` gives the velocity the ballistic step foretold one frame
    /// ago for a particle.
    #[inline(always)]
    pub(super) fn fill<S: Simd>(
        &self,
        simd: S,
        known: &Known,
        particles: &[u32],
        foretold: impl Fn(usize) -> [f32; 2],
        (states, length): (&mut [f32], usize),
        columns: &mut [f32],
    ) {
        let Known { position, velocity, material, rest, .. } = known;
        let (shape, last) = columns.split_at_mut(MATERIAL * length);
        last.fill(0.0);
        for (place, &particle) in particles.iter().enumerate() {
            let particle = particle as usize;
            let seen = [position[particle], velocity[particle], foretold(particle)];
            for (column, number) in seen.as_flattened().iter().enumerate() {
                states[column * length + place] = *number;
            }
            let strained = rest.shape_of(particle, position);
            for (column, number) in strained.iter().enumerate() {
                shape[(SHAPE + column) * length + place] = *number;
            }
            last[usize::from(material[particle]) * length + place] = 1.0;
        }
        let vectors = particles.len().div_ceil(S::F32_LANES);
        self.see(simd, &known.ballistic, vectors, (states, length), columns);
    }

    /// The ballistic step and the features that come from a particle's own state, so many vectors of
    /// particles.
    #[inline(always)]
    fn see<S: Simd>(
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
                let foretold = load(simd, &states[place(4 + axis)]);
                // As `Ballistic::step`, what is not a number included.
                let free = simd.add_f32s(v, fall);
                let mean = simd.mul_f32s(half, simd.add_f32s(v, free));
                let to = simd.add_f32s(x, simd.mul_f32s(mean, interval));
                let held = simd.select_f32s(simd.greater_than_f32s(to, low), to, low);
                let held = simd.select_f32s(simd.less_than_f32s(held, high), held, high);
                let stopped = simd.select_f32s(simd.equal_f32s(held, to), free, zero);
                store(simd, &mut states[place(6 + axis)], held);
                store(simd, &mut states[place(8 + axis)], stopped);

                let push = simd.sub_f32s(v, foretold);
                let stop = simd.sub_f32s(stopped, free);
                store(simd, &mut columns[place(axis)], simd.mul_f32s(v, per_unit));
                store(simd, &mut columns[place(2 + axis)], simd.mul_f32s(push, per_unit));
                store(simd, &mut columns[place(4 + axis)], simd.mul_f32s(stop, per_unit));
                let sides = [simd.sub_f32s(x, low), simd.sub_f32s(high, x)];
                for (side, distance) in sides.into_iter().enumerate() {
                    let inside = simd.greater_than_f32s(distance, zero);
                    let distance = simd.select_f32s(inside, distance, zero);
                    for (scale, reach) in [NEAR, FAR].into_iter().enumerate() {
                        let apart = simd.mul_f32s(distance, simd.splat_f32s(-1.0 / reach));
                        let column = WALLS + 4 * scale + 2 * side + axis;
                        store(simd, &mut columns[place(column)], exp(simd, apart));
                    }
                }
            }
        }
    }
}

/// The ballistic step of the particle in a place, from the columns of [`Features::fill`].
#[inline(always)]
pub(super) fn fallen(states: &[f32], length: usize, place: usize) -> State {
    let of = |column: usize| states[column * length + place];
    ([of(6), of(7)], [of(8), of(9)])
}
