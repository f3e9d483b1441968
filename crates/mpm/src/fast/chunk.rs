//! A chunk: neighbouring particles and the patch of the grid to which they scatter momentum.
//!
//! Chunks depend on the particles only. Each has its own patch, and patches are summed in the order of the chunks, so the
//! results are bit-identical for any number of threads.

use std::ops::Range;

use super::{
    super::tool::Loads,
    field::Field,
    obstacles::Kept,
    simd::{LANES, Simd},
};

/// Cells that particles may drift before they are sorted again.
const DRIFT: i32 = 1;
/// Nodes of a stencil on each axis.
const STENCIL: i32 = 3;
/// Rows are read and written in vectors of four nodes: this many more than the stencil needs.
const SPARE: usize = 1;

/// A chunk of particles.
#[derive(Clone, Debug, Default)]
#[repr(align(128))] // adjacent chunks are written by different threads
pub(super) struct Chunk {
    /// Range of its particles, sorted by cell.
    range: Range<usize>,
    /// Cells per domain length.
    inverse_dx: f32,
    /// First node of the patch on x and y.
    pub(super) origin: [i32; 2],
    /// Nodes of the patch on x and y.
    pub(super) nodes: [usize; 2],
    /// Row stride of the patch (nodes).
    pub(super) stride: usize,
    /// Range of positions whose stencils lie in the patch: lower bounds and exclusive upper bounds (cells).
    inside: [[f32; 2]; 2],
    /// The same range without the cells of the margin that are for the substeps after a drift is detected.
    near: [[f32; 2]; 2],
    /// Momentum, in units of a particle's mass (domain lengths per s).
    momentum: Vec<[f32; 2]>,
    /// Mass, in units of a particle's mass: the sum of the weights.
    mass: Vec<f32>,
    /// Mass of the solids, with the law `settling`.
    solid: Vec<f32>,
    /// Mass times J of the liquids, with the law `settling`.
    area: Vec<f32>,
    /// What packs keep that have scattered beside a tool, and memory for those of the next substep.
    pub(super) kept: Vec<Kept>,
    pub(super) spare: Vec<Kept>,
    /// What the tools have got from its particles.
    pub(super) loads: Loads,
    /// A particle has drifted into the last cells of the margin.
    pub(super) drifted: bool,
    /// A particle has left the patch or has a NaN position.
    pub(super) lost: bool,
}

impl Chunk {
    /// Lays out the patch around particles whose stencils' lowest nodes lie between `least` and `most`. `late` is the number of substeps
    /// from one in which particles have drifted to the next sort.
    pub(super) fn lay(
        &mut self,
        range: Range<usize>,
        least: [i32; 2],
        most: [i32; 2],
        field: &Field,
        late: i32,
    ) {
        self.range = range;
        self.inverse_dx = field.inverse_dx;
        self.drifted = false;
        self.lost = false;
        self.kept.clear();
        for axis in 0..2 {
            let last = field.sides[axis] as i32 - STENCIL;
            let around =
                |margin: i32| [(least[axis] - margin).max(0), (most[axis] + margin).min(last)];
            let cells = |[from, to]: [i32; 2]| [from as f32 + 0.5, to as f32 + 1.5];
            let [from, to] = around(DRIFT + late);
            self.inside[axis] = cells([from, to]);
            self.near[axis] = cells(around(DRIFT));
            self.origin[axis] = from;
            self.nodes[axis] = (to + STENCIL - from) as usize;
        }
        self.stride = self.nodes[1] + SPARE;
        let size = self.nodes[0] * self.stride;
        self.momentum.clear();
        self.momentum.resize(size, [0.0; 2]);
        self.mass.clear();
        self.mass.resize(size, 0.0);
        for sums in [&mut self.solid, &mut self.area] {
            sums.clear();
            sums.resize(size, 0.0);
        }
    }

    /// Begins to keep what packs have beside tools in this substep, and returns what they have kept in the one before.
    pub(super) fn begin_to_keep(&mut self) -> Vec<Kept> {
        let before = std::mem::replace(&mut self.kept, std::mem::take(&mut self.spare));
        self.kept.clear();
        before
    }

