//! The ballistic step: free fall between walls, the motion of a particle that touches no other.
//!
//! v' = v + g dt, x' = x + v dt + g dt^2 / 2. If x' is beyond a wall, the particle stops at the wall and loses the normal
//! component of its velocity (inelastic, free slip). It is a baseline, and the particle model predicts residuals of it;
//! `model/ballistic.rs` of `eddy-learning` is the same step over tensors.

use crate::checkpoint::Description;
use eddy_frames::Domain;

/// Position (domain lengths) and velocity (domain lengths per second) of a particle.
pub(crate) type Motion = ([f32; 2], [f32; 2]);

/// Gravity, frame interval and effective walls.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ballistic {
    /// Gravity (domain lengths per second squared).
    pub gravity: [f32; 2],
    /// Time between two frames (s).
    pub dt: f32,
    /// Left and lower wall (domain lengths).
    pub lower: [f32; 2],
    /// Right and upper wall (domain lengths).
    pub upper: [f32; 2],
}

impl Ballistic {
    /// The step of the described network. The walls are where particles stopped in training.
    pub fn new(description: &Description) -> Self {
        let scale = &description.normalization;
        Self {
            gravity: description.gravity,
            dt: description.dt,
            lower: [scale.minimum[0], scale.minimum[1]],
            upper: [scale.maximum[0], scale.maximum[1]],
        }
    }

    /// This step, which is for the domain `from`, in the domain `to`: walls keep their distance from the corners.
    pub fn for_domain(&self, from: &Domain, to: &Domain) -> Self {
        let mut ballistic = *self;
        for axis in 0..2 {
            // Unchanged corners must keep their bits.
            if to.lower[axis] != from.lower[axis] {
                let thickness = self.lower[axis] - from.lower[axis];
                ballistic.lower[axis] = to.lower[axis] + thickness;
            }
            if to.upper[axis] != from.upper[axis] {
                let thickness = from.upper[axis] - self.upper[axis];
                ballistic.upper[axis] = to.upper[axis] - thickness;
            }
        }
        ballistic
    }

    /// The motion of a particle after one frame without walls: position (domain lengths) and velocity (domain lengths per
    /// second).
    #[inline(always)]
    pub fn free(&self, position: [f32; 2], velocity: [f32; 2]) -> ([f32; 2], [f32; 2]) {
        let fallen = [0, 1].map(|axis| velocity[axis] + self.gravity[axis] * self.dt);
        // The mean of the velocities before and after.
        let mean = |axis: usize| 0.5 * (velocity[axis] + fallen[axis]);
        ([0, 1].map(|axis| position[axis] + mean(axis) * self.dt), fallen)
    }

    /// The motion of a particle after one frame, stopped by walls.
    #[inline(always)]
    pub fn step(&self, position: [f32; 2], velocity: [f32; 2]) -> ([f32; 2], [f32; 2]) {
        let (mut position, mut velocity) = self.free(position, velocity);
        for axis in 0..2 {
            let clamped = position[axis].max(self.lower[axis]).min(self.upper[axis]);
            if clamped != position[axis] {
                (position[axis], velocity[axis]) = (clamped, 0.0);
            }
        }
        (position, velocity)
    }

    /// Whether no wall stops a particle in the step, by axis.
    pub fn moving(&self, position: [f32; 2], velocity: [f32; 2]) -> [bool; 2] {
        let ((free, _), (held, _)) = (self.free(position, velocity), self.step(position, velocity));
        [0, 1].map(|axis| free[axis] == held[axis])
    }

    /// A coordinate clamped to the space between the walls; NaN stays NaN.
    #[inline(always)]
    pub fn clamp_axis(&self, axis: usize, x: f32) -> f32 {
        clamped(x, self.lower[axis], self.upper[axis])
    }

    /// Advances all particles by one frame, in place.
    pub fn step_all(&self, position: &mut [[f32; 2]], velocity: &mut [[f32; 2]]) {
        for (x, v) in position.iter_mut().zip(velocity) {
            (*x, *v) = self.step(*x, *v);
        }
    }
}

/// A number between limits, by two selections instead of branches that depend on data; NaN stays NaN.
#[inline(always)]
pub(crate) fn clamped(x: f32, low: f32, high: f32) -> f32 {
    let raised = if x < low { low } else { x };
    if raised > high { high } else { raised }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: Ballistic =
        Ballistic { gravity: [0.0, -9.8], dt: 0.016, lower: [0.05, 0.05], upper: [0.95, 0.95] };

    #[test]
    fn a_falling_particle_stops_at_the_floor_and_keeps_sliding() {
        let (position, velocity) = STEP.step([0.5, 0.06], [1.0, -2.0]);
        assert_eq!(position[1], 0.05);
        assert_eq!(velocity, [1.0, 0.0]);
    }
}
