//! Grid to particles for a pack, as [`g2p`](super::super::g2p).

use super::{
    super::{
        g2p::LEAST_SEEN,
        material::Law,
        step::Step,
        water::{MAX_AREA, RELAXATION_TIME, max_area},
    },
    field::Nodes,
    obstacles::Kept,
    pack::Pack,
    scatter::seen_of_row,
    simd::{LANES, Simd},
    stencil::{Stencils, Weights},
    transfer::Scratch,
};
use eddy_frames::Material;

/// Gathers velocities and their gradients, and advances positions. Particles beside tools gather from the nodes that they see, and what
/// they have `kept`.
#[inline(always)]
pub(super) fn gather<S: Simd>(
    simd: S,
    weights: &Weights<S>,
    pack: &mut Pack,
    field: Nodes<'_>,
    step: &Step,
    (scratch, kept): (&mut Scratch, Option<&Kept>),
) {
    let inverse_dx = simd.splat(step.inverse_dx);
    let position = [simd.load(&pack.position[0]), simd.load(&pack.position[1])];
    let stencils = Stencils::of(simd, [position[0] * inverse_dx, position[1] * inverse_dx]);
    for l in 0..LANES {
        scratch.node[l] = stencils.base[0][l] * field.stride as i32 + stencils.base[1][l];
    }
    for i in 0..3 {
        let distance = simd.splat(i as f32) - stencils.offset[0];
        simd.store(stencils.weight[i], &mut scratch.weight[i]);
        simd.store(stencils.weight[i] * distance, &mut scratch.moment[i]);
    }
    simd.store(stencils.offset[1], &mut scratch.offset);
    if step.moduli.law.is_water() {
        correct_area(simd, weights, pack, field, step, (scratch, kept));
    }
    let Scratch { node, offset, weight, moment, vectors, .. } = scratch;
    // Unused lanes hold copies of another particle.
    for l in 0..LANES {
        let [a, b, c] = field.velocities(node[l] as usize);
        let (mut a, mut b, mut c) = (simd.load_pairs(a), simd.load_pairs(b), simd.load_pairs(c));
        if let Some(kept) = kept {
            a = a * simd.twice(seen_of_row(simd, kept.visible[l], 0));
            b = b * simd.twice(seen_of_row(simd, kept.visible[l], 1));
            c = c * simd.twice(seen_of_row(simd, kept.visible[l], 2));
        }
        let straight = simd.splat_pairs(weight[0][l]) * a
            + simd.splat_pairs(weight[1][l]) * b
            + simd.splat_pairs(weight[2][l]) * c;
        let slanted = simd.splat_pairs(moment[0][l]) * a
            + simd.splat_pairs(moment[1][l]) * b
            + simd.splat_pairs(moment[2][l]) * c;
        let y = simd.splat_pairs(offset[l]);
        let along = weights.pairs(y);
        let moment_along = along * (weights.places - y);
        // The velocity, and its moments along y and x (cells).
        let sums = simd.sums([straight * along, straight * moment_along, slanted * along]);
        vectors[0][l] = sums[0];
        vectors[1][l] = sums[1];
        vectors[2][l] = sums[2];
    }
    let mut velocity = simd.load_vectors(&vectors[0]);
    let mut along_y = simd.load_vectors(&vectors[1]);
    let mut along_x = simd.load_vectors(&vectors[2]);
    if let Some(kept) = kept {
        for axis in 0..2 {
            velocity[axis] = velocity[axis] + simd.load(&kept.velocity[axis]);
            along_x[axis] = along_x[axis] + simd.load(&kept.moment[2 * axis]);
            along_y[axis] = along_y[axis] + simd.load(&kept.moment[2 * axis + 1]);
        }
    }
    let (dt, scale) = (simd.splat(step.dt), simd.splat(4.0 * step.inverse_dx));
    for axis in 0..2 {
        simd.store(velocity[axis], &mut pack.velocity[axis]);
        simd.store(scale * along_x[axis], &mut pack.affine[2 * axis]);
        simd.store(scale * along_y[axis], &mut pack.affine[2 * axis + 1]);
        simd.store(position[axis] + dt * velocity[axis], &mut pack.position[axis]);
    }
}

/// Relaxes the area of water towards the density of the grid, or lets it follow the area of the grid, as [`water`](super::super::water).
#[inline(always)]
fn correct_area<S: Simd>(
    simd: S,
    weights: &Weights<S>,
    pack: &mut Pack,
    field: Nodes<'_>,
    step: &Step,
    (scratch, kept): (&mut Scratch, Option<&Kept>),
) {
    let liquid = simd.splat(f32::from(Material::Liquid as u8));
    let liquid_lanes = simd.equal(simd.load(&pack.material), liquid);
    if simd.count(liquid_lanes) == 0 {
        return;
    }
    let Scratch { node, offset, weight, liquid: followed, .. } = scratch;
    for l in 0..LANES {
        let [a, b, c] = field.liquid(node[l] as usize);
        let (mut a, mut b, mut c) = (simd.load_ones(a), simd.load_ones(b), simd.load_ones(c));
        if let Some(kept) = kept {
            a = a * seen_of_row(simd, kept.visible[l], 0);
            b = b * seen_of_row(simd, kept.visible[l], 1);
            c = c * seen_of_row(simd, kept.visible[l], 2);
        }
        let straight = simd.splat_ones(weight[0][l]) * a
            + simd.splat_ones(weight[1][l]) * b
            + simd.splat_ones(weight[2][l]) * c;
        followed[l] = simd.sum_ones(straight * weights.ones(simd.splat_ones(offset[l])));
    }
    let side = simd.load(&pack.deformation[0]);
    let area = side * simd.load(&pack.deformation[3]);
    let mut followed = simd.load(followed);
    if let Some(kept) = kept {
        let own = match step.settling {
            Some(_) => area,
            None => simd.splat(step.particles_per_cell) / area,
        };
        // As `g2p::advance`.
        let seen = simd.load(&kept.seen);
        let share = simd.max(seen, LEAST_SEEN);
        followed = (followed + (share - seen) * own) / share;
    }
    let area = if let Some(settling) = step.settling {
        let following = area + (followed - area) * simd.splat(settling.following);
        simd.min(following, max_area(Law::Settling))
    } else {
        let target = simd.min(simd.splat(step.particles_per_cell) / followed, MAX_AREA);
        area + (target - area) * simd.splat((step.dt / RELAXATION_TIME).min(1.0))
    };
    let side = simd.sqrt(area);
    for k in [0, 3] {
        let kept = simd.load(&pack.deformation[k]);
        simd.store(simd.select(liquid_lanes, side, kept), &mut pack.deformation[k]);
    }
}
