//! The sparse grid of the nodes that particles touch, at two to four cell widths: the nodes, their neighbours, and the particles
//! in each cell.
//!
//! Node (a, b) of the finest level, 0, is at (a w, b w) from the domain's lower corner. Only nodes in the stencil of a
//! particle exist: the 3 x 3 from floor(x / w - 1/2) on, on each axis, as for the quadratic spline of the material point
//! method. A node of the next level has a cell twice as wide and exists if one of its four children does.
//!
//! Nodes are numbered window by window, and within a window by b, then a, whatever the order of the particles. The three
//! nodes of a stencil that share b are therefore consecutive.
//!
//! Particles are listed cell by cell, those of a cell (with the same stencil) in the order of their rows. The position of a
//! particle in that list is its *slot*; sums in the order of slots have the same bits for any number of threads.
//!
//! 1. `window`: the tables of one window, through a map of all its cells.
//! 2. Here: the concatenated tables of several windows.

mod window;

use std::ops::Range;

use rayon::prelude::*;

pub use window::{map_extent, origin, weights};

use window::Maps;

/// The fewest levels of a grid.
pub const MIN_LEVELS: usize = 2;
/// The most levels of a grid.
pub const MAX_LEVELS: usize = 4;

/// Marks a node that does not exist.
pub const MISSING: u32 = u32::MAX;

/// Particles that share a grid: those of one frame of one scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Window {
    /// Their rows.
    pub particles: Range<usize>,
    /// Lower corner of the domain (domain lengths).
    pub lower: [f32; 2],
    /// Upper corner of the domain (domain lengths).
    pub upper: [f32; 2],
}

/// The parts of the tables that belong to a window.
#[derive(Clone, Debug, PartialEq)]
pub struct WindowRanges {
    /// Rows of its particles, and also their slots.
    pub particles: Range<usize>,
    /// Its cells.
    pub cells: Range<usize>,
    /// Its rows of nodes.
    pub rows: Range<usize>,
    /// Its nodes at each level; none at levels that the grid does not have.
    pub nodes: [Range<usize>; MAX_LEVELS],
}

/// The particles with the same stencil.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cell {
    /// Their slots, first and end.
    pub slots: [u32; 2],
    /// First of the three consecutive nodes of each row of the stencil, lowest row first.
    pub nodes: [u32; 3],
}

impl Cell {
    /// The slots of its particles.
    #[inline(always)]
    pub fn slots(&self) -> Range<usize> {
        range(self.slots)
    }
}

/// Nodes of level 0 with the same b, and the cells whose stencils they are in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// The nodes, first and end.
    pub nodes: [u32; 2],
    /// Cells that have this row as row 0, 1, 2 of their stencil, first and end.
    pub cells: [[u32; 2]; 3],
}

/// A range from first and end.
#[inline(always)]
pub fn range([first, end]: [u32; 2]) -> Range<usize> {
    first as usize..end as usize
}

/// The nodes of a level and their neighbours.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Level {
    /// Each node's (a, b).
    pub at: Vec<[i32; 2]>,
    /// Each node's neighbours: number 3 (db + 1) + da + 1 is at (a + da, b + db), so that number 4 is the node itself;
    /// [`MISSING`] if there is none.
    pub neighbours: Vec<[u32; 9]>,
    /// Each node's children in the next finer level: number 2 (b' - 2 b) + a' - 2 a is at (a', b'); [`MISSING`] if there is
    /// none. Empty in level 0.
    pub children: Vec<[u32; 4]>,
    /// Each node's index in the flattened `children` of the next coarser level: 4 times its parent plus the number of the
    /// child. Empty in the coarsest level.
    pub parent: Vec<u32>,
}

impl Level {
    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.at.len()
    }

    /// Number of nodes that can exist without allocating: at least as many as these particles can touch.
    pub fn capacity(&self) -> usize {
        self.at.capacity()
    }

    /// Whether there is no node.
    pub fn is_empty(&self) -> bool {
        self.at.is_empty()
    }
}

/// The nodes and the particles on them.
#[derive(Clone, Debug, Default, PartialEq)]
struct Tables {
    order: Vec<u32>,
    weights: Vec<[[f32; 3]; 2]>,
    cells: Vec<Cell>,
    rows: Vec<Row>,
    levels: [Level; MAX_LEVELS],
}

/// The grid of one or more windows. [`Nodes::rebuild`] takes memory and time proportional to the number of particles and to
/// the domains' areas in cells, and allocates nothing once it was called with as many particles in as large a domain.
#[derive(Debug, Default)]
pub struct Nodes {
    tables: Tables,
    windows: Vec<WindowRanges>,
    /// Cell width of level 0 (domain lengths).
    width: f32,
    /// Scratch buffers for each window.
    maps: Vec<Maps>,
    parts: Vec<Tables>,
}