    /// Range of its particles.
    pub(super) fn particles(&self) -> Range<usize> {
        self.range.clone()
    }

    /// Range of its packs. Only the last pack of the last chunk is not full.
    pub(super) fn packs(&self) -> Range<usize> {
        self.range.start / LANES..self.range.end.div_ceil(LANES)
    }

    /// Whether the stencils of sixteen positions (cells) lie in the patch: else a particle is lost. Notes whether they have drifted into the
    /// outermost cell of the margin. False for NaN.
    #[inline(always)]
    pub(super) fn takes<S: Simd>(&mut self, simd: S, position: [S::Lanes; 2]) -> bool {
        let [x, y] = position;
        let inside = simd.within(x, self.inside[0]) & simd.within(y, self.inside[1]);
        let near = simd.within(x, self.near[0]) & simd.within(y, self.near[1]);
        self.drifted |= simd.count(near) < LANES;
        self.lost |= simd.count(inside) < LANES;
        !self.lost
    }

    /// Corners of the box of its particles, lower first (domain lengths).
    pub(super) fn bounds(&self) -> [[f32; 2]; 2] {
        [0, 1].map(|end| [0, 1].map(|axis| self.inside[axis][end] / self.inverse_dx))
    }

    /// Whether the stencil of one position lies in the patch.
    pub(super) fn holds_one(&self, position: [f32; 2]) -> bool {
        (0..2).all(|axis| {
            let cell = position[axis] * self.inverse_dx;
            cell >= self.inside[axis][0] && cell < self.inside[axis][1]
        })
    }

    /// Momentum and mass of four nodes in row `i` of the stencil with the lowest node `at`.
    #[inline(always)]
    pub(super) fn nodes(&mut self, at: usize, i: usize) -> (&mut [[f32; 2]; 4], &mut [f32; 4]) {
        let start = at + i * self.stride;
        let (Some(momentum), Some(mass)) =
            (self.momentum[start..].first_chunk_mut(), self.mass[start..].first_chunk_mut())
        else {
            unreachable!("`takes` checks that the stencil lies in the patch")
        };
        (momentum, mass)
    }

    /// As [`Chunk::nodes`], the mass of solids, and mass times J of liquids.
    #[inline(always)]
    pub(super) fn settling_nodes(&mut self, at: usize, i: usize) -> [&mut [f32; 4]; 2] {
        let start = at + i * self.stride;
        [&mut self.solid, &mut self.area].map(|sums| match sums[start..].first_chunk_mut() {
            Some(nodes) => nodes,
            None => unreachable!("`takes` checks that the stencil lies in the patch"),
        })
    }

    /// Whether the patch contains this row of the grid.
    pub(super) fn covers(&self, row: usize) -> bool {
        let row = row as i32 - self.origin[0];
        row >= 0 && (row as usize) < self.nodes[0]
    }

    /// Momentum and mass of a row that the patch contains.
    pub(super) fn row(&self, row: usize) -> (&[[f32; 2]], &[f32]) {
        let nodes = self.nodes_of(row);
        (&self.momentum[nodes.clone()], &self.mass[nodes])
    }

    /// The mass of solids, and mass times J of liquids, of such a row.
    pub(super) fn settling_row(&self, row: usize) -> (&[f32], &[f32]) {
        let nodes = self.nodes_of(row);
        (&self.solid[nodes.clone()], &self.area[nodes])
    }

    fn nodes_of(&self, row: usize) -> Range<usize> {
        let start = (row - self.origin[0] as usize) * self.stride;
        start..start + self.nodes[1]
    }

    /// Sets the sums to zero.
    pub(super) fn clear<const SETTLING: bool>(&mut self) {
        self.momentum.fill([0.0; 2]);
        self.mass.fill(0.0);
        if SETTLING {
            self.solid.fill(0.0);
            self.area.fill(0.0);
        }
    }
}
