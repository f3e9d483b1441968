//! A body in free flight keeps its momentum and its spin: whatever the network says, the mean and the
//! rigid rotation of its particles' residuals are taken away.
//!
//! Bodies are what hangs together on the grid: nodes that are next to each other. One is in free flight
//! when none of its particles is near a wall, now or after the ballistic step.

use crate::{
    kernels::nodes::{Cell, Nodes},
    model::Ballistic,
};

use super::particle_features::State;

/// Nearness of a wall that ends free flight (cells of level 0).
pub(super) const REACH: f32 = 1.5;

/// No body.
const NONE: u32 = u32::MAX;

/// Mean squared distance from the centre below which nothing can turn (squared domain lengths).
const POINT: f64 = 1e-10;

/// The bodies of a frame.
#[derive(Debug, Default)]
pub(super) struct Flights {
    /// The body of each node of level 0.
    body: Vec<u32>,
    bodies: Vec<Body>,
    /// Nodes whose neighbours are still to be looked at.
    open: Vec<u32>,
}

/// A body.
#[derive(Clone, Copy, Debug)]
struct Body {
    flies: bool,
    sums: Sums,
    motion: Motion,
}

/// Sums over particles, x being where the ballistic step takes them, and d a residual.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Sums {
    count: f64,
    x: [f64; 2],
    /// x . x.
    square: f64,
    /// d of position and velocity.
    d: [[f64; 2]; 2],
    /// x cross d.
    turn: [f64; 2],
}

/// The rigid part of the residuals of a body.
#[derive(Clone, Copy, Debug, Default)]
struct Motion {
    centre: [f64; 2],
    /// Means, of position and velocity.
    mean: [[f64; 2]; 2],
    /// Angles, likewise.
    angle: [f64; 2],
}

impl Flights {
    /// Makes room for as many nodes as the grid has room for.
    pub(super) fn make_room(&mut self, nodes: &Nodes) {
        let Self { body, bodies, open } = self;
        let most = nodes.level(0).capacity();
        body.clear();
        bodies.clear();
        open.clear();
        body.reserve(most);
        open.reserve(most);
        // Each has the nodes of a stencil at least.
        bodies.reserve(most.div_ceil(9));
    }

    /// Finds the bodies, and which are in free flight: `near` says of each slot whether it is near a wall.
    pub(super) fn find(&mut self, nodes: &Nodes, near: &[bool]) {
        let Self { body, bodies, open } = self;
        let neighbours = &nodes.level(0).neighbours;
        body.resize(neighbours.len(), NONE);
        for start in 0..neighbours.len() {
            if body[start] != NONE {
                continue;
            }
            let number = bodies.len() as u32;
            bodies.push(Body { flies: true, sums: Sums::default(), motion: Motion::default() });
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
            if near[cell.slots()].contains(&true) {
                bodies[body[cell.nodes[0] as usize] as usize].flies = false;
            }
        }
    }

    /// Whether the particles of a cell are in free flight.
    pub(super) fn flies(&self, cell: &Cell) -> bool {
        self.body(cell).flies
    }

    fn body(&self, cell: &Cell) -> &Body {
        &self.bodies[self.body[cell.nodes[0] as usize] as usize]
    }

    /// Finds the rigid part of each body's residuals from its cells' sums.
    pub(super) fn join(&mut self, nodes: &Nodes, sums: &[Sums]) {
        for (cell, sums) in nodes.cells().iter().zip(sums) {
            self.bodies[self.body[cell.nodes[0] as usize] as usize].sums.add(sums);
        }
        for body in &mut self.bodies {
            body.motion = body.sums.motion();
        }
    }

    /// What the particle of a cell has as its next state instead of `next`.
    #[inline(always)]
    pub(super) fn correct(
        &self,
        cell: &Cell,
        fallen: &State,
        next: State,
        walls: &Ballistic,
    ) -> State {
        let Motion { centre, mean, angle } = &self.body(cell).motion;
        let (mut position, mut velocity) = next;
        let r = [0, 1].map(|axis| f64::from(fallen.0[axis]) - centre[axis]);
        let turned = [-r[1], r[0]];
        for axis in 0..2 {
            let rigid = |which: usize| mean[which][axis] + angle[which] * turned[axis];
            let free = (f64::from(position[axis]) - rigid(0)) as f32;
            let (lower, upper) = (walls.lower[axis], walls.upper[axis]);
            position[axis] = if free < lower {
                lower
            } else if free > upper {
                upper
            } else {
                free
            };
            velocity[axis] = (f64::from(velocity[axis]) - rigid(1)) as f32;
        }
        (position, velocity)
    }
}

impl Sums {
    /// Takes a particle in.
    #[inline(always)]
    pub(super) fn take(&mut self, fallen: &State, next: &State) {
        let x = fallen.0.map(f64::from);
        self.count += 1.0;
        self.square += x[0] * x[0] + x[1] * x[1];
        self.x[0] += x[0];
        self.x[1] += x[1];
        let pairs = [(next.0, fallen.0), (next.1, fallen.1)];
        for (which, (next, fallen)) in pairs.into_iter().enumerate() {
            let d = [0, 1].map(|axis| f64::from(next[axis]) - f64::from(fallen[axis]));
            self.d[which][0] += d[0];
            self.d[which][1] += d[1];
            self.turn[which] += x[0] * d[1] - x[1] * d[0];
        }
    }

    fn add(&mut self, other: &Self) {
        self.count += other.count;
        self.square += other.square;
        for axis in 0..2 {
            self.x[axis] += other.x[axis];
            self.turn[axis] += other.turn[axis];
            for which in 0..2 {
                self.d[which][axis] += other.d[which][axis];
            }
        }
    }

    fn motion(&self) -> Motion {
        let count = self.count.max(1.0);
        let centre = self.x.map(|x| x / count);
        let mean = self.d.map(|d| d.map(|d| d / count));
        // About the centre: what is left of x . x and x cross d.
        let square = self.square - count * (centre[0] * centre[0] + centre[1] * centre[1]);
        let angle = [0, 1].map(|which| {
            let d = self.d[which];
            let turn = self.turn[which] - (centre[0] * d[1] - centre[1] * d[0]);
            if square > POINT * count { turn / square } else { 0.0 }
        });
        Motion { centre, mean, angle }
    }
}
