//! A body in free flight keeps its momentum and its spin: whatever was predicted, its particles' mean
//! position and velocity are those of free fall, as a whole they turn no further than in free fall, and they
//! have its angular momentum.
//!
//! One is in free flight when it stays away from walls, now and where its mean velocity takes it
//! ([`FlightRule::wall_distance`]).
//!
//! 1. Sum: for each cell, what the body's motion is made of.
//! 2. Join: the rigid motion that is wrong in each body's prediction.
//! 3. Correct: particles of bodies in flight lose it.

use super::{
    super::{Ballistic, particle_features::State},
    Observed, Predicted,
    bodies::{self, Bodies},
};
use crate::{
    checkpoint::FlightRule,
    kernels::nodes::{Cell, Nodes},
};

/// Mean squared distance from the centre below which nothing can turn (squared domain lengths).
const POINT: f64 = 1e-10;

/// A step of the rule.
#[derive(Clone, Copy, Debug)]
pub(in super::super) enum Step {
    /// Sums over the predictions; an item is a block of cells.
    Sum,
    /// The bodies' rigid motions; one item.
    Join,
    /// Particles in flight lose what is wrong with these; an item is a block of cells.
    Correct,
}

/// The steps, in order.
pub(super) const STEPS: [Step; 3] = [Step::Sum, Step::Join, Step::Correct];

/// Which bodies of a frame fly, and what is wrong with their predictions.
#[derive(Debug, Default)]
pub(super) struct Flights(Vec<Flight>);

/// A body.
#[derive(Clone, Copy, Debug)]
struct Flight {
    /// Whether it is in free flight.
    flies: bool,
    sums: Sums,
    motion: Motion,
}

/// Sums over particles: x and v are where free fall takes them, X and V what is predicted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Sums {
    count: f64,
    /// x, v, X, V.
    first: [[f64; 2]; 4],
    /// x . x and X . X.
    squares: [f64; 2],
    /// x cross v, x cross X, X cross V.
    turns: [f64; 3],
    /// x . V.
    stretch: f64,
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

impl Flights {
    /// Makes room for as many bodies as the grid has room for.
    pub(super) fn make_room(&mut self, nodes: &Nodes) {
        self.0.clear();
        self.0.reserve(bodies::capacity(nodes));
    }

    /// Finds the bodies that are in free flight; `width` is that of a cell (domain lengths).
    pub(super) fn begin(
        &mut self,
        rule: FlightRule,
        bodies: &Bodies,
        walls: &Ballistic,
        width: f32,
    ) {
        let flight = |flies| Flight { flies, sums: Sums::default(), motion: Motion::default() };
        self.0.clear();
        self.0.extend(bodies.clear_of(walls, rule.wall_distance * width).map(flight));
    }

    /// Sums over the predictions for some cells.
    #[inline(always)]
    pub(super) fn sum(
        &self,
        bodies: &Bodies,
        observed: &Observed<'_>,
        predicted: &Predicted<'_>,
        cells: &[Cell],
        sums: &mut [CellSums],
    ) {
        // SAFETY: this step only reads the predictions.
        let (position, velocity) = unsafe { predicted.all() };
        for (cell, CellSums(sums)) in cells.iter().zip(sums) {
            *sums = Sums::default();
            if !self.0[bodies.of(cell)].flies {
                continue;
            }
            for &row in &observed.nodes.order()[cell.slots()] {
                let particle = observed.order[row as usize] as usize;
                let next = (position[particle], velocity[particle]);
                sums.take(&observed.free(row as usize), &next);
            }
        }
    }

    /// Finds what is wrong with each body's prediction from its cells' sums.
    pub(super) fn join(&mut self, bodies: &Bodies, cells: &[Cell], sums: &[CellSums]) {
        for (cell, CellSums(sums)) in cells.iter().zip(sums) {
            self.0[bodies.of(cell)].sums.add(sums);
        }
        for Flight { flies, sums, motion } in &mut self.0 {
            *motion = sums.motion();
            // One particle without a number must not take all others with it.
            *flies &= motion.is_finite();
        }
    }

    /// Gives particles of some cells their momentum and their spin.
    ///
    /// # Safety
    /// No other item has these cells.
    #[inline(always)]
    pub(super) unsafe fn correct(
        &self,
        bodies: &Bodies,
        observed: &Observed<'_>,
        predicted: &Predicted<'_>,
        cells: &[Cell],
    ) {
        for cell in cells {
            let Flight { flies, motion, .. } = &self.0[bodies.of(cell)];
            if !flies {
                continue;
            }
            for &row in &observed.nodes.order()[cell.slots()] {
                let particle = observed.order[row as usize] as usize;
                // SAFETY: a particle has one slot, which is in one of these cells.
                let (position, velocity) = unsafe { predicted.one(particle) };
                let (free, next) = (observed.free(row as usize), (*position, *velocity));
                (*position, *velocity) = motion.correct(&free, next, &observed.ballistic);
            }
        }
    }
}

/// Sums over the predictions of a cell.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct CellSums(Sums);

#[inline(always)]
fn dot(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

#[inline(always)]
fn cross(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[1] - a[1] * b[0]
}

impl Motion {
    fn is_finite(&self) -> bool {
        let Self { centres, faster, angle, spin } = self;
        let numbers = centres.as_flattened().iter().chain(faster).chain([angle, spin]);
        numbers.into_iter().all(|number| number.is_finite())
    }

    /// What a particle has as its next state instead of `next`, where free fall takes it to `free`.
    #[inline(always)]
    fn correct(&self, free: &State, next: State, walls: &Ballistic) -> State {
        let Self { centres: [centre, predicted], faster, angle, spin } = self;
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

impl Sums {
    /// Takes a particle in.
    #[inline(always)]
    fn take(&mut self, free: &State, next: &State) {
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

    fn add(&mut self, other: &Self) {
        let Self { count, first, squares, turns, stretch } = self;
        *count += other.count;
        *stretch += other.stretch;
        let all = first.as_flattened_mut().iter_mut().chain(squares).chain(turns);
        let others = other.first.as_flattened().iter().chain(&other.squares).chain(&other.turns);
        all.zip(others).for_each(|(sum, other)| *sum += other);
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
