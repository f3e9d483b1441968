//! The background grid: converts momentum to velocity and applies gravity and walls.

use super::{
    attractor::Attractor,
    material::DENSITY,
    spline::Stencil,
    step::Step,
    tool::{Barriers, Loads},
};

/// A node of the grid.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Node {
    /// Momentum; after [`Grid::update`] the velocity (domain lengths per s).
    pub(super) motion: [f32; 2],
    /// Mass.
    pub(super) mass: f32,
    /// Mass of the solids, with the law `settling`.
    pub(super) solid: f32,
    /// Mass times J of the liquids, with the law `settling`; after [`Grid::update`] J.
    pub(super) area: f32,
}

/// The share of a node's kernel that lies between the inner surfaces of the walls, from those of its axes; at least a twentieth, as
/// particles reach a little into walls.
#[inline(always)]
pub(super) fn open_share([x, y]: [f32; 2]) -> f32 {
    (x * y).max(LEAST_OPEN)
}

/// The smallest share of [`open_share`]: with a fifth instead, pools were the same.
pub(super) const LEAST_OPEN: f32 = 0.05;

/// The share of the kernel along one axis, at node `index` of `side`; none inside the walls.
pub(super) fn open_along(index: usize, side: usize) -> f32 {
    match index.min(side - 1 - index) + 1 {
        ..WALL_CELLS => 0.0,
        WALL_CELLS => 0.5,
        beside if beside == WALL_CELLS + 1 => 47.0 / 48.0,
        _ => 1.0,
    }
}

/// Thickness of the walls on each side (cells).
pub(super) const WALL_CELLS: usize = 3;

/// Number and width of a grid's cells.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridShape {
    /// Cells along x and y.
    pub cells: [u32; 2],
    /// Cell width (domain lengths).
    pub dx: f32,
}

impl GridShape {
    /// The unit square with this number of cells on a side.
    pub fn unit(cells: u32) -> Self {
        Self { cells: [cells; 2], dx: 1.0 / cells as f32 }
    }

    /// A grid with cells twice as wide and the same inner surfaces of the walls, and the offset that its coordinates add on
    /// both axes (domain lengths). `None` for an odd number of cells.
    ///
    /// Walls have the same number of cells on every grid, so those of the coarser grid are thicker.
    pub fn coarsened(&self) -> Option<(Self, f32)> {
        let walls = 2 * (WALL_CELLS as u32 - 1);
        let half = |cells: u32| {
            let between = cells.checked_sub(walls).filter(|between| between % 2 == 0)?;
            Some(between / 2 + walls)
        };
        let cells = [half(self.cells[0])?, half(self.cells[1])?];
        Some((Self { cells, dx: 2.0 * self.dx }, (WALL_CELLS as u32 - 1) as f32 * self.dx))
    }

    /// A grid with cells a whole number of times narrower and the same inner surfaces of the walls, and the offset that its coordinates
    /// add on both axes (domain lengths).
    pub(super) fn refined(&self, times: u32) -> (Self, f32) {
        let walls = 2 * (WALL_CELLS as u32 - 1);
        let cells = self.cells.map(|cells| cells.saturating_sub(walls) * times + walls);
        let dx = self.dx / times as f32;
        (Self { cells, dx }, (WALL_CELLS - 1) as f32 * (dx - self.dx))
    }

    /// Whether all nine nodes around a position (domain lengths) exist. False for NaN.
    pub(super) fn contains(&self, position: [f32; 2]) -> bool {
        (0..2).all(|axis| {
            let cell = position[axis] * (1.0 / self.dx);
            cell >= 0.5 && cell < self.cells[axis] as f32 - 0.5
        })
    }

    /// Width and height (domain lengths).
    pub fn size(&self) -> [f32; 2] {
        self.cells.map(|cells| cells as f32 * self.dx)
    }
}

