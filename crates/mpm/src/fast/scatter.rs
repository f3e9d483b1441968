//! Particles to grid for a pack, as [`p2g`](super::super::p2g).

use super::{
    super::step::Step,
    chunk::Chunk,
    law,
    level::Work,
    pack::Pack,
    simd::{LANES, Simd},
    stencil::{Stencils, Weights},
    transfer::Scratch,
};
use eddy_frames::Material;

/// Computes the momentum that each particle scatters, `w (lowest + i along_x + j along_y)` at the node (i, j) of its
/// stencil, per mass (domain lengths per s).
#[inline(always)]
pub(super) fn prepare<S: Simd, const SETTLING: bool>(
    simd: S,
    pack: &Pack,
    stress: &law::Stress<S>,
    stencils: &Stencils<S>,
    chunk: &Chunk,
    step: &Step,
    scratch: &mut Scratch,
) {
    let (impulse, dx) = (simd.splat(step.impulse), simd.splat(step.dx));
    let [xx, xy, yy] = *stress;
    let mut affine = [xx, xy, xy, yy];
    for (affine, c) in affine.iter_mut().zip(&pack.affine) {
        *affine = (impulse * *affine + simd.load(c)) * dx;
    }
    let along_x = [affine[0], affine[2]];
    let along_y = [affine[1], affine[3]];
    let [fx, fy] = stencils.offset;
    let mut lowest = [simd.load(&pack.velocity[0]), simd.load(&pack.velocity[1])];
    for axis in 0..2 {
        lowest[axis] = lowest[axis] - along_x[axis] * fx - along_y[axis] * fy;
    }
    simd.store_vectors(lowest, &mut scratch.vectors[0]);
    simd.store_vectors(along_x, &mut scratch.vectors[1]);
    simd.store_vectors(along_y, &mut scratch.vectors[2]);
    for i in 0..3 {
        simd.store(stencils.weight[i], &mut scratch.weight[i]);
    }
    simd.store(fy, &mut scratch.offset);
    if SETTLING {
        let area = simd.load(&pack.deformation[0]) * simd.load(&pack.deformation[3]);
        let is_liquid = law::is(simd, pack, Material::Liquid);
        let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
        simd.store(simd.select(is_liquid, area, zero), &mut scratch.area);
        scratch.has_solids = simd.count(is_liquid) < LANES;
        if scratch.has_solids {
            simd.store(simd.select(is_liquid, zero, one), &mut scratch.solid);
        }
    }
    for l in 0..LANES {
        let [x, y] = [stencils.base[0][l] - chunk.origin[0], stencils.base[1][l] - chunk.origin[1]];
        scratch.node[l] = x * chunk.stride as i32 + y;
    }
}

/// Scatters the particles of a pack; those of solids with `SOLIDS` only, with the law `settling`; to nodes that are `visible` only, if
/// this is given: the nodes (i, j) that each sees, as bits 3 i + j.
#[inline(always)]
pub(super) fn scatter<S: Simd, const SETTLING: bool, const SOLIDS: bool>(
    simd: S,
    weights: &Weights<S>,
    (scratch, lanes): (&Scratch, usize),
    visible: Option<&[u16; LANES]>,
    chunk: &mut Chunk,
    cell: &mut CellSum<S>,
) {
    let Scratch { node, offset, weight, area, solid, vectors, .. } = scratch;
    let [lowest, along_x, along_y] = vectors;
    for l in 0..lanes {
        let at = node[l] as usize;
        if at != cell.at {
            cell.flush::<SETTLING>(simd, chunk);
            *cell = CellSum::zero(simd);
            cell.at = at;
        }
        if SOLIDS {
            cell.has_solids = true;
        }
        let along = weights.pairs(simd.splat_pairs(offset[l]));
        let mass = weights.ones(simd.splat_ones(offset[l]));
        let across = weights.places * simd.repeat(&along_y[l]);
        let mut momentum = along * (simd.repeat(&lowest[l]) + across);
        let next = along * simd.repeat(&along_x[l]);
        for (i, weight) in weight.iter().enumerate() {
            let (mut of_row, mut mass) = (momentum, mass);
            if let Some(visible) = visible {
                let seen = seen_of_row(simd, visible[l], i);
                (of_row, mass) = (momentum * simd.twice(seen), mass * seen);
            }
            cell.momentum[i] = cell.momentum[i] + simd.splat_pairs(weight[l]) * of_row;
            cell.mass[i] = cell.mass[i] + simd.splat_ones(weight[l]) * mass;
            if SETTLING {
                cell.area[i] = cell.area[i] + simd.splat_ones(weight[l] * area[l]) * mass;
            }
            if SOLIDS {
                cell.solid[i] = cell.solid[i] + simd.splat_ones(weight[l] * solid[l]) * mass;
            }
            momentum = momentum + next;
        }
    }
}

