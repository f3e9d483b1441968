//! What the particle model sees of each particle: `model/features.rs` for a block of particles.

use pulp::Simd;

use crate::{
    checkpoint::{Description, layout::PARTICLE_FEATURES},
    kernels::math::exp,
    model::{
        Ballistic,
        features::{FAR, NEAR, velocity_unit},
    },
};

/// Nearness of four walls at two scales.
pub(super) const NEARNESSES: usize = 8;

/// Scales of the features, and the ballistic step they refer to.
#[derive(Debug)]
pub(super) struct Features {
    pub(super) ballistic: Ballistic,
    /// Unit of velocity changes (domain lengths per second).
    pub(super) velocity_unit: f32,
    /// Mean velocity (domain lengths per second).
    mean: [f32; 2],
    /// Standard deviation of velocities (domain lengths per second).
    deviation: [f32; 2],
}

impl Features {
    pub(super) fn new(description: &Description) -> Self {
        let scale = &description.normalization;
        let [_, _, mean_x, mean_y] = scale.mean;
        let [_, _, x, y] = scale.standard_deviation;
        Self {
            ballistic: Ballistic::of(description),
            velocity_unit: velocity_unit(scale),
            mean: [mean_x, mean_y],
            deviation: [x, y],
        }
    }

    /// Fills `rows`, `[count, F]`, and `fallen` with the ballistic step. `foretold` is what the step
    /// foretold one frame ago, nothing before the first frame; `nearness` is room for `[count, 8]`.
    #[inline(always)]
    #[expect(
        clippy::too_many_arguments,
        reason = "all that a particle is, and two places to write"
    )]
    pub(super) fn fill<S: Simd>(
        &self,
        simd: S,
        position: &[[f32; 2]],
        velocity: &[[f32; 2]],
        foretold: Option<&[[f32; 2]]>,
        material: &[u8],
        nearness: &mut [f32],
        fallen: &mut [([f32; 2], [f32; 2])],
        rows: &mut [f32],
    ) {
        let Ballistic { gravity, dt, lower, upper } = self.ballistic;
        let (rows, _) = rows.as_chunks_mut::<PARTICLE_FEATURES>();
        let (walls, _) = nearness.as_chunks_mut::<NEARNESSES>();
        for (p, (x, v)) in position.iter().zip(velocity).enumerate() {
            fallen[p] = self.ballistic.step(*x, *v);
            let (row, walls) = (&mut rows[p], &mut walls[p]);
            for axis in 0..2 {
                let push = foretold.map_or(0.0, |foretold| v[axis] - foretold[p][axis]);
                let stopped = fallen[p].1[axis] - (v[axis] + gravity[axis] * dt);
                let below = (x[axis] - lower[axis]).max(0.0);
                let above = (upper[axis] - x[axis]).max(0.0);
                row[axis] = (v[axis] - self.mean[axis]) / self.deviation[axis];
                row[2 + axis] = push / self.velocity_unit;
                row[4 + axis] = stopped / self.velocity_unit;
                row[6 + axis] = (below - above) / (upper[axis] - lower[axis]);
                for (half, distance) in [(0, below), (2, above)] {
                    walls[half + axis] = distance * (-1.0 / NEAR);
                    walls[4 + half + axis] = distance * (-1.0 / FAR);
                }
            }
            row[16..].fill(0.0);
            row[16 + usize::from(material[p])] = 1.0;
        }
        let used = &mut nearness[..position.len() * NEARNESSES];
        let (vectors, rest) = S::as_mut_simd_f32s(used);
        for vector in vectors {
            *vector = exp(simd, *vector);
        }
        let exponential = exp(simd, simd.partial_load_f32s(rest));
        simd.partial_store_f32s(rest, exponential);
        for (row, walls) in rows.iter_mut().zip(used.as_chunks::<NEARNESSES>().0) {
            row[8..16].copy_from_slice(walls);
        }
    }
}