/// `(cells + 1)` nodes on each axis; node (i, j) lies at (i, j) dx.
#[derive(Clone, Debug)]
pub(super) struct Grid {
    nodes: Vec<Node>,
    shape: GridShape,
    /// Nodes along x and y.
    sides: [usize; 2],
}

impl Grid {
    /// An empty grid.
    pub(super) fn new(shape: GridShape) -> Self {
        let sides = shape.cells.map(|cells| cells as usize + 1);
        let nodes = vec![Node::default(); sides[0] * sides[1]];
        Self { nodes, shape, sides }
    }

    /// Number and width of its cells.
    pub(super) fn shape(&self) -> GridShape {
        self.shape
    }

    /// Index of the node (i, j) of a stencil, each 0..3.
    pub(super) fn number(&self, stencil: &Stencil, [i, j]: [usize; 2]) -> usize {
        (stencil.base[0] + i) * self.sides[1] + stencil.base[1] + j
    }

    /// A node by its index.
    pub(super) fn node(&self, number: usize) -> &Node {
        &self.nodes[number]
    }

    /// As [`Grid::node`], mutable.
    pub(super) fn node_mut(&mut self, number: usize) -> &mut Node {
        &mut self.nodes[number]
    }

    /// Sets all nodes to zero.
    pub(super) fn clear(&mut self) {
        self.nodes.fill(Node::default());
    }

    /// The nodes, row by row.
    #[cfg(test)]
    pub(super) fn nodes(&self) -> &[Node] {
        &self.nodes
    }

    /// Converts momentum to velocity and advances it by a substep: gravity, the attractor if any, tools, then the walls. Relaxes the area with the law `settling`.
    pub(super) fn update(
        &mut self,
        step: &Step,
        attractor: Option<&Attractor>,
        barriers: &Barriers,
        loads: &mut Loads,
    ) {
        let (sides, dx, dt) = (self.sides, self.shape.dx, step.dt);
        for (i, row) in self.nodes.chunks_exact_mut(sides[1]).enumerate() {
            for (j, node) in row.iter_mut().enumerate().filter(|(_, node)| node.mass > 0.0) {
                // A division instead of a multiplication by the inverse: inside a body all nodes have nearly the same
                // mass, and the same rounding of its inverse everywhere would make momentum drift.
                let mut velocity = node.motion.map(|momentum| momentum / node.mass);
                velocity[1] -= step.fall;
                if let Some(attractor) = attractor {
                    let pull = attractor.acceleration([i as f32 * dx, j as f32 * dx]);
                    velocity = [velocity[0] + dt * pull[0], velocity[1] + dt * pull[1]];
                }
                let particles = node.mass * step.particles_per_cell / (DENSITY * dx * dx);
                velocity =
                    barriers.beside([i, j].map(|k| k as f32 * dx), velocity, particles, loads);
                node.motion = at_walls(velocity, [i, j], sides, step.wall_friction);
                if let Some(settling) = step.settling {
                    let behind = barriers.open([i as f32 * dx, j as f32 * dx]);
                    let along = [open_along(i, sides[0]), open_along(j, sides[1]) * behind];
                    let open = open_share(along);
                    let by_density = DENSITY * dx * dx * open / node.mass;
                    node.area = settling.of_node(node.mass, node.solid, node.area, by_density);
                }
            }
        }
    }
}

/// One velocity component at node `index` of an axis: components into the wall are removed, components away from it or
/// along it are kept (a separating slip wall).
#[inline]
fn walled(velocity: f32, index: usize, side: usize) -> f32 {
    if index < WALL_CELLS {
        velocity.max(0.0)
    } else if index + WALL_CELLS >= side {
        velocity.min(0.0)
    } else {
        velocity
    }
}

