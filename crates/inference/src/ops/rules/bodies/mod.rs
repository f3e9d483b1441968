//! Bodies: groups of particles whose nodes on the grid are connected. They are found before the first rule that needs them;
//! [`rule`] has the steps that such rules share.

pub(super) mod rule;

use super::{Ballistic, Launch, Most};
use crate::kernels::nodes::{Cell, Nodes};

/// The kernels that find the bodies and sum up their particles.
pub(super) const DEVICE: &str = include_str!("device.cu");
/// Numbers of 4 bytes that the kernels keep of a body.
pub const DEVICE_NUMBERS: usize = 76;

/// The launches that find the bodies of a frame.
pub(super) fn launches(most: &Most) -> Vec<Launch> {
    vec![
        Launch::new("bodies_join", most.nodes),
        Launch::new("bodies_number", most.nodes),
        Launch { block: 128, ..Launch::new("bodies_sum", most.cells) },
    ]
}

/// A node without a body yet.
const NONE: u32 = u32::MAX;

/// The bodies of a frame.
#[derive(Debug, Default)]
pub(crate) struct Bodies {
    /// The body of each node of the finest level.
    body: Vec<u32>,
    extents: Vec<Extent>,
    /// Nodes whose neighbours are not visited yet.
    stack: Vec<u32>,
}

/// Bounding box and mean velocity of particles.
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
    fn add_particle(&mut self, position: [f32; 2], velocity: [f32; 2]) {
        for axis in 0..2 {
            self.lower[axis] = self.lower[axis].min(position[axis]);
            self.upper[axis] = self.upper[axis].max(position[axis]);
            self.velocity[axis] += f64::from(velocity[axis]);
        }
        self.count += 1.0;
    }

    fn merge(&mut self, other: &Self) {
        for axis in 0..2 {
            self.lower[axis] = self.lower[axis].min(other.lower[axis]);
            self.upper[axis] = self.upper[axis].max(other.upper[axis]);
            self.velocity[axis] += other.velocity[axis];
        }
        self.count += other.count;
    }

    /// Whether it keeps `distance` from walls (domain lengths), now and after one frame of free fall at its mean velocity.
    fn is_clear_of(&self, walls: &Ballistic, distance: f32) -> bool {
        let velocity = self.velocity.map(|sum| (sum / self.count.max(1.0)) as f32);
        let ([x, y], _) = walls.free([0.0; 2], velocity);
        [0, 1].into_iter().zip([x, y]).all(|(axis, way)| {
            self.lower[axis] + way.min(0.0) >= walls.lower[axis] + distance
                && self.upper[axis] + way.max(0.0) <= walls.upper[axis] - distance
        })
    }
}

impl Bodies {
    /// The largest number of bodies that the grid can hold without allocating.
    pub(super) fn capacity(nodes: &Nodes) -> usize {
        // Each has at least the nodes of one stencil.
        nodes.level(0).capacity().div_ceil(9)
    }

    /// Empties the lists, and reserves as much as the grid can grow without allocating.
    pub(super) fn reserve(&mut self, nodes: &Nodes) {
        let Self { body, extents, stack } = self;
        let most = nodes.level(0).capacity();
        body.clear();
        extents.clear();
        stack.clear();
        body.reserve(most);
        stack.reserve(most);
        extents.reserve(Self::capacity(nodes));
    }

    /// Finds the bodies of particles with these positions and velocities, by rows.
    pub(super) fn find(&mut self, nodes: &Nodes, position: &[[f32; 2]], velocity: &[[f32; 2]]) {
        let Self { body, extents, stack } = self;
        let neighbours = &nodes.level(0).neighbours;
        body.resize(neighbours.len(), NONE);
        for start in 0..neighbours.len() {
            if body[start] != NONE {
                continue;
            }
            let number = extents.len() as u32;
            extents.push(Extent::default());
            body[start] = number;
            stack.push(start as u32);
            while let Some(node) = stack.pop() {
                for &neighbour in &neighbours[node as usize] {
                    // The index of a missing node is larger than all others.
                    if let Some(body) = body.get_mut(neighbour as usize)
                        && *body == NONE
                    {
                        *body = number;
                        stack.push(neighbour);
                    }
                }
            }
        }
        for cell in nodes.cells() {
            let mut extent = Extent::default();
            for &row in &nodes.order()[cell.slots()] {
                extent.add_particle(position[row as usize], velocity[row as usize]);
            }
            extents[body[cell.nodes[0] as usize] as usize].merge(&extent);
        }
    }

    /// The body of a cell.
    #[inline(always)]
    pub(super) fn of(&self, cell: &Cell) -> usize {
        self.body[cell.nodes[0] as usize] as usize
    }

    /// Number of bodies.
    pub(super) fn len(&self) -> usize {
        self.extents.len()
    }

    /// Whether a body keeps `distance` from walls (domain lengths), now and after one frame of free fall at its mean velocity.
    pub(super) fn is_clear_of(&self, body: usize, walls: &Ballistic, distance: f32) -> bool {
        self.extents[body].is_clear_of(walls, distance)
    }
}
