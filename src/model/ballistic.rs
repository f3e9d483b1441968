//! The ballistic step: free fall between walls, what a particle does that nothing else touches.
//!
//! v' = v + g dt, x' = x + v dt + g dt^2 / 2, the parabola; where x' would lie beyond a wall, the particle stops at the wall
//! and loses the velocity component across it (inelastic, free slip). The plain form serves as a
//! baseline; its tensor twin is what the particle model's residual sits on. A property test joins
//! the two.

use burn::tensor::{Device, Tensor};

use crate::checkpoint::Description;

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

/// The same step over tensors.
#[derive(Clone, Debug)]
pub(crate) struct BallisticTensors {
    /// The same numbers.
    pub(crate) plain: Ballistic,
    /// g dt, `[1, 2]`.
    pub(crate) fall: Tensor<2>,
    /// Left and lower wall, `[1, 2]`.
    pub(crate) lower: Tensor<2>,
    /// Right and upper wall, `[1, 2]`.
    pub(crate) upper: Tensor<2>,
}

/// What the step gives, each `[R, 2]`.
pub(crate) struct Fallen {
    /// Positions at the next frame.
    pub(crate) position: Tensor<2>,
    /// Velocities at the next frame.
    pub(crate) velocity: Tensor<2>,
    /// Velocity lost at walls.
    pub(crate) stopped: Tensor<2>,
}

impl BallisticTensors {
    pub(crate) fn new(plain: Ballistic, device: &Device) -> Self {
        let row = |values: [f32; 2]| Tensor::<1>::from_floats(values, device).unsqueeze::<2>();
        Self {
            fall: row(plain.gravity.map(|g| g * plain.dt)),
            lower: row(plain.lower),
            upper: row(plain.upper),
            plain,
        }
    }

    /// `position` and `velocity` are `[R, 2]`. No gradient passes through a stop's velocity.
    pub(crate) fn step(&self, position: Tensor<2>, velocity: Tensor<2>) -> Fallen {
        let fallen = velocity.clone() + self.fall.clone();
        let free = position + (velocity + fallen.clone()).mul_scalar(0.5 * self.plain.dt);
        let held = free.clone().max_pair(self.lower.clone()).min_pair(self.upper.clone());
        let moving = held.clone().detach().equal(free.detach()).float(); // 1 free, 0 stopped
        let velocity = fallen.clone() * moving;
        Fallen { position: held, stopped: velocity.clone() - fallen, velocity }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const STEP: Ballistic =
        Ballistic { gravity: [0.0, -9.8], dt: 0.016, lower: [0.05, 0.05], upper: [0.95, 0.95] };

    #[test]
    fn a_falling_particle_stops_at_the_floor_and_keeps_sliding() {
        let (position, velocity) = STEP.step([0.5, 0.06], [1.0, -2.0]);
        assert_eq!(position[1], 0.05);
        assert_eq!(velocity, [1.0, 0.0]);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn the_tensor_twin_gives_the_same_step(
            particles in proptest::collection::vec((0f32..1.0, 0f32..1.0, -4f32..4.0, -4f32..4.0), 1..20),
        ) {
            let device = Device::flex();
            let twin = BallisticTensors::new(STEP, &device);
            let rows = |pick: fn(&(f32, f32, f32, f32)) -> [f32; 2]| {
                let flat: Vec<f32> = particles.iter().flat_map(pick).collect();
                Tensor::<1>::from_floats(flat.as_slice(), &device).reshape([particles.len(), 2])
            };
            let fallen = twin.step(rows(|p| [p.0, p.1]), rows(|p| [p.2, p.3]));
            let position: Vec<f32> = fallen.position.into_data().try_to_vec().unwrap();
            let velocity: Vec<f32> = fallen.velocity.into_data().try_to_vec().unwrap();
            for (i, p) in particles.iter().enumerate() {
                let (x, v) = STEP.step([p.0, p.1], [p.2, p.3]);
                for axis in 0..2 {
                    prop_assert!((position[2 * i + axis] - x[axis]).abs() <= 1e-6);
                    prop_assert!((velocity[2 * i + axis] - v[axis]).abs() <= 1e-6);
                }
            }
        }
    }
}
