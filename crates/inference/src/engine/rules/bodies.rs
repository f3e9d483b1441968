//! Bodies are what hangs together on the grid: nodes that are next to each other.

use super::super::Ballistic;
use crate::kernels::nodes::{Cell, Nodes};

/// No body.
const NONE: u32 = u32::MAX;

/// The bodies of a frame.
#[derive(Debug, Default)]
pub(super) struct Bodies {
    /// The body of each node of level 0.
    body: Vec<u32>,
    extents: Vec<Extent>,
    /// Nodes whose neighbours are still to be looked at.
    open: Vec<u32>,
}

/// Where particles are, and their velocity.
#[derive(Clone, Copy, Debug)]
struct Extent {
    lower: [f32; 2],
    upper: [f32; 2],
    /// Sum of the particles' velocities (domain lengths per second).
    velocity: [f64; 2],
    count: f64,
}

impl Default for Extent {
    fn default() -> Self {
        let (lower, upper) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
        Self { lower, upper, velocity: [0.0; 2], count: 0.0 }
    }
}

impl Extent {
    #[inline(always)]
    fn take(&mut self, position: [f32; 2], velocity: [f32; 2]) {
        for axis in 0..2 {
            self.lower[axis] = self.lower[axis].min(position[axis]);
            self.upper[axis] = self.upper[axis].max(position[axis]);
            self.velocity[axis] += f64::from(velocity[axis]);
        }
        self.count += 1.0;
    }

    fn join(&mut self, other: &Self) {
        for axis in 0..2 {
            self.lower[axis] = self.lower[axis].min(other.lower[axis]);
            self.upper[axis] = self.upper[axis].max(other.upper[axis]);
            self.velocity[axis] += other.velocity[axis];
        }
        self.count += other.count;
    }

    /// Whether all of it stays `distance` away from walls (domain lengths), now and where free fall takes it at its
    /// mean velocity.
    fn clears(&self, walls: &Ballistic, distance: f32) -> bool {
        let velocity = self.velocity.map(|sum| (sum / self.count.max(1.0)) as f32);
        let ([x, y], _) = walls.free([0.0; 2], velocity);
        [0, 1].into_iter().zip([x, y]).all(|(axis, way)| {
            self.lower[axis] + way.min(0.0) >= walls.lower[axis] + distance
                && self.upper[axis] + way.max(0.0) <= walls.upper[axis] - distance
        })
    }
}

/// The most bodies that there can be on as many nodes as there is room for.
pub(super) fn capacity(nodes: &Nodes) -> usize {
    // Each has the nodes of a stencil at least.
    nodes.level(0).capacity().div_ceil(9)
}

impl Bodies {
    /// Makes room for as many nodes as the grid has room for.
    pub(super) fn make_room(&mut self, nodes: &Nodes) {
        let Self { body, extents, open } = self;
        let most = nodes.level(0).capacity();
        body.clear();
        extents.clear();
        open.clear();
        body.reserve(most);
        open.reserve(most);
        extents.reserve(capacity(nodes));
    }

    /// Finds the bodies. `position` and `velocity` are those of each row.
    pub(super) fn find(&mut self, nodes: &Nodes, position: &[[f32; 2]], velocity: &[[f32; 2]]) {
        let Self { body, extents, open } = self;
        let neighbours = &nodes.level(0).neighbours;
        body.resize(neighbours.len(), NONE);
        for start in 0..neighbours.len() {
            if body[start] != NONE {
                continue;
            }
            let number = extents.len() as u32;
            extents.push(Extent::default());
            body[start] = number;
            open.push(start as u32);
            while let Some(node) = open.pop() {
                for &neighbour in &neighbours[node as usize] {
                    // What is missing has a number beyond all.
                    if let Some(body) = body.get_mut(neighbour as usize)
                        && *body == NONE
                    {
                        *body = number;
                        open.push(neighbour);
                    }
                }
            }
        }
        for cell in nodes.cells() {
            let mut extent = Extent::default();
            for &row in &nodes.order()[cell.slots()] {
                extent.take(position[row as usize], velocity[row as usize]);
            }
            extents[body[cell.nodes[0] as usize] as usize].join(&extent);
        }
    }

    /// The number of a cell's body.
    #[inline(always)]
    pub(super) fn of(&self, cell: &Cell) -> usize {
        self.body[cell.nodes[0] as usize] as usize
    }

    /// Whether each body stays `distance` away from walls (domain lengths), now and where free fall takes it at its
    /// mean velocity.
    pub(super) fn clear_of(&self, walls: &Ballistic, distance: f32) -> impl Iterator<Item = bool> {
        self.extents.iter().map(move |extent| extent.clears(walls, distance))
    }
}
