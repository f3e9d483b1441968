//! Positions and velocities without the rest of a frame.

use super::Frame;

/// Positions and velocities at one instant; `N` particles.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// Positions, `[N, 2]` (domain lengths).
    pub position: Vec<[f32; 2]>,
    /// Velocities, `[N, 2]` (domain lengths per second).
    pub velocity: Vec<[f32; 2]>,
}

impl From<Frame> for State {
    fn from(frame: Frame) -> Self {
        Self { position: frame.position, velocity: frame.velocity }
    }
}

/// Mean of |x - x'|^2 over particles (domain lengths squared), for positions `[N, 2]`, subtracted in double precision.
pub fn mean_squared_distance(a: &[[f32; 2]], b: &[[f32; 2]]) -> f64 {
    a.iter().zip(b).map(|(&a, &b)| squared_distance(a, b)).sum::<f64>() / b.len() as f64
}

/// |x - x'|^2, subtracted in double precision.
pub fn squared_distance(a: [f32; 2], b: [f32; 2]) -> f64 {
    let [x, y] = [0, 1].map(|axis| f64::from(a[axis]) - f64::from(b[axis]));
    x * x + y * y
}

/// A vector with the three components that other programs need: those that it lacks are 0.
pub fn spatial<const D: usize>(vector: [f32; D]) -> [f32; 3] {
    std::array::from_fn(|axis| vector.get(axis).copied().unwrap_or_default())
}

/// |x - x'|.
pub fn distance<const D: usize>(a: [f32; D], b: [f32; D]) -> f32 {
    (1..D).fold(a[0] - b[0], |length, axis| length.hypot(a[axis] - b[axis]))
}