/// Scatters the particles of a pack to the nodes that they see only.
pub(super) struct ScatterSeen<'a, const SETTLING: bool> {
    pub(super) scratch: Scratch,
    pub(super) lanes: usize,
    /// The nodes (i, j) that each sees, as bits 3 i + j.
    pub(super) visible: [u16; LANES],
    pub(super) chunk: &'a mut Chunk,
}

impl<const SETTLING: bool> Work for ScatterSeen<'_, SETTLING> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { scratch, lanes, visible, chunk } = self;
        let (weights, mut sum) = (&Weights::new(simd), CellSum::zero(simd));
        let (of, visible) = ((&scratch, lanes), Some(&visible));
        if SETTLING && scratch.has_solids {
            scatter::<S, true, true>(simd, weights, of, visible, chunk, &mut sum);
        } else {
            scatter::<S, SETTLING, false>(simd, weights, of, visible, chunk, &mut sum);
        }
        sum.flush::<SETTLING>(simd, chunk);
    }
}

/// 1 for each node of row `i` that a particle sees, else 0.
#[inline(always)]
pub(super) fn seen_of_row<S: Simd>(simd: S, visible: u16, i: usize) -> S::Ones {
    simd.load_ones(&SEEN[usize::from(visible >> (3 * i) & 7)])
}

/// By three bits: 1 for each node of a row that a particle sees, else 0.
const SEEN: [[f32; 4]; 8] = [
    [0.0, 0.0, 0.0, 0.0],
    [1.0, 0.0, 0.0, 0.0],
    [0.0, 1.0, 0.0, 0.0],
    [1.0, 1.0, 0.0, 0.0],
    [0.0, 0.0, 1.0, 0.0],
    [1.0, 0.0, 1.0, 0.0],
    [0.0, 1.0, 1.0, 0.0],
    [1.0, 1.0, 1.0, 0.0],
];

/// Sum over consecutive particles of one cell, in registers, added to the patch when the cell changes.
pub(super) struct CellSum<S: Simd> {
    /// Index of the lowest node in the patch; `usize::MAX` at first.
    at: usize,
    momentum: [S::Pairs; 3],
    mass: [S::Ones; 3],
    /// With the law `settling`, mass times J of liquids.
    area: [S::Ones; 3],
    /// The mass of solids, where there are any.
    solid: [S::Ones; 3],
    has_solids: bool,
}

impl<S: Simd> CellSum<S> {
    #[inline(always)]
    pub(super) fn zero(simd: S) -> Self {
        let none = [simd.splat_ones(0.0); 3];
        let momentum = [simd.splat_pairs(0.0); 3];
        Self { at: usize::MAX, momentum, mass: none, area: none, solid: none, has_solids: false }
    }

    /// Adds the sum to the patch.
    #[inline(always)]
    pub(super) fn flush<const SETTLING: bool>(&self, simd: S, chunk: &mut Chunk) {
        if self.at == usize::MAX {
            return;
        }
        for i in 0..3 {
            let (momentum, mass) = chunk.nodes(self.at, i);
            simd.store_pairs(simd.load_pairs(momentum) + self.momentum[i], momentum);
            simd.store_ones(simd.load_ones(mass) + self.mass[i], mass);
            if SETTLING {
                let [solid, area] = chunk.settling_nodes(self.at, i);
                simd.store_ones(simd.load_ones(area) + self.area[i], area);
                if self.has_solids {
                    simd.store_ones(simd.load_ones(solid) + self.solid[i], solid);
                }
            }
        }
    }
}
