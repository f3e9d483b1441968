//! The ballistic step: free fall between walls, the motion of a particle that nothing else touches.
//!
//! v' = v + g dt, x' = x + v dt + g dt^2 / 2, the parabola; where x' would lie beyond a wall, the particle stops at the wall
//! and loses the velocity component across it (inelastic, free slip). It serves as a baseline and as the
//! base of the particle model's residual; `model/ballistic.rs` has the same step over tensors.

use crate::checkpoint::Description;
use eddy_frames::Domain;

/// Gravity, frame interval and the walls in effect.
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
    /// The step of a described network: walls are where training particles stopped.
    pub fn of(description: &Description) -> Self {
        let scale = &description.normalization;
        Self {
            gravity: description.gravity,
            dt: description.dt,
            lower: [scale.minimum[0], scale.minimum[1]],
            upper: [scale.maximum[0], scale.maximum[1]],
        }
    }

    /// The step in the domain `to`, which may have another size than `from`, where this one is in effect: walls are as
    /// far from its corners.
    pub fn moved(&self, from: &Domain, to: &Domain) -> Self {
        let mut moved = *self;
        for axis in 0..2 {
            // A domain with the same corners has the very same numbers.
            if to.lower[axis] != from.lower[axis] {
                let thickness = self.lower[axis] - from.lower[axis];
                moved.lower[axis] = to.lower[axis] + thickness;
            }
            if to.upper[axis] != from.upper[axis] {
                let thickness = from.upper[axis] - self.upper[axis];
                moved.upper[axis] = to.upper[axis] - thickness;
            }
        }
        moved
    }

    /// One particle, one frame on, if there were no walls: position (domain lengths) and velocity
    /// (domain lengths per second).
    #[inline(always)]
    pub fn free(&self, position: [f32; 2], velocity: [f32; 2]) -> ([f32; 2], [f32; 2]) {
        let fallen = [0, 1].map(|axis| velocity[axis] + self.gravity[axis] * self.dt);
        // The mean of the velocities before and after.
        let mean = |axis: usize| 0.5 * (velocity[axis] + fallen[axis]);
        ([0, 1].map(|axis| position[axis] + mean(axis) * self.dt), fallen)
    }

    /// One particle, one frame on, stopped by walls: as [`Ballistic::free`].
    #[inline(always)]
    pub fn step(&self, position: [f32; 2], velocity: [f32; 2]) -> ([f32; 2], [f32; 2]) {
        let (mut place, mut fallen) = self.free(position, velocity);
        for axis in 0..2 {
            let held = place[axis].max(self.lower[axis]).min(self.upper[axis]);
            if held != place[axis] {
                (place[axis], fallen[axis]) = (held, 0.0);
            }
        }
        (place, fallen)
    }

    /// A coordinate held between walls; what is not a number stays so.
    #[inline(always)]
    pub fn hold(&self, axis: usize, x: f32) -> f32 {
        if x < self.lower[axis] {
            self.lower[axis]
        } else if x > self.upper[axis] {
            self.upper[axis]
        } else {
            x
        }
    }

    /// All particles, one frame on, in place.
    pub fn step_all(&self, position: &mut [[f32; 2]], velocity: &mut [[f32; 2]]) {
        for (x, v) in position.iter_mut().zip(velocity) {
            (*x, *v) = self.step(*x, *v);
        }
    }
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
