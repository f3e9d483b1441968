//! Scales of the particle model's inputs and outputs, which the networks in burn share with the engine.

use crate::checkpoint::Normalization;

/// Scale of contact with a wall (domain lengths): about two cells of the 64 grid.
pub const NEAR: f32 = 0.03;
/// Scale of the reach of a wall through a body (domain lengths): about a body's size.
pub const FAR: f32 = 0.2;

/// Keeps averages finite where hardly any particle is near (particles of a node).
pub const LEAST_MASS: f32 = 1e-3;
/// Particles that fill a cell of the finest level where a solver has four in a cell half as wide.
pub const FULL: f32 = 16.0;

/// How far v' may leave the range of training velocities, as a share of that range.
const VELOCITY_MARGIN: f32 = 0.25;

/// The unit of velocity changes (domain lengths per second): root mean square of the velocity
/// components' standard deviations.
pub fn velocity_unit(scale: &Normalization) -> f32 {
    let [_, _, x, y] = scale.standard_deviation;
    ((x * x + y * y) / 2.0).sqrt()
}

/// The smallest and the largest velocities that are predicted, by axis (domain lengths per second).
pub fn velocity_limits(scale: &Normalization) -> ([f32; 2], [f32; 2]) {
    let bound = |side: f32, of: [f32; 4]| {
        [2, 3].map(|axis| {
            of[axis] + side * VELOCITY_MARGIN * (scale.maximum[axis] - scale.minimum[axis])
        })
    };
    (bound(-1.0, scale.minimum), bound(1.0, scale.maximum))
}
