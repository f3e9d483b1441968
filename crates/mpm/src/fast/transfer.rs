//! The pass over the particles of a chunk: gathers velocities, advances particles, updates their stress and scatters their
//! momentum to the chunk's patch of the grid.
//!
//! All particles have the same mass, so masses and momenta are in units of it.

use super::{
    super::step::Step,
    chunk::Chunk,
    field::Nodes,
    gather::gather,
    law,
    level::Work,
    obstacles::{Kept, Obstacles},
    pack::Pack,
    scatter::{CellSum, prepare, scatter},
    simd::{LANES, Lanes, Simd, Vectors},
    stencil::{Stencils, Weights},
};

/// Scratch buffer of a pack, between vectors over particles and vectors over nodes. Reused without clearing.
#[repr(align(64))]
pub(super) struct Scratch {
    /// Index of each stencil's lowest node.
    pub(super) node: [i32; LANES],
    /// Distance from the lowest node along y (cells).
    pub(super) offset: Lanes,
    /// Weights of the three rows.
    pub(super) weight: [Lanes; 3],
    /// Weights times the distance along x (cells).
    pub(super) moment: [Lanes; 3],
    /// What liquids follow at each particle: the grid's mass, in units of a particle's, or with the law `settling` its J.
    pub(super) liquid: Lanes,
    /// With the law `settling`: J of each liquid particle, 0 for solids.
    pub(super) area: Lanes,
    /// 1 for solids, 0 for liquids, in a pack that has any.
    pub(super) solid: Lanes,
    pub(super) has_solids: bool,
    /// The particles that do not see all of their nodes, as bits, and the nodes (i, j) that each sees, as bits 3 i + j.
    pub(super) apart: u16,
    pub(super) visible: [u16; LANES],
    /// Three vectors per particle.
    pub(super) vectors: [Vectors; 3],
}

impl Scratch {
    const EMPTY: Self = Self {
        node: [0; LANES],
        offset: [0.0; LANES],
        weight: [[0.0; LANES]; 3],
        moment: [[0.0; LANES]; 3],
        liquid: [0.0; LANES],
        area: [0.0; LANES],
        solid: [0.0; LANES],
        has_solids: false,
        apart: 0,
        visible: [0; LANES],
        vectors: [[[0.0; 2]; LANES]; 3],
    };
}

/// The pass over the particles of a chunk. Without `GATHER` particles only scatter their momentum; without `SCATTER` they
/// only gather and move. With `SETTLING` they also scatter their area, for the law of that name.
pub(super) struct Pass<'a, const GATHER: bool, const SCATTER: bool, const SETTLING: bool> {
    pub(super) chunk: &'a mut Chunk,
    /// The chunk's packs.
    pub(super) packs: &'a mut [Pack],
    pub(super) field: Nodes<'a>,
    pub(super) step: &'a Step,
    /// Tools, if there are any.
    pub(super) obstacles: Option<Obstacles<'a>>,
}

impl<const GATHER: bool, const SCATTER: bool, const SETTLING: bool> Work
    for Pass<'_, GATHER, SCATTER, SETTLING>
{
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { chunk, packs, field, step, obstacles } = self;
        let weights = Weights::new(simd);
        if SCATTER {
            chunk.clear::<SETTLING>();
        }
        let mut sum = CellSum::zero(simd);
        let mut scratch = Scratch::EMPTY;
        let mut left = chunk.particles().len();
        let near_parts: Vec<_> = match &obstacles {
            Some(obstacles) if SCATTER => obstacles.near(chunk.bounds()),
            _ => Vec::new(),
        };
        std::mem::swap(&mut chunk.kept, &mut chunk.spare);
        chunk.kept.clear();
        let gathered = std::mem::take(&mut chunk.spare);
        let mut waiting = gathered.as_slice();
        for (number, pack) in packs.iter_mut().enumerate() {
            let lanes = left.min(LANES);
            left -= lanes;
            if GATHER {
                let kept = Kept::take(&mut waiting, number);
                let from = kept.map(|_| pack.position);
                gather(simd, &weights, pack, field, step, &mut scratch, kept);
                if let (Some(obstacles), Some(kept), Some(from)) = (&obstacles, kept, &from) {
                    obstacles.resolve(simd, kept, from, pack, lanes, step);
                }
            }
            let inverse_dx = simd.splat(step.inverse_dx);
            let [x, y] = &pack.position;
            let cell = [simd.load(x) * inverse_dx, simd.load(y) * inverse_dx];
            if !chunk.takes(simd, cell) {
                break;
            }
            if SCATTER {
                let stress = law::advance(simd, pack, &step.moduli, step.dt);
                let stencils = Stencils::of(simd, cell);
                prepare::<S, SETTLING>(simd, pack, &stress, &stencils, chunk, step, &mut scratch);
                if let (Some(obstacles), false) = (&obstacles, near_parts.is_empty()) {
                    let pack = (number, &*pack, lanes);
                    let given = (&stencils, &scratch);
                    let loads = &mut chunk.loads;
                    let kept = obstacles.hide(simd, pack, given, &near_parts, step, loads);
                    scratch.apart = kept.as_ref().map_or(0, |kept| kept.apart);
                    if let Some(kept) = kept {
                        scratch.visible = kept.visible;
                        chunk.kept.push(kept);
                    }
                }
                if SETTLING && scratch.has_solids {
                    scatter::<S, true, true>(simd, &weights, &scratch, lanes, chunk, &mut sum);
                } else {
                    scatter::<S, SETTLING, false>(simd, &weights, &scratch, lanes, chunk, &mut sum);
                }
            }
        }
        chunk.spare = gathered;
        if SCATTER {
            sum.flush::<SETTLING>(simd, chunk);
        }
    }
}
