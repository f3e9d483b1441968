//! The background grid: momentum becomes velocity, gravity and walls act.

use super::{attractor::Attractor, spline::Stencil};

/// A node: momentum x, momentum y, mass, unused. After [`Grid::update`] the first two are the
/// velocity. Four numbers, so that one vector instruction moves a node.
pub(super) type Node = [f32; 4];

/// A node from its four numbers.
#[inline(always)]
pub(super) fn lanes(number: impl FnMut(usize) -> f32) -> Node {
    std::array::from_fn(number)
}

/// Thickness of the walls on each side (cells).
pub(super) const WALL_CELLS: usize = 3;

/// `(cells + 1)^2` nodes over the unit square; node (i, j) lies at (i, j) dx.
#[derive(Clone, Debug)]
pub(super) struct Grid {
    nodes: Vec<Node>,
    /// Nodes on a side.
    side: usize,
    /// Cell width (domain lengths).
    dx: f32,
    /// Cells per domain length.
    inverse_dx: f32,
}

impl Grid {
    /// An empty grid with so many cells on a side.
    pub(super) fn new(cells: usize) -> Self {
        let side = cells + 1;
        let inverse_dx = cells as f32;
        Self { nodes: vec![[0.0; 4]; side * side], side, dx: 1.0 / inverse_dx, inverse_dx }
    }

    /// Cell width (domain lengths).
    pub(super) fn dx(&self) -> f32 {
        self.dx
    }

    /// Cells per domain length.
    pub(super) fn inverse_dx(&self) -> f32 {
        self.inverse_dx
    }

    /// Whether all nine nodes around a position exist. False for NaN.
    #[inline]
    pub(super) fn contains(&self, position: [f32; 2]) -> bool {
        let last = self.side as f32 - 1.5;
        position.iter().all(|x| {
            let cell = x * self.inverse_dx;
            cell >= 0.5 && cell < last
        })
    }

    /// The three nodes of a stencil in its row `i` (0..3), with y ascending.
    #[inline]
    pub(super) fn row(&self, stencil: &Stencil, i: usize) -> &[Node] {
        let start = (stencil.base[0] + i) * self.side + stencil.base[1];
        &self.nodes[start..start + 3]
    }

    /// As [`Grid::row`], to write.
    #[inline]
    pub(super) fn row_mut(&mut self, stencil: &Stencil, i: usize) -> &mut [Node] {
        let start = (stencil.base[0] + i) * self.side + stencil.base[1];
        &mut self.nodes[start..start + 3]
    }

    /// Takes all mass and momentum off.
    pub(super) fn clear(&mut self) {
        self.nodes.fill([0.0; 4]);
    }

    /// The nodes, row by row.
    #[cfg(test)]
    pub(super) fn nodes(&self) -> &[Node] {
        &self.nodes
    }

    /// Turns momentum into velocity and moves it `dt` seconds on: gravity in -y (domain lengths per
    /// s^2), the attractor if there is one, then the walls.
    pub(super) fn update(&mut self, dt: f32, gravity: f32, attractor: Option<&Attractor>) {
        let (side, dx) = (self.side, self.dx);
        for (i, row) in self.nodes.chunks_exact_mut(side).enumerate() {
            for (j, node) in row.iter_mut().enumerate().filter(|(_, node)| node[2] > 0.0) {
                // Divided, not multiplied by an inverse: inside a body all nodes have nearly the same
                // mass, and the same rounding of its inverse everywhere would let momentum drift.
                let mut velocity = [node[0] / node[2], node[1] / node[2] - dt * gravity];
                if let Some(attractor) = attractor {
                    let pull = attractor.acceleration([i as f32 * dx, j as f32 * dx]);
                    velocity = [velocity[0] + dt * pull[0], velocity[1] + dt * pull[1]];
                }
                node[0] = walled(velocity[0], i, side);
                node[1] = walled(velocity[1], j, side);
            }
        }
    }
}

/// One component of the velocity at a node that is `index`th on its axis: what points into the wall
/// is lost, what points away or along stays (a separating slip wall).
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn walls_stop_what_comes_and_let_go_what_leaves() {
        let side = 65;
        assert_eq!(walled(-1.0, 2, side), 0.0);
        assert_eq!(walled(1.0, 2, side), 1.0);
        assert_eq!(walled(-1.0, 3, side), -1.0);
        assert_eq!(walled(1.0, 61, side), 1.0);
        assert_eq!(walled(1.0, 62, side), 0.0);
        assert_eq!(walled(-1.0, 62, side), -1.0);
    }

    #[test]
    fn positions_without_nine_nodes_are_outside() {
        let grid = Grid::new(64);
        assert!(grid.contains([0.5, 0.5]));
        assert!(!grid.contains([0.5, 0.4 / 64.0]));
        assert!(!grid.contains([1.0 - 0.4 / 64.0, 0.5]));
        assert!(!grid.contains([f32::NAN, 0.5]));
    }
}
