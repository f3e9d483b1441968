//! A body in free flight keeps its momentum and angular momentum: whatever was predicted, the mean position and velocity
//! of its particles are those of free fall, it does not rotate further than in free fall, and it has the same angular
//! momentum.
//!
//! A body is in free flight if it keeps a distance from walls, now and where its mean velocity takes it
//! ([`FlightRule::wall_distance`]).

use serde::{Deserialize, Serialize};

use super::{
    Ballistic, Launch, Most, Motion, Network, Observed, RuleOperation, WrongConstant,
    bodies::rule::{self, BodyCorrection, BodyRule, Particle},
};

/// Constants of the rule that a body in free flight keeps its momentum and angular momentum.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlightRule {
    /// Distance from walls that a body in free flight keeps, now and where its mean velocity takes it (cells of the network's
    /// finest level).
    pub wall_distance: f32,
}

/// Mean squared distance from the centre below which a body has no orientation (squared domain lengths).
const POINT: f64 = 1e-10;

/// Sums over particles: x and v after free fall, X and V as predicted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Sums {
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

/// The rigid motion by which a body's prediction differs from free fall.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RigidError {
    /// Means of x and of X.
    centres: [[f64; 2]; 2],
    /// Excess velocity.
    velocity: [f64; 2],
    /// Excess rotation (radians).
    angle: f64,
    /// Excess angular velocity (radians per second).
    spin: f64,
}

impl RuleOperation for FlightRule {
    const STANDARD: Option<Self> = Some(Self { wall_distance: 1.5 });
    const NEEDS_BODIES: bool = true;
    const DEVICE: &'static str = include_str!("device.cu");

    type Scratch = rule::Scratch<Self>;
    type InFrame<'a> = BodyCorrection<'a, Self>;

    fn check(&self, _: &Network) -> Result<(), WrongConstant> {
        WrongConstant::unless_distance(self.wall_distance)
    }

    fn steps(&self) -> usize {
        rule::STEPS
    }

    fn begin<'a>(
        &self,
        scratch: &'a mut rule::Scratch<Self>,
        observed: &Observed<'a>,
    ) -> BodyCorrection<'a, Self> {
        BodyCorrection::new(*self, scratch, observed)
    }

    fn device_constants(&self, network: &Network) -> Vec<(&'static str, f32)> {
        vec![("distance", self.wall_distance * network.cell_width)]
    }

    fn launches(&self, most: &Most) -> Vec<Launch> {
        vec![Launch { block: 128, ..Launch::new("flight", most.cells) }]
    }
}

impl BodyRule for FlightRule {
    type CellSums = Sums;
    type BodySums = Sums;
    type Correction = RigidError;

    fn wall_distance(&self) -> f32 {
        self.wall_distance
    }

    const CLEAR_OF_WALLS: bool = true;

    #[inline(always)]
    fn add_particle(sums: &mut Sums, particle: &Particle) {
        sums.add_particle(&particle.free, &particle.predicted);
    }

    fn add_cell(sums: &mut Sums, cell: &Sums) {
        sums.add(cell);
    }

    fn correction(&self, sums: &Sums, _: &Ballistic) -> Option<RigidError> {
        // A single NaN must not spread to all particles of the body.
        Some(sums.rigid_error()).filter(RigidError::is_finite)
    }

    #[inline(always)]
    fn correct(error: &RigidError, particle: &Particle, walls: &Ballistic) -> Motion {
        error.correct(&particle.free, particle.predicted, walls)
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

impl RigidError {
    fn is_finite(&self) -> bool {
        let Self { centres, velocity, angle, spin } = self;
        let numbers = centres.as_flattened().iter().chain(velocity).chain([angle, spin]);
        numbers.into_iter().all(|number| number.is_finite())
    }

    /// The motion of a particle instead of `predicted`, where `free` is that of free fall.
    #[inline(always)]
    fn correct(&self, free: &Motion, predicted: Motion, walls: &Ballistic) -> Motion {
        let Self { centres: [centre, predicted_centre], velocity: excess, angle, spin } = self;
        let (mut position, mut velocity) = predicted;
        let from = |x: [f32; 2], centre: &[f64; 2]| {
            [f64::from(x[0]) - centre[0], f64::from(x[1]) - centre[1]]
        };
        let (r, place) = (from(free.0, centre), from(predicted.0, predicted_centre));
        let arm = [place[0] + angle * r[1], place[1] - angle * r[0]];
        let turned = [-arm[1], arm[0]];
        for axis in 0..2 {
            position[axis] = walls.clamp_axis(axis, (centre[axis] + arm[axis]) as f32);
            let v = f64::from(velocity[axis]) - excess[axis] - spin * turned[axis];
            velocity[axis] = v as f32;
        }
        (position, velocity)
    }
}

impl Sums {
    #[inline(always)]
    fn add_particle(&mut self, free: &Motion, predicted: &Motion) {
        let double = |x: [f32; 2]| [f64::from(x[0]), f64::from(x[1])];
        let (x, v) = (double(free.0), double(free.1));
        let (place, speed) = (double(predicted.0), double(predicted.1));
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

    /// Let r, w, p, q be x, v, X, V relative to their means, and J the rotation by a right angle. The positions
    /// p - angle J r are not rotated against r, and with them the velocities q - spin J (p - angle J r) have the angular
    /// momentum of r and w.
    fn rigid_error(&self) -> RigidError {
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
        let velocity = [speed[0] - v[0], speed[1] - v[1]];
        RigidError { centres: [x, place], velocity, angle, spin }
    }
}
