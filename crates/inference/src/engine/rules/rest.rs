//! A body that touches a wall and hardly moves comes to rest, as in engines for rigid bodies that let islands of them
//! sleep: a network's errors of a frame would make it creep. Its motion is scaled down, to nothing below
//! [`RestRule::asleep_below`].
//!
//! 1. Weigh: the speed of each cell.
//! 2. Judge: the part of its predicted motion that each body makes, by its fastest cell.
//! 3. Correct: particles of bodies that do not make all of it.

use super::{
    super::Ballistic,
    Observed, Predicted,
    bodies::{self, Bodies},
};
use crate::{
    checkpoint::RestRule,
    kernels::nodes::{Cell, Nodes},
};

/// A step of the rule.
#[derive(Clone, Copy, Debug)]
pub(in super::super) enum Step {
    /// Speeds of cells; an item is a block of cells.
    Weigh,
    /// The part of its motion that each body makes; one item.
    Judge,
    /// Particles of bodies at rest stay; an item is a block of cells.
    Correct,
}

/// The steps, in order.
pub(super) const STEPS: [Step; 3] = [Step::Weigh, Step::Judge, Step::Correct];

/// Which bodies of a frame touch something, and how much of their motion they make.
#[derive(Debug, Default)]
pub(super) struct Rests(Vec<Body>);

/// A body.
#[derive(Clone, Copy, Debug)]
struct Body {
    /// Whether it is at a wall.
    touches: bool,
    /// Mean squared speed of its fastest cell, as observed or as predicted.
    fastest: f64,
    /// The part of its predicted motion that it makes, 0 to 1.
    awake: f32,
}

impl Rests {
    /// Makes room for as many bodies as the grid has room for.
    pub(super) fn make_room(&mut self, nodes: &Nodes) {
        self.0.clear();
        self.0.reserve(bodies::capacity(nodes));
    }

    /// Finds the bodies that touch a wall; `width` is that of a cell (domain lengths).
    pub(super) fn begin(&mut self, rule: RestRule, bodies: &Bodies, walls: &Ballistic, width: f32) {
        let body = |clear: bool| Body { touches: !clear, fastest: 0.0, awake: 1.0 };
        self.0.clear();
        self.0.extend(bodies.clear_of(walls, rule.wall_distance * width).map(body));
    }

    /// The mean squared speed of each of some cells, as observed or as predicted, whichever is larger.
    #[inline(always)]
    pub(super) fn weigh(
        &self,
        bodies: &Bodies,
        observed: &Observed<'_>,
        predicted: &Predicted<'_>,
        cells: &[Cell],
        speeds: &mut [f64],
    ) {
        // SAFETY: this step only reads the predictions.
        let (_, velocity) = unsafe { predicted.all() };
        for (cell, speed) in cells.iter().zip(speeds) {
            *speed = 0.0;
            if !self.0[bodies.of(cell)].touches {
                continue;
            }
            let (mut count, mut sums) = (0.0f64, [0.0f64; 2]);
            for &row in &observed.nodes.order()[cell.slots()] {
                let particle = observed.order[row as usize] as usize;
                let seen = [observed.velocity[row as usize], velocity[particle]];
                for (sum, [x, y]) in sums.iter_mut().zip(seen) {
                    *sum += f64::from(x * x + y * y);
                }
                count += 1.0;
            }
            *speed = sums[0].max(sums[1]) / count.max(1.0);
        }
    }

    /// Finds which bodies rest, from the speeds of their cells.
    pub(super) fn judge(
        &mut self,
        rule: RestRule,
        bodies: &Bodies,
        walls: &Ballistic,
        cells: &[Cell],
        speeds: &[f64],
    ) {
        for (cell, &speed) in cells.iter().zip(speeds) {
            let body = &mut self.0[bodies.of(cell)];
            body.fastest = body.fastest.max(speed);
        }
        for body in self.0.iter_mut().filter(|body| body.touches) {
            body.awake = awake(rule, body.fastest, walls);
        }
    }

    /// Scales the motion of the particles of some cells down to what their bodies make of it.
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
            let awake = self.0[bodies.of(cell)].awake;
            if awake == 1.0 {
                continue;
            }
            for &row in &observed.nodes.order()[cell.slots()] {
                let from = observed.position[row as usize];
                let particle = observed.order[row as usize] as usize;
                // SAFETY: a particle has one slot, which is in one of these cells.
                let (position, velocity) = unsafe { predicted.one(particle) };
                for axis in 0..2 {
                    position[axis] = from[axis] + awake * (position[axis] - from[axis]);
                    velocity[axis] *= awake;
                }
            }
        }
    }
}

/// The part of its predicted motion that a body makes whose fastest cell has this mean squared speed: all
/// where it moves, or nothing pulls it down.
fn awake(rule: RestRule, fastest: f64, walls: &Ballistic) -> f32 {
    let RestRule { asleep_below, awake_from, .. } = rule;
    let pull = walls.gravity[0].hypot(walls.gravity[1]) * walls.dt;
    let awake = (fastest.sqrt() as f32 / pull - asleep_below) / (awake_from - asleep_below);
    if awake.is_finite() { awake.clamp(0.0, 1.0) } else { 1.0 }
}
