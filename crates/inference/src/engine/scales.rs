//! Scales of the particle model's inputs and outputs, the same for training and streaming.

use crate::checkpoint::Normalization;

/// Length scale of contact with a wall (domain lengths): about two cells of a 64 x 64 grid.
pub const CONTACT_SCALE: f32 = 0.03;
/// Length scale over which a wall acts through a body (domain lengths): about the size of a body.
pub const BODY_SCALE: f32 = 0.2;

/// Added to a node's mass so that averages stay finite where it is almost zero (particles).
pub const MIN_MASS: f32 = 1e-3;
/// Particles per cell of the finest level in a full cell: a solver has four in a cell half as wide.
pub const FULL_MASS: f32 = 16.0;

/// Young's modulus whose feature is 0 (density x velocity^2), and the decades from there to a feature of 1: 3e2 to 3e5, around the
/// presets' 1e3 and 1e5, become about -1 to 1.
const MIDDLE_STIFFNESS: f64 = 1e4;
const STIFFNESS_DECADES: f64 = 1.5;
/// Largest feature of the stiffness; the smallest is its negative (56 and 1.8e6): beyond, a network would extrapolate.
const MAX_STIFFNESS_FEATURE: f64 = 1.5;

/// By how much predicted velocities may exceed the range in training, as a share of that range.
const VELOCITY_MARGIN: f32 = 0.25;

/// The unit of velocity changes (domain lengths per second): root mean square of the velocity
/// components' standard deviations.
pub fn velocity_unit(scale: &Normalization) -> f32 {
    let [_, _, x, y] = scale.standard_deviation;
    ((x * x + y * y) / 2.0).sqrt()
}

/// The smallest and the largest predicted velocities, by axis (domain lengths per second).
pub fn velocity_limits(scale: &Normalization) -> ([f32; 2], [f32; 2]) {
    let bound = |side: f32, of: [f32; 4]| {
        [2, 3].map(|axis| {
            of[axis] + side * VELOCITY_MARGIN * (scale.maximum[axis] - scale.minimum[axis])
        })
    };
    (bound(-1.0, scale.minimum), bound(1.0, scale.maximum))
}

/// The particle model's feature for a stiffness: Young's modulus (density x velocity^2).
pub fn stiffness_feature(stiffness: f32) -> f32 {
    let decades = (f64::from(stiffness) / MIDDLE_STIFFNESS).log10();
    let feature = decades / STIFFNESS_DECADES;
    feature.clamp(-MAX_STIFFNESS_FEATURE, MAX_STIFFNESS_FEATURE) as f32
}
