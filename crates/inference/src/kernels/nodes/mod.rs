//! The sparse grid that particles touch, at three cell widths: which nodes there are, who is next to
//! whom, and which particles are where.
//!
//! Node (a, b) of the finest level, 0, sits at (a w, b w) from the domain's lower corner. Only nodes in
//! the stencil of a particle exist: the 3 x 3 from floor(x / w - 1/2) on, on each axis, as in the
//! material point method's quadratic spline. A node of the next level has a cell twice as wide and exists
//! where one of its four children does.
//!
//! Nodes are numbered window by window, and within a window by b, then a: the order of the particles does
//! not matter. So the three nodes of a stencil that share b follow each other.
//!
//! Particles are listed cell by cell, those of a cell (the ones with the same stencil) in the order of
//! their rows: each has a *slot* in that list, and what is summed in the order of slots has the same bits
//! for any number of threads.
//!
//! 1. `window`: one window's tables, through a map of all its cells.
//! 2. Here: the tables of many windows behind each other.

mod window;

use std::ops::Range;

use rayon::prelude::*;

pub use window::weights;

use window::Maps;

/// Number of levels.
pub const LEVELS: usize = 3;

/// In tables: there is no such node.
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

/// Where a window's parts of the tables are.
#[derive(Clone, Debug, PartialEq)]
pub struct Place {
    /// Rows of its particles, and their slots.
    pub particles: Range<usize>,
    /// Its cells.
    pub cells: Range<usize>,
    /// Its rows of nodes.
    pub rows: Range<usize>,
    /// Its nodes at each level.
    pub nodes: [Range<usize>; LEVELS],
}

/// The particles that have the same stencil.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cell {
    /// Their slots, first and one behind the last.
    pub slots: [u32; 2],
    /// First node of each row of the stencil, the lowest row first; the other two follow.
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
    /// The nodes, first and one behind the last.
    pub nodes: [u32; 2],
    /// Cells that have this row as row 0, 1, 2 of their stencil, first and one behind the last.
    pub cells: [[u32; 2]; 3],
}

/// The two ends as a range.
#[inline(always)]
pub fn range([first, end]: [u32; 2]) -> Range<usize> {
    first as usize..end as usize
}

/// The nodes of a level, and who is next to whom.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Level {
    /// Each node's (a, b).
    pub at: Vec<[i32; 2]>,
    /// Each node's neighbours, number 3 (db + 1) + da + 1 the one at (a + da, b + db), itself as number
    /// 4; [`MISSING`] where there is none.
    pub neighbours: Vec<[u32; 9]>,
    /// Each node's children in the next finer level, number 2 (b' - 2 b) + a' - 2 a the one at (a', b');
    /// [`MISSING`] where there is none. Empty in level 0.
    pub children: Vec<[u32; 4]>,
    /// Each node's place in the flattened `children` of the next coarser level: 4 times its parent and
    /// the child's number. Empty in the coarsest level.
    pub parent: Vec<u32>,
}

impl Level {
    /// How many nodes there are.
    pub fn len(&self) -> usize {
        self.at.len()
    }

    /// For how many nodes there is room: as many as so many particles can ever touch, and no less.
    pub fn capacity(&self) -> usize {
        self.at.capacity()
    }

    /// Whether there is no node.
    pub fn is_empty(&self) -> bool {
        self.at.is_empty()
    }
}

/// What is known of the nodes and of the particles on them.
#[derive(Clone, Debug, Default, PartialEq)]
struct Tables {
    order: Vec<u32>,
    weights: Vec<[[f32; 3]; 2]>,
    cells: Vec<Cell>,
    rows: Vec<Row>,
    levels: [Level; LEVELS],
}

/// The grid of some windows. [`Nodes::rebuild`] needs memory and time in proportion to the particles
/// and to the domains' areas in cells, and asks for no more memory once it was called with as many
/// particles in as large a domain.
#[derive(Debug, Default)]
pub struct Nodes {
    tables: Tables,
    windows: Vec<Place>,
    /// Cell width of level 0 (domain lengths).
    width: f32,
    /// Room to build in, for each window.
    maps: Vec<Maps>,
    parts: Vec<Tables>,
}

impl Nodes {
    /// The grid for the particles at `position` (domain lengths), with cells of the given width (domain
    /// lengths). The windows follow each other from row 0 on.
    ///
    /// A particle outside its domain counts as one at the nearest place inside, and a coordinate that is
    /// not a number as the lowest.
    ///
    /// # Panics
    /// When the windows do not follow each other or hold more rows than there are.
    pub fn rebuild(&mut self, position: &[[f32; 2]], windows: &[Window], width: f32) {
        let follow =
            windows.windows(2).all(|pair| pair[0].particles.end == pair[1].particles.start);
        assert!(follow && windows.first().is_none_or(|first| first.particles.start == 0));
        self.width = width;
        self.windows.clear();
        self.tables.clear();
        if self.maps.len() < windows.len() {
            self.maps.resize_with(windows.len(), Maps::default);
        }
        if let [window] = windows {
            self.maps[0].build(position, window, width, &mut self.tables);
            let place = self.tables.place();
            self.windows.push(place);
            return;
        }
        if self.parts.len() < windows.len() {
            self.parts.resize_with(windows.len(), Tables::default);
        }
        let room = self.maps.par_iter_mut().zip(&mut self.parts);
        room.zip(windows).for_each(|((maps, part), window)| {
            part.clear();
            maps.build(position, window, width, part);
        });
        for part in &self.parts[..windows.len()] {
            let place = self.tables.append(part);
            self.windows.push(place);
        }
    }

    /// Where each window's parts of the tables are.
    pub fn windows(&self) -> &[Place] {
        &self.windows
    }

    /// Cell width of level 0 (domain lengths).
    pub fn width(&self) -> f32 {
        self.width
    }

    /// The particle in each slot: its row.
    pub fn order(&self) -> &[u32] {
        &self.tables.order
    }

    /// For the particle in each slot, its weights on the stencil's three columns and three rows: that of
    /// node (i, j) is the product of `[0][i]` and `[1][j]`.
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

    /// For how many rows there is room: as many as particles in such a domain can ever touch.
    pub fn most_rows(&self) -> usize {
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

    /// The place of the only window.
    fn place(&self) -> Place {
        Place {
            particles: 0..self.order.len(),
            cells: 0..self.cells.len(),
            rows: 0..self.rows.len(),
            nodes: std::array::from_fn(|level| 0..self.levels[level].len()),
        }
    }

    /// Puts a window's tables, which count from 0, behind those that are there.
    fn append(&mut self, part: &Self) -> Place {
        let slot = self.order.len();
        let (cell, row) = (self.cells.len(), self.rows.len());
        let node: [usize; LEVELS] = std::array::from_fn(|level| self.levels[level].len());
        let shift =
            |first: u32, by: usize| if first == MISSING { first } else { first + by as u32 };

        // Rows of particles are those of all windows already.
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
        Place {
            particles: slot..self.order.len(),
            cells: cell..self.cells.len(),
            rows: row..self.rows.len(),
            nodes: std::array::from_fn(|level| node[level]..self.levels[level].len()),
        }
    }
}

#[cfg(test)]
mod tests;
