//! A body that touches a wall and hardly moves comes to rest, as in rigid-body engines that put islands to sleep: the
//! errors of a network would make it creep. Its motion is scaled down, to zero below [`RestRule::asleep_below`].
//!
//! The scale depends on the mean squared speed of the body's fastest cell.

use super::{
    super::{Ballistic, particle_features::Motion},
    body_rule::{BodyRule, Particle},
};
use crate::checkpoint::RestRule;

/// Sums over the particles of a cell.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Speeds {
    count: f64,
    /// Squared speeds, observed and predicted.
    squares: [f64; 2],
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
