//! A body in free flight keeps its momentum and its spin: whatever the network says, its particles' mean
//! position and velocity are those of free fall, as a whole they turn no further than in free fall, and they
//! have its angular momentum.
//!
//! Bodies are what hangs together on the grid: nodes that are next to each other. One is in free flight
//! when it is away from walls, now and where its mean velocity takes it.
//!
//! A body that touches something and hardly moves comes to rest, as in engines for rigid bodies that let islands of them
//! sleep: the network's errors of a frame would make it creep. Its motion is scaled down, to nothing below [`ASLEEP`].

use super::{Ballistic, particle_features::State};
use crate::kernels::nodes::{Cell, Nodes};

/// Nearness of a wall that ends free flight (cells of level 0).
const REACH: f32 = 1.5;

/// Speed of a body's fastest cell, as a part of what gravity gives in a frame, below which the body rests.
const ASLEEP: f32 = 0.25;
/// Speed, as such a part, from which on it moves as the network has it.
const AWAKE: f32 = 1.0;

/// No body.
const NONE: u32 = u32::MAX;

/// Mean squared distance from the centre below which nothing can turn (squared domain lengths).
const POINT: f64 = 1e-10;

/// The bodies of a frame.
#[derive(Debug, Default)]
pub(super) struct Bodies {
    /// The body of each node of level 0.
    body: Vec<u32>,
    bodies: Vec<Body>,
    /// Nodes whose neighbours are still to be looked at.
    open: Vec<u32>,
}

/// A body.
#[derive(Clone, Copy, Debug, Default)]
struct Body {
    /// Of its particles.
    extent: Extent,
    flies: bool,
    /// The part of its predicted motion that it makes.
    awake: f32,
    /// The largest mean squared speed of a cell, as observed or as predicted.
    fastest: f64,
    sums: Sums,
    motion: Motion,
}

/// Where particles are, and their velocity.
#[derive(Clone, Copy, Debug)]
struct Extent {
    lower: [f32; 2],
    upper: [f32; 2],
    /// Sum over the particles.
    velocity: [f64; 2],
    count: f64,
}

/// Sums over particles: x and v are where free fall takes them, X and V what is predicted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Sums {
    count: f64,
    /// x, v, X, V.
    first: [[f64; 2]; 4],
    /// x . x and X . X.
    squares: [f64; 2],
    /// x cross v, x cross X, X cross V.
    turns: [f64; 3],
    /// x . V.
    stretch: f64,
    /// Squared speeds, as observed and as predicted.
    speeds: [f64; 2],
}

/// What is wrong with the prediction for a body.
#[derive(Clone, Copy, Debug, Default)]
struct Motion {
    /// Of x and of X.
    centres: [[f64; 2]; 2],
    /// How much faster it is than in free fall.
    faster: [f64; 2],
    /// How far it turned (radians).
    angle: f64,
    /// How much faster it turns (radians per second).
    spin: f64,
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

    /// Whether it keeps `reach` from walls for a frame (domain lengths).
    fn flies(&self, walls: &Ballistic, reach: f32) -> bool {
        let velocity = self.velocity.map(|sum| (sum / self.count.max(1.0)) as f32);
        let ([x, y], _) = walls.free([0.0; 2], velocity);
        [0, 1].into_iter().zip([x, y]).all(|(axis, way)| {
            self.lower[axis] + way.min(0.0) >= walls.lower[axis] + reach
                && self.upper[axis] + way.max(0.0) <= walls.upper[axis] - reach
        })
    }
}

impl Bodies {
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

    /// Finds the bodies, and which are in free flight. `position` and `velocity` are those of each row.
    pub(super) fn find(
        &mut self,
        nodes: &Nodes,
        position: &[[f32; 2]],
        velocity: &[[f32; 2]],
        walls: &Ballistic,
    ) {
        let Self { body, bodies, open } = self;
        let neighbours = &nodes.level(0).neighbours;
        body.resize(neighbours.len(), NONE);
        for start in 0..neighbours.len() {
            if body[start] != NONE {
                continue;
            }
            let number = bodies.len() as u32;
            bodies.push(Body::default());
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
            bodies[body[cell.nodes[0] as usize] as usize].extent.join(&extent);
        }
        for body in bodies {
            body.flies = body.extent.flies(walls, REACH * nodes.width());
        }
    }

    /// Whether the particles of a cell are in free flight.
    pub(super) fn flies(&self, cell: &Cell) -> bool {
        self.body(cell).flies
    }

    /// The part of their predicted motion that the particles of a cell make.
    pub(super) fn awake(&self, cell: &Cell) -> f32 {
        self.body(cell).awake
    }

    fn body(&self, cell: &Cell) -> &Body {
        &self.bodies[self.body[cell.nodes[0] as usize] as usize]
    }

    /// Finds what is wrong with each body's prediction from its cells' sums, and whether it rests.
    pub(super) fn join(&mut self, nodes: &Nodes, sums: &[Sums], walls: &Ballistic) {
        for (cell, sums) in nodes.cells().iter().zip(sums) {
            let body = &mut self.bodies[self.body[cell.nodes[0] as usize] as usize];
            body.sums.add(sums);
            body.fastest = body.fastest.max(sums.fastest());
        }
        for body in &mut self.bodies {
            body.motion = body.sums.motion();
            // One particle without a number must not take all others with it.
            body.awake = if body.flies { 1.0 } else { awake(body.fastest, walls) };
            body.flies &= body.motion.is_finite();
        }
    }

