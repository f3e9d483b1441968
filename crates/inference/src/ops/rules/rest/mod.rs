//! A body that touches a wall and hardly moves comes to rest, as in rigid-body engines that put islands to sleep: the
//! errors of a network would make it creep. Its motion is scaled down, to zero below [`RestRule::asleep_below`].
//!
//! The scale depends on the mean squared speed of the body's fastest cell.

use serde::{Deserialize, Serialize};

use super::{
    Ballistic, Launch, Most, Motion, Network, Observed, RuleOperation, WrongConstant,
    bodies::rule::{self, BodyCorrection, BodyRule, Particle},
};

/// Constants of the rule that a body which touches a wall and hardly moves comes to rest. The speed of a body is that of its
/// fastest cell, relative to the velocity that gravity adds per frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RestRule {
    /// Distance from a wall below which a body touches it, now or where its mean velocity takes it (cells of the network's
    /// finest level).
    pub wall_distance: f32,
    /// Speed below which the body does not move (relative to the velocity that gravity adds per frame).
    pub asleep_below: f32,
    /// Speed above which the body moves as predicted (relative to the velocity that gravity adds per frame); in between, its
    /// motion is scaled down.
    pub awake_from: f32,
}

/// Sums over the particles of a cell.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Speeds {
    count: f64,
    /// Squared speeds, observed and predicted.
    squares: [f64; 2],
}

impl RuleOperation for RestRule {
    const STANDARD: Option<Self> =
        Some(Self { wall_distance: 1.5, asleep_below: 0.02, awake_from: 0.1 });
    const NEEDS_BODIES: bool = true;
    const DEVICE: &'static str = include_str!("device.cu");

    type Scratch = rule::Scratch<Self>;
    type InFrame<'a> = BodyCorrection<'a, Self>;

    fn check(&self, _: &Network) -> Result<(), WrongConstant> {
        let Self { wall_distance, asleep_below, awake_from } = *self;
        WrongConstant::unless_distance(wall_distance)?;
        let fits = asleep_below >= 0.0 && asleep_below.is_finite();
        WrongConstant::unless(fits, "asleep_below", asleep_below, "at least 0")?;
        let fits = awake_from > asleep_below && awake_from.is_finite();
        WrongConstant::unless(fits, "awake_from", awake_from, "above rules.rest.asleep_below")
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
        vec![
            ("distance", self.wall_distance * network.cell_width),
            ("asleep_below", self.asleep_below),
            ("awake_from", self.awake_from),
            ("gain", network.gain()),
        ]
    }

    fn launches(&self, most: &Most) -> Vec<Launch> {
        let speeds = Launch { block: 128, ..Launch::new("rest_speeds", most.cells) };
        vec![speeds, Launch::new("rest", most.particles)]
    }
}

impl BodyRule for RestRule {
    type CellSums = Speeds;
    /// Mean squared speed of the fastest cell, observed or predicted.
    type BodySums = f64;
    /// The share of its predicted motion that the body keeps, 0 to 1.
    type Correction = f32;

    fn wall_distance(&self) -> f32 {
        self.wall_distance
    }

    const CLEAR_OF_WALLS: bool = false;

    #[inline(always)]
    fn add_particle(sums: &mut Speeds, particle: &Particle) {
        let velocities = [particle.observed.1, particle.predicted.1];
        for (sum, [x, y]) in sums.squares.iter_mut().zip(velocities) {
            *sum += f64::from(x * x + y * y);
        }
        sums.count += 1.0;
    }

    fn add_cell(fastest: &mut f64, Speeds { count, squares: [observed, predicted] }: &Speeds) {
        *fastest = fastest.max(observed.max(*predicted) / count.max(1.0));
    }

    fn correction(&self, fastest: &f64, walls: &Ballistic) -> Option<f32> {
        let Self { asleep_below, awake_from, .. } = *self;
        let gain = walls.gravity[0].hypot(walls.gravity[1]) * walls.dt;
        let awake = (fastest.sqrt() as f32 / gain - asleep_below) / (awake_from - asleep_below);
        // Not finite without gravity: then nothing comes to rest.
        Some(awake.clamp(0.0, 1.0)).filter(|&share| awake.is_finite() && share < 1.0)
    }

    #[inline(always)]
    fn correct(awake: &f32, particle: &Particle, _: &Ballistic) -> Motion {
        let (from, _) = particle.observed;
        let (mut position, mut velocity) = particle.predicted;
        for axis in 0..2 {
            position[axis] = from[axis] + awake * (position[axis] - from[axis]);
            velocity[axis] *= awake;
        }
        (position, velocity)
    }
}
