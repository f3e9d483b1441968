//! A chunk: neighbouring particles, and the patch of the grid that they give their momentum to.
//!
//! Chunks depend on the particles alone, not on the number of threads; each has its own patch, and
//! patches are added up in the order of the chunks. So the bits are the same for any number of
//! threads.

use std::ops::Range;

use super::{
    field::Field,
    simd::{LANES, Simd},
};

/// Cells that particles may drift off before they are sorted anew, and one more for the substep in
/// which that is noticed.
const MARGIN: i32 = 2;
/// Nodes of a stencil on each axis.
const STENCIL: i32 = 3;
/// A row is read and written in vectors of four nodes: so many more than the stencil needs.
const SPARE: usize = 1;

/// A chunk of particles.
#[derive(Clone, Debug, Default)]
#[repr(align(128))] // neighbours are written by different threads
pub(super) struct Chunk {
    /// Its particles, in the order of the cells.
    range: Range<usize>,
    /// Cells per domain length.
    inverse_dx: f32,
    /// First node of the patch on x and y.
    pub(super) origin: [i32; 2],
    /// Nodes of the patch on x and y.
    pub(super) nodes: [usize; 2],
    /// Nodes from one row (x) of the patch to the next.
    pub(super) stride: usize,
    /// Lowest nodes of stencils that lie in the patch: from, and up to but without (cells + 1/2).
    inside: [[f32; 2]; 2],
    /// The same without the outermost cell of the margin.
    near: [[f32; 2]; 2],
    /// Momentum per mass of a particle (domain lengths per s).
    momentum: Vec<[f32; 2]>,
    /// Sum of the weights: mass in masses of a particle.
    mass: Vec<f32>,
    /// A particle has entered the outermost cell of the margin.
    pub(super) drifted: bool,
    /// A particle has left the patch, or is nowhere.
    pub(super) lost: bool,
}

impl Chunk {
    /// Lays the patch around particles whose lowest nodes lie between `least` and `most`.
    pub(super) fn lay(
        &mut self,
        range: Range<usize>,
        least: [i32; 2],
        most: [i32; 2],
        field: &Field,
    ) {
        self.range = range;
        self.inverse_dx = field.inverse_dx;
        self.drifted = false;
        self.lost = false;
        for axis in 0..2 {
            let last = field.sides[axis] as i32 - STENCIL;
            let around =
                |margin: i32| [(least[axis] - margin).max(0), (most[axis] + margin).min(last)];
            let cells = |[from, to]: [i32; 2]| [from as f32 + 0.5, to as f32 + 1.5];
            let [from, to] = around(MARGIN);
            self.inside[axis] = cells([from, to]);
            self.near[axis] = cells(around(MARGIN - 1));
            self.origin[axis] = from;
            self.nodes[axis] = (to + STENCIL - from) as usize;
        }
        self.stride = self.nodes[1] + SPARE;
        let size = self.nodes[0] * self.stride;
        self.momentum.clear();
        self.momentum.resize(size, [0.0; 2]);
        self.mass.clear();
        self.mass.resize(size, 0.0);
    }

    /// The places of its particles.
    pub(super) fn particles(&self) -> Range<usize> {
        self.range.clone()
    }

    /// Its packs: only the last chunk's last one is not full.
    pub(super) fn packs(&self) -> Range<usize> {
        self.range.start / LANES..self.range.end.div_ceil(LANES)
    }

    /// Whether the stencils of sixteen positions (cells) lie in the patch, and whether they do so
    /// without the outermost cell of the margin. False for NaN.
    #[inline(always)]
    pub(super) fn holds<S: Simd>(&self, simd: S, position: [S::Lanes; 2]) -> (bool, bool) {
        let within = |bounds: &[[f32; 2]; 2]| {
            let axis = |axis: usize| {
                let [from, to] = bounds[axis];
                simd.less(position[axis], simd.splat(to))
                    & simd.at_least(position[axis], simd.splat(from))
            };
            simd.count(axis(0) & axis(1)) == LANES
        };
        (within(&self.inside), within(&self.near))
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
            unreachable!("`holds` has seen that the stencil lies in the patch")
        };
        (momentum, mass)
    }

    /// Whether the patch has this row of the grid.
    pub(super) fn covers(&self, row: usize) -> bool {
        let row = row as i32 - self.origin[0];
        row >= 0 && (row as usize) < self.nodes[0]
    }

    /// A row of the patch, which must have it.
    pub(super) fn row(&self, row: usize) -> (&[[f32; 2]], &[f32]) {
        let start = (row - self.origin[0] as usize) * self.stride;
        let end = start + self.nodes[1];
        (&self.momentum[start..end], &self.mass[start..end])
    }

    /// Takes all momentum off.
    pub(super) fn clear(&mut self) {
        self.momentum.fill([0.0; 2]);
        self.mass.fill(0.0);
    }
}
