//! The pass over the particles of a chunk: gathers velocities, advances particles, updates their stress and scatters their
//! momentum to the chunk's patch of the grid.
//!
//! All particles have the same mass, so masses and momenta are in units of it.

use super::{
    super::{step::Step, tool::Barriers},
    chunk::Chunk,
    field::Nodes,
    gather::gather,
    law,
    level::{Level, Work},
    obstacles::{GatherSeen, Hide, Kept, NearTools},
    pack::Pack,
    scatter::{CellSum, ScatterSeen, prepare, scatter},
    simd::{LANES, Lanes, Simd, Vectors},
    stencil::{Stencils, Weights},
};

/// Scratch buffer of a pack, between vectors over particles and vectors over nodes. Reused without clearing.
#[derive(Clone, Copy)]
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
    /// Three vectors per particle.
    pub(super) vectors: [Vectors; 3],
}

impl Scratch {
    pub(super) const EMPTY: Self = Self {
        node: [0; LANES],
        offset: [0.0; LANES],
        weight: [[0.0; LANES]; 3],
        moment: [[0.0; LANES]; 3],
        liquid: [0.0; LANES],
        area: [0.0; LANES],
        solid: [0.0; LANES],
        has_solids: false,
        vectors: [[[0.0; 2]; LANES]; 3],
    };
}

/// What a pass reads.
#[derive(Clone, Copy)]
pub(super) struct Around<'a> {
    pub(super) field: Nodes<'a>,
    pub(super) step: &'a Step,
    /// The tools where they were when particles have scattered, and where they are when they have moved.
    pub(super) barriers: [&'a Barriers; 2],
}

/// The pass over the particles of a chunk. Without `GATHER` particles only scatter their momentum; without `SCATTER` they
/// only gather and move. With `SETTLING` they also scatter their area, for the law of that name.
pub(super) fn pass<const GATHER: bool, const SCATTER: bool, const SETTLING: bool>(
    level: Level,
    chunk: &mut Chunk,
    packs: &mut [Pack],
    around: Around<'_>,
) {
    if SCATTER {
        chunk.clear::<SETTLING>();
    }
    let [_, now] = around.barriers;
    let near = if SCATTER { now.near(chunk.bounds()) } else { Vec::new() };
    let mut left = chunk.particles().len();
    if near.is_empty() && chunk.kept.is_empty() {
        let (first, near, waiting) = (0, &[][..], &mut &[][..]);
        let run = Run { chunk, first, packs, left, around, near, waiting };
        return level.run(Pass::<GATHER, SCATTER, SETTLING, false>(run));
    }
    let kept = chunk.begin_to_keep();
    let mut is_near =
        level.run(NearTools { packs, parts: &now.parts, near: &near, step: around.step });
    kept.iter().for_each(|kept| is_near[kept.pack] = true);
    let mut waiting = kept.as_slice();
    let mut first = 0;
    for packs_alike in is_near.chunk_by(PartialEq::eq) {
        let packs = &mut packs[first..first + packs_alike.len()];
        let here = left.min(packs.len() * LANES);
        let (near, waiting) = (near.as_slice(), &mut waiting);
        let run = Run { chunk, first, packs, left: here, around, near, waiting };
        match packs_alike[0] {
            true => level.run(Pass::<GATHER, SCATTER, SETTLING, true>(run)),
            false => level.run(Pass::<GATHER, SCATTER, SETTLING, false>(run)),
        }
        first += packs_alike.len();
        left -= here;
        if chunk.lost {
            break;
        }
    }
    chunk.spare = kept;
}

/// Consecutive packs of a chunk.
struct Run<'a, 'b> {
    chunk: &'a mut Chunk,
    /// The number of the first pack in the chunk.
    first: usize,
    packs: &'a mut [Pack],
    /// Number of their particles.
    left: usize,
    around: Around<'a>,
    /// The numbers of the parts of tools near the chunk.
    near: &'a [usize],
    /// What the next packs have kept when they have scattered.
    waiting: &'a mut &'b [Kept],
}

/// The pass over consecutive packs. Without `TOOLS` none is near a tool: the compiler then makes better code of what is left.
struct Pass<
    'a,
    'b,
    const GATHER: bool,
    const SCATTER: bool,
    const SETTLING: bool,
    const TOOLS: bool,
>(Run<'a, 'b>);

impl<const GATHER: bool, const SCATTER: bool, const SETTLING: bool, const TOOLS: bool> Work
    for Pass<'_, '_, GATHER, SCATTER, SETTLING, TOOLS>
{
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Run { chunk, first, packs, mut left, around, near, waiting } = self.0;
        let Around { field, step, barriers } = around;
        let weights = Weights::new(simd);
        let mut sum = CellSum::zero(simd);
        let mut scratch = Scratch::EMPTY;
        for (number, pack) in packs.iter_mut().enumerate() {
            let number = first + number;
            let lanes = left.min(LANES);
            left -= lanes;
            if GATHER {
                match if TOOLS { Kept::take(waiting, number) } else { None } {
                    Some(kept) => {
                        simd.run(GatherSeen { pack, lanes, kept, field, step, barriers });
                    }
                    None => gather(simd, &weights, pack, field, step, (&mut scratch, None)),
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
                if TOOLS {
                    let (given, loads) = (scratch.vectors, &mut chunk.loads);
                    let (barriers, kept) = (barriers[1], &mut chunk.kept);
                    let hide =
                        Hide { number, pack, lanes, given, barriers, near, step, loads, kept };
                    if let Some(visible) = simd.run(hide) {
                        simd.run(ScatterSeen::<SETTLING> { scratch, lanes, visible, chunk });
                        continue;
                    }
                }
                let of = (&scratch, lanes);
                if SETTLING && scratch.has_solids {
                    scatter::<S, true, true>(simd, &weights, of, None, chunk, &mut sum);
                } else {
                    scatter::<S, SETTLING, false>(simd, &weights, of, None, chunk, &mut sum);
                }
            }
        }
        if SCATTER {
            sum.flush::<SETTLING>(simd, chunk);
        }
    }
}