/// The velocity at node `index`: beside [`walled`], the wall takes from the motion along it `friction` times what it takes from the
/// motion into it, at most all (Coulomb).
#[inline]
pub(super) fn at_walls(
    velocity: [f32; 2],
    index: [usize; 2],
    sides: [usize; 2],
    friction: f32,
) -> [f32; 2] {
    let kept = [0, 1].map(|axis| walled(velocity[axis], index[axis], sides[axis]));
    if friction == 0.0 {
        return kept;
    }
    [0, 1].map(|axis| {
        let across = 1 - axis;
        let stopped = (velocity[across] - kept[across]).abs();
        (kept[axis].abs() - friction * stopped).max(0.0).copysign(kept[axis])
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn friction_takes_from_the_motion_along_a_wall_what_it_takes_from_that_into_it() {
        let at = |velocity, friction| at_walls(velocity, [30, 2], [65, 65], friction);
        assert_eq!(at([1.0, -2.0], 0.0), [1.0, 0.0]);
        assert_eq!(at([1.0, -2.0], 0.25), [0.5, 0.0]);
        assert_eq!(at([-1.0, -2.0], 0.25), [-0.5, 0.0]);
        assert_eq!(at([1.0, -2.0], 0.75), [0.0, 0.0]);
        assert_eq!(at([1.0, 2.0], 0.75), [1.0, 2.0], "it leaves the wall");
    }

    #[test]
    fn walls_stop_motion_into_them_and_allow_separation() {
        let side = 65;
        assert_eq!(walled(-1.0, 2, side), 0.0);
        assert_eq!(walled(1.0, 2, side), 1.0);
        assert_eq!(walled(-1.0, 3, side), -1.0);
        assert_eq!(walled(1.0, 61, side), 1.0);
        assert_eq!(walled(1.0, 62, side), 0.0);
        assert_eq!(walled(-1.0, 62, side), -1.0);
    }

    #[test]
    fn kernels_at_walls_lie_between_them_in_part() {
        let side = 65;
        // The integral of the spline around each node, from the inner surface of the wall on.
        for (index, expected) in [(2, 0.5), (3, 47.0 / 48.0), (4, 1.0)] {
            let surface = (WALL_CELLS - 1) as f32;
            let places = (0..30_000).map(|k| (k as f32 + 0.5) * 1e-4 - 1.5);
            let inside = places.filter(|x| index as f32 + x > surface);
            let weight = |x: f32| {
                if x.abs() < 0.5 { 0.75 - x * x } else { 0.5 * (1.5 - x.abs()).powi(2) }
            };
            let found = inside.map(|x| 1e-4 * weight(x)).sum::<f32>();
            assert!((found - expected).abs() < 1e-3, "{index}: {found}");
            assert_eq!([index, side - 1 - index].map(|k| open_along(k, side)), [expected; 2]);
        }
    }

    #[test]
    fn a_coarser_grid_has_the_same_inner_walls() {
        let fine = GridShape { cells: [64, 96], dx: 1.0 / 64.0 };
        let (coarse, shift) = fine.coarsened().unwrap();
        assert_eq!((coarse.cells, coarse.dx), ([34, 50], 1.0 / 32.0));
        // The innermost nodes of the walls on either side.
        let places = |grid: GridShape| {
            let inner = (WALL_CELLS - 1) as f32;
            grid.cells.map(|cells| [inner * grid.dx, (cells as f32 - inner) * grid.dx])
        };
        assert_eq!(places(coarse).map(|ends| ends.map(|x| x - shift)), places(fine));
        assert_eq!(GridShape::unit(63).coarsened(), None);
        assert_eq!(coarse.refined(2), (fine, -shift));
        assert_eq!(fine.refined(1), (fine, 0.0));
    }

    #[test]
    fn positions_without_nine_nodes_are_outside() {
        let grid = GridShape::unit(64);
        assert!(grid.contains([0.5, 0.5]));
        assert!(!grid.contains([0.5, 0.4 / 64.0]));
        assert!(!grid.contains([1.0 - 0.4 / 64.0, 0.5]));
        assert!(!grid.contains([f32::NAN, 0.5]));
        let wide = GridShape { cells: [128, 64], dx: 1.0 / 64.0 };
        assert!(wide.contains([1.9, 0.5]) && !wide.contains([0.5, 1.1]));
    }
}
