//! The tables of one window, built through maps with an entry for every cell of its domain.

use pulp::{Arch, Simd, WithSimd};

use super::{Cell, Level, MAX_LEVELS, MISSING, Row, Tables, Window};

/// Maps of one window, row-major.
#[derive(Debug, Default)]
pub(super) struct Maps {
    /// Number of levels.
    levels: usize,
    /// Number of particles of each cell; later the slot of its next particle.
    particles: Vec<u32>,
    /// Rows of each map.
    down: [usize; MAX_LEVELS],
    /// Columns of each map.
    across: [usize; MAX_LEVELS],
    /// Index of each node of each level, or [`MISSING`].
    nodes: [Vec<u32>; MAX_LEVELS],
    /// Each particle's cell (entry of the map).
    cell: Vec<u32>,
    /// Distance of each particle from the lowest node of its stencil (cells), 0.5 to 1.5.
    offset: Vec<[f32; 2]>,
    /// The cells with particles (entries of the map).
    occupied: Vec<u32>,
    /// First of them in each row, and the end of the last row.
    first: Vec<u32>,
}

impl Maps {
    /// Fills the empty `tables`. All indices begin at 0 except the rows of particles.
    pub(super) fn build(
        &mut self,
        position: &[[f32; 2]],
        window: &Window,
        width: f32,
        levels: usize,
        tables: &mut Tables,
    ) {
        self.levels = levels;
        let position = &position[window.particles.clone()];
        let extent = [0, 1].map(|axis| (window.upper[axis] - window.lower[axis]) / width);
        self.clear(extent);
        self.reserve(position.len(), tables);
        self.locate(position, window.lower, extent, width);
        self.list_cells(tables);
        self.sort(window.particles.start, tables);
        self.number(tables);
        for level in 1..levels {
            self.coarsen(level, tables);
        }
        for (level, nodes) in tables.levels[..levels].iter_mut().enumerate() {
            self.connect(level, nodes);
        }
    }

    /// Clears the maps for a domain of this size (cells).
    fn clear(&mut self, extent: [f32; 2]) {
        let [across, down] = map_extent(extent, self.levels);
        for level in 0..self.levels {
            (self.across[level], self.down[level]) = (across >> level, down >> level);
            self.nodes[level].clear();
            self.nodes[level].resize(self.across[level] * self.down[level], MISSING);
        }
        self.particles.clear();
        self.particles.resize(across * down, 0);
    }

    /// Reserves as much as this number of particles can need, wherever they are.
    fn reserve(&mut self, particles: usize, tables: &mut Tables) {
        let area = self.particles.len();
        let levels = self.levels;
        let Self { cell, offset, occupied, first, down, .. } = self;
        cell.clear();
        offset.clear();
        occupied.clear();
        first.clear();
        cell.reserve(particles);
        offset.reserve(particles);
        occupied.reserve(particles.min(area));
        first.reserve(down[0] + 1);
        tables.order.reserve(particles);
        tables.weights.reserve(particles);
        tables.cells.reserve(particles.min(area));
        tables.rows.reserve(down[0]);
        for (number, level) in tables.levels[..levels].iter_mut().enumerate() {
            let nodes = particles.saturating_mul(9).min(area >> (2 * number));
            level.at.reserve(nodes);
            level.neighbours.reserve(nodes);
            level.children.reserve(if number > 0 { nodes } else { 0 });
            level.parent.reserve(if number + 1 < levels { nodes } else { 0 });
        }
    }

    /// Finds each particle's cell and counts the particles of each cell.
    fn locate(&mut self, position: &[[f32; 2]], lower: [f32; 2], extent: [f32; 2], width: f32) {
        self.cell.resize(position.len(), 0);
        self.offset.resize(position.len(), [0.0; 2]);
        let (origin, across) = (origin(self.levels), self.across[0]);
        let (cell, offset) = (&mut self.cell, &mut self.offset);
        let locate = Locate { position, lower, extent, width, origin, across, cell, offset };
        Arch::new().dispatch(locate);
        for &cell in &self.cell {
            self.particles[cell as usize] += 1;
        }
    }

    /// Lists the cells with particles, assigns their slots, and marks the nodes of their stencils.
    fn list_cells(&mut self, tables: &mut Tables) {
        let across = self.across[0];
        let mut slot = 0;
        for (row, cells) in self.particles.chunks_exact_mut(across).enumerate() {
            self.first.push(tables.cells.len() as u32);
            for (column, count) in cells.iter_mut().enumerate() {
                if *count == 0 {
                    continue;
                }
                let (cell, end) = (row * across + column, slot + *count);
                tables.cells.push(Cell { slots: [slot, end], nodes: [0; 3] });
                self.occupied.push(cell as u32);
                for first in [cell, cell + across, cell + 2 * across] {
                    self.nodes[0][first..first + 3].fill(0);
                }
                *count = slot;
                slot = end;
            }
        }
        self.first.push(tables.cells.len() as u32);
    }

    /// Assigns slots to the particles, whose rows begin at `row`.
    fn sort(&mut self, row: usize, tables: &mut Tables) {
        tables.order.resize(self.cell.len(), 0);
        tables.weights.resize(self.cell.len(), [[0.0; 3]; 2]);
        for (particle, (&cell, offset)) in self.cell.iter().zip(&self.offset).enumerate() {
            let next = &mut self.particles[cell as usize];
            let slot = *next as usize;
            *next += 1;
            tables.order[slot] = (row + particle) as u32;
            tables.weights[slot] = offset.map(weights);
        }
    }

