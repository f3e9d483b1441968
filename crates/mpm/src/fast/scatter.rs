//! Particles to grid: [`p2g`](super::super::p2g) for sixteen particles.

use super::{
    chunk::Chunk,
    law,
    pack::Pack,
    simd::{LANES, Simd},
    stencil::{Stencils, Weights},
    transfer::{Scratch, Step},
};

/// What each particle gives to the nodes around it: `w (lowest + i along_x + j along_y)` at (i, j)
/// cells from the lowest one, momentum per mass (domain lengths per s).
#[inline(always)]
pub(super) fn spread<S: Simd>(
    simd: S,
    pack: &Pack,
    stress: &law::Stress<S>,
    stencils: &Stencils<S>,
    chunk: &Chunk,
    step: &Step,
    scratch: &mut Scratch,
) {
    let (impulse, dx) = (simd.splat(step.impulse), simd.splat(step.dx));
    let affine = |k: usize, stress: S::Lanes| (impulse * stress + simd.load(&pack.affine[k])) * dx;
    let along_x = [affine(0, stress[0]), affine(2, stress[1])];
    let along_y = [affine(1, stress[1]), affine(3, stress[2])];
    let [fx, fy] = stencils.offset;
    let lowest =
        |axis: usize| simd.load(&pack.velocity[axis]) - along_x[axis] * fx - along_y[axis] * fy;
    simd.store_vectors([lowest(0), lowest(1)], &mut scratch.vectors[0]);
    simd.store_vectors(along_x, &mut scratch.vectors[1]);
    simd.store_vectors(along_y, &mut scratch.vectors[2]);
    for i in 0..3 {
        simd.store(stencils.weight[i], &mut scratch.weight[i]);
    }
    simd.store(fy, &mut scratch.offset);
    for l in 0..LANES {
        let [x, y] = [stencils.base[0][l] - chunk.origin[0], stencils.base[1][l] - chunk.origin[1]];
        scratch.node[l] = x * chunk.stride as i32 + y;
    }
}

/// Particles to grid.
#[inline(always)]
pub(super) fn scatter<S: Simd>(
    simd: S,
    weights: &Weights<S>,
    scratch: &Scratch,
    lanes: usize,
    chunk: &mut Chunk,
    held: &mut Held<S>,
) {
    let Scratch { node, offset, weight, vectors: [lowest, along_x, along_y], .. } = scratch;
    for l in 0..lanes {
        let at = node[l] as usize;
        if at != held.at {
            held.give(simd, chunk);
            *held = Held::nothing(simd);
            held.at = at;
        }
        let along = weights.pairs(simd.splat_pairs(offset[l]));
        let mass = weights.ones(simd.splat_ones(offset[l]));
        let across = weights.places * simd.repeat(&along_y[l]);
        let mut momentum = along * (simd.repeat(&lowest[l]) + across);
        let next = along * simd.repeat(&along_x[l]);
        for (i, weight) in weight.iter().enumerate() {
            held.momentum[i] = held.momentum[i] + simd.splat_pairs(weight[l]) * momentum;
            held.mass[i] = held.mass[i] + simd.splat_ones(weight[l]) * mass;
            momentum = momentum + next;
        }
    }
}

/// What the particles of one cell have given so far: it goes to memory when the cell changes.
pub(super) struct Held<S: Simd> {
    /// The lowest node, counted in the patch; none at first.
    at: usize,
    momentum: [S::Pairs; 3],
    mass: [S::Ones; 3],
}

impl<S: Simd> Held<S> {
    #[inline(always)]
    pub(super) fn nothing(simd: S) -> Self {
        let (momentum, mass) = ([simd.splat_pairs(0.0); 3], [simd.splat_ones(0.0); 3]);
        Self { at: usize::MAX, momentum, mass }
    }

    /// Adds it to the patch.
    #[inline(always)]
    pub(super) fn give(&self, simd: S, chunk: &mut Chunk) {
        if self.at == usize::MAX {
            return;
        }
        for i in 0..3 {
            let (momentum, mass) = chunk.nodes(self.at, i);
            simd.store_pairs(simd.load_pairs(momentum) + self.momentum[i], momentum);
            simd.store_ones(simd.load_ones(mass) + self.mass[i], mass);
        }
    }
}