impl Nodes {
    /// Builds the grid for the particles at `position` (domain lengths), with cells of the given width (domain lengths) at the
    /// finest of so many levels. The windows cover consecutive rows from 0 on.
    ///
    /// A particle outside its domain is clamped to it, and NaN to its lower corner.
    ///
    /// # Panics
    /// If the windows are not consecutive or contain more rows than there are, or with fewer than [`MIN_LEVELS`] or more than
    /// [`MAX_LEVELS`] levels.
    pub fn rebuild(
        &mut self,
        position: &[[f32; 2]],
        windows: &[Window],
        width: f32,
        levels: usize,
    ) {
        let consecutive =
            windows.windows(2).all(|pair| pair[0].particles.end == pair[1].particles.start);
        assert!((MIN_LEVELS..=MAX_LEVELS).contains(&levels), "{levels} levels");
        assert!(consecutive && windows.first().is_none_or(|first| first.particles.start == 0));
        self.width = width;
        self.windows.clear();
        self.tables.clear();
        if self.maps.len() < windows.len() {
            self.maps.resize_with(windows.len(), Maps::default);
        }
        if let [window] = windows {
            self.maps[0].build(position, window, width, levels, &mut self.tables);
            let place = self.tables.ranges();
            self.windows.push(place);
            return;
        }
        if self.parts.len() < windows.len() {
            self.parts.resize_with(windows.len(), Tables::default);
        }
        let scratch = self.maps.par_iter_mut().zip(&mut self.parts);
        scratch.zip(windows).for_each(|((maps, part), window)| {
            part.clear();
            maps.build(position, window, width, levels, part);
        });
        for part in &self.parts[..windows.len()] {
            let place = self.tables.append(part);
            self.windows.push(place);
        }
    }

    /// The parts of the tables that belong to each window.
    pub fn windows(&self) -> &[WindowRanges] {
        &self.windows
    }

    /// Cell width of level 0 (domain lengths).
    pub fn width(&self) -> f32 {
        self.width
    }

    /// The row of the particle in each slot.
    pub fn order(&self) -> &[u32] {
        &self.tables.order
    }

    /// The weights of the particle in each slot on the stencil's three columns and three rows: the weight of node (i, j) is
    /// `[0][i]` times `[1][j]`.
    pub fn weights(&self) -> &[[[f32; 3]; 2]] {
        &self.tables.weights
    }

    /// Cells with particles, by b, then a.
    pub fn cells(&self) -> &[Cell] {
        &self.tables.cells
    }

    /// Rows of nodes of level 0.
    pub fn rows(&self) -> &[Row] {
        &self.tables.rows
    }

    /// Number of rows that can exist without allocating: as many as particles in this domain can touch.
    pub fn max_rows(&self) -> usize {
        self.tables.rows.capacity()
    }

    /// A level; 0 is the finest.
    pub fn level(&self, level: usize) -> &Level {
        &self.tables.levels[level]
    }
}

impl Tables {
    fn clear(&mut self) {
        let Self { order, weights, cells, rows, levels } = self;
        order.clear();
        weights.clear();
        cells.clear();
        rows.clear();
        for Level { at, neighbours, children, parent } in levels {
            at.clear();
            neighbours.clear();
            children.clear();
            parent.clear();
        }
    }

    /// The ranges of the only window.
    fn ranges(&self) -> WindowRanges {
        WindowRanges {
            particles: 0..self.order.len(),
            cells: 0..self.cells.len(),
            rows: 0..self.rows.len(),
            nodes: std::array::from_fn(|level| 0..self.levels[level].len()),
        }
    }

    /// Appends a window's tables, whose indices begin at 0.
    fn append(&mut self, part: &Self) -> WindowRanges {
        let slot = self.order.len();
        let (cell, row) = (self.cells.len(), self.rows.len());
        let node: [usize; MAX_LEVELS] = std::array::from_fn(|level| self.levels[level].len());
        let shift =
            |first: u32, by: usize| if first == MISSING { first } else { first + by as u32 };

        // Rows of particles already refer to all windows.
        self.order.extend_from_slice(&part.order);
        self.weights.extend_from_slice(&part.weights);
        self.cells.extend(part.cells.iter().map(|from| Cell {
            slots: from.slots.map(|first| shift(first, slot)),
            nodes: from.nodes.map(|first| shift(first, node[0])),
        }));
        self.rows.extend(part.rows.iter().map(|from| Row {
            nodes: from.nodes.map(|first| shift(first, node[0])),
            cells: from.cells.map(|cells| cells.map(|first| shift(first, cell))),
        }));
        for (number, (level, from)) in self.levels.iter_mut().zip(&part.levels).enumerate() {
            level.at.extend_from_slice(&from.at);
            let here = |table: &[u32; 9]| table.map(|first| shift(first, node[number]));
            level.neighbours.extend(from.neighbours.iter().map(here));
            let finer = node[number.saturating_sub(1)];
            let below = |table: &[u32; 4]| table.map(|first| shift(first, finer));
            level.children.extend(from.children.iter().map(below));
            let coarser = node.get(number + 1).copied().unwrap_or(0);
            level.parent.extend(from.parent.iter().map(|&place| shift(place, 4 * coarser)));
        }
        WindowRanges {
            particles: slot..self.order.len(),
            cells: cell..self.cells.len(),
            rows: row..self.rows.len(),
            nodes: std::array::from_fn(|level| node[level]..self.levels[level].len()),
        }
    }
}

#[cfg(test)]
mod tests;