    /// Numbers the marked nodes and completes rows and cells.
    fn number(&mut self, tables: &mut Tables) {
        let (origin, across) = (origin(self.levels) as i32, self.across[0]);
        let level = &mut tables.levels[0];
        for (row, nodes) in self.nodes[0].chunks_exact_mut(across).enumerate() {
            let begun = level.at.len() as u32;
            for (column, node) in nodes.iter_mut().enumerate() {
                if *node != MISSING {
                    *node = level.at.len() as u32;
                    level.at.push([column, row].map(|cell| cell as i32 - origin));
                }
            }
            let end = level.at.len() as u32;
            if end > begun {
                // Never negative: the lowest stencils are those of the row before node 0.
                let cells =
                    [row, row - 1, row - 2].map(|row| [self.first[row], self.first[row + 1]]);
                tables.rows.push(Row { nodes: [begun, end], cells });
            }
        }
        for (cell, &entry) in tables.cells.iter_mut().zip(&self.occupied) {
            cell.nodes = [0, 1, 2].map(|row| self.nodes[0][entry as usize + row * across]);
        }
    }

    /// Numbers the nodes of a level from those of the next finer level.
    fn coarsen(&mut self, number: usize, tables: &mut Tables) {
        let [finer, level] = [number - 1, number].map(|number| self.across[number]);
        let origin = (origin(self.levels) >> number) as i32;
        let (below, nodes) = self.nodes.split_at_mut(number);
        let (below, nodes) = (&below[number - 1], &mut nodes[0]);
        let (fine, coarse) = tables.levels.split_at_mut(number);
        let (fine, coarse) = (&mut fine[number - 1], &mut coarse[0]);
        fine.parent.resize(fine.at.len(), MISSING);
        for (row, nodes) in nodes.chunks_exact_mut(level).enumerate() {
            for (column, node) in nodes.iter_mut().enumerate() {
                let first = 2 * row * finer + 2 * column;
                let children =
                    [first, first + 1, first + finer, first + finer + 1].map(|child| below[child]);
                if children == [MISSING; 4] {
                    continue;
                }
                let parent = coarse.at.len();
                *node = parent as u32;
                coarse.at.push([column, row].map(|cell| cell as i32 - origin));
                coarse.children.push(children);
                for (place, child) in children.into_iter().enumerate() {
                    if child != MISSING {
                        fine.parent[child as usize] = (4 * parent + place) as u32;
                    }
                }
            }
        }
    }

    /// Finds the neighbours of each node of a level.
    fn connect(&self, number: usize, level: &mut Level) {
        let (across, nodes) = (self.across[number], &self.nodes[number]);
        let origin = (origin(self.levels) >> number) as i32;
        level.neighbours.extend(level.at.iter().map(|&[a, b]| {
            let [column, row] = [a, b].map(|cell| (cell + origin) as usize);
            let first = (row - 1) * across + column - 1;
            std::array::from_fn(|place| nodes[first + place / 3 * across + place % 3])
        }));
    }
}

/// Index of node 0 in the maps of level 0 of a grid of so many levels. A multiple of the coarsest level's cell, so that a parent's
/// index is half of its child's, and so large that no neighbour's index is negative at any level.
pub fn origin(levels: usize) -> usize {
    1 << levels
}

/// Columns and rows of the map of level 0 of a domain of this size (cells): the last node is one beyond the domain's end and
/// has a neighbour at each of so many levels.
pub fn map_extent(cells: [f32; 2], levels: usize) -> [usize; 2] {
    let coarsest = 1 << (levels - 1);
    cells.map(|cells| ((cells.ceil() as usize + 1 + origin(levels)) / coarsest + 2) * coarsest)
}

/// Weights of three nodes by the quadratic spline, at a distance `x` of 0.5 to 1.5 from the first (cells).
#[inline(always)]
pub fn weights(x: f32) -> [f32; 3] {
    [0.5 * (1.5 - x) * (1.5 - x), 0.75 - (x - 1.0) * (x - 1.0), 0.5 * (x - 0.5) * (x - 0.5)]
}

/// Computes each particle's cell, and its offset in the stencil.
struct Locate<'a> {
    position: &'a [[f32; 2]],
    lower: [f32; 2],
    extent: [f32; 2],
    width: f32,
    origin: usize,
    across: usize,
    cell: &'a mut [u32],
    offset: &'a mut [[f32; 2]],
}

impl WithSimd for Locate<'_> {
    type Output = ();

    // Scalar code, but compiled with instructions that round down.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { position, lower, extent, width, origin, across, cell, offset } = self;
        for ((x, cell), offset) in position.iter().zip(cell).zip(offset) {
            let mut number = [0; 2];
            for axis in 0..2 {
                // `max` also turns NaN into 0.
                let cells = ((x[axis] - lower[axis]) / width).max(0.0).min(extent[axis]);
                let base = (cells - 0.5).floor();
                number[axis] = (base as i32 + origin as i32) as u32;
                offset[axis] = cells - base;
            }
            *cell = number[1] * across as u32 + number[0];
        }
    }
}