    /// What the particle of a cell has as its next state instead of `next`, where free fall takes it to
    /// `free`.
    #[inline(always)]
    pub(super) fn correct(
        &self,
        cell: &Cell,
        free: &State,
        next: State,
        walls: &Ballistic,
    ) -> State {
        let Motion { centres: [centre, predicted], faster, angle, spin } = &self.body(cell).motion;
        let (mut position, mut velocity) = next;
        let from = |x: [f32; 2], centre: &[f64; 2]| {
            [f64::from(x[0]) - centre[0], f64::from(x[1]) - centre[1]]
        };
        let (r, place) = (from(free.0, centre), from(next.0, predicted));
        let arm = [place[0] + angle * r[1], place[1] - angle * r[0]];
        let turned = [-arm[1], arm[0]];
        for axis in 0..2 {
            position[axis] = walls.hold(axis, (centre[axis] + arm[axis]) as f32);
            let v = f64::from(velocity[axis]) - faster[axis] - spin * turned[axis];
            velocity[axis] = v as f32;
        }
        (position, velocity)
    }
}

#[inline(always)]
fn dot(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

#[inline(always)]
fn cross(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[1] - a[1] * b[0]
}

/// The part of its predicted motion that a body makes whose fastest cell has this mean squared speed: all
/// where it moves, or nothing pulls it down.
fn awake(fastest: f64, walls: &Ballistic) -> f32 {
    let pull = walls.gravity[0].hypot(walls.gravity[1]) * walls.dt;
    let awake = (fastest.sqrt() as f32 / pull - ASLEEP) / (AWAKE - ASLEEP);
    if awake.is_finite() { awake.clamp(0.0, 1.0) } else { 1.0 }
}

impl Motion {
    fn is_finite(&self) -> bool {
        let Self { centres, faster, angle, spin } = self;
        let numbers = centres.as_flattened().iter().chain(faster).chain([angle, spin]);
        numbers.into_iter().all(|number| number.is_finite())
    }
}

impl Sums {
    /// Takes a particle in.
    #[inline(always)]
    pub(super) fn take(&mut self, free: &State, next: &State) {
        let double = |x: [f32; 2]| [f64::from(x[0]), f64::from(x[1])];
        let (x, v) = (double(free.0), double(free.1));
        let (place, speed) = (double(next.0), double(next.1));
        self.count += 1.0;
        for (sum, value) in self.first.iter_mut().zip([x, v, place, speed]) {
            sum[0] += value[0];
            sum[1] += value[1];
        }
        self.squares[0] += dot(x, x);
        self.squares[1] += dot(place, place);
        self.turns[0] += cross(x, v);
        self.turns[1] += cross(x, place);
        self.turns[2] += cross(place, speed);
        self.stretch += dot(x, speed);
    }

    /// Takes a particle in of which only the speed counts, as observed and as predicted.
    #[inline(always)]
    pub(super) fn weigh(&mut self, observed: [f32; 2], next: [f32; 2]) {
        self.count += 1.0;
        for (sum, [x, y]) in self.speeds.iter_mut().zip([observed, next]) {
            *sum += f64::from(x * x + y * y);
        }
    }

    fn add(&mut self, other: &Self) {
        let Self { count, first, squares, turns, stretch, speeds } = self;
        *count += other.count;
        *stretch += other.stretch;
        let all = first.as_flattened_mut().iter_mut().chain(squares).chain(turns).chain(speeds);
        let others = other.first.as_flattened().iter().chain(&other.squares).chain(&other.turns);
        all.zip(others.chain(&other.speeds)).for_each(|(sum, other)| *sum += other);
    }

    /// The mean squared speed, as observed or as predicted, whichever is larger.
    fn fastest(&self) -> f64 {
        self.speeds[0].max(self.speeds[1]) / self.count.max(1.0)
    }

    /// With r, w, p, q for x, v, X, V about their means, and J turning by a right angle: the positions p - angle J r do not
    /// turn as a whole against r, and with them the velocities q - spin J (p - angle J r) have the angular momentum
    /// of r and w.
    fn motion(&self) -> Motion {
        let count = self.count.max(1.0);
        let [x, v, place, speed] = self.first.map(|sum| sum.map(|sum| sum / count));
        let rr = self.squares[0] - count * dot(x, x);
        let pp = self.squares[1] - count * dot(place, place);
        let rw = self.turns[0] - count * cross(x, v);
        let rp = self.turns[1] - count * cross(x, place);
        let pq = self.turns[2] - count * cross(place, speed);
        let rq = self.stretch - count * dot(x, speed);
        let angle = if rr > POINT * count { rp / rr } else { 0.0 };
        let inertia = pp - angle * angle * rr;
        let spin = if inertia > POINT * count { (pq + angle * rq - rw) / inertia } else { 0.0 };
        let faster = [speed[0] - v[0], speed[1] - v[1]];
        Motion { centres: [x, place], faster, angle, spin }
    }
}
