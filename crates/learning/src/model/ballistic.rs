//! The ballistic step over tensors, on which the particle model predicts a residual; a property test compares it with
//! [`Ballistic::step`].

use burn::tensor::{Device, Tensor};

use eddy_inference::engine::Ballistic;

/// [`Ballistic`] over tensors.
#[derive(Clone, Debug)]
pub(crate) struct BallisticTensors {
    pub(crate) plain: Ballistic,
    /// g dt, `[1, 2]`.
    pub(crate) fall: Tensor<2>,
    /// Left and lower wall, `[1, 2]`.
    pub(crate) lower: Tensor<2>,
    /// Right and upper wall, `[1, 2]`.
    pub(crate) upper: Tensor<2>,
}

/// The result of the step, `[R, 2]` each.
pub(crate) struct BallisticMotion {
    /// Positions at the next frame.
    pub(crate) position: Tensor<2>,
    /// Velocities at the next frame.
    pub(crate) velocity: Tensor<2>,
    /// Velocity change at walls.
    pub(crate) wall_impulse: Tensor<2>,
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

    /// `position` and `velocity` are `[R, 2]`. No gradient passes through a velocity that a wall stops.
    pub(crate) fn step(&self, position: Tensor<2>, velocity: Tensor<2>) -> BallisticMotion {
        let free_velocity = velocity.clone() + self.fall.clone();
        let free = position + (velocity + free_velocity.clone()).mul_scalar(0.5 * self.plain.dt);
        let clamped = free.clone().max_pair(self.lower.clone()).min_pair(self.upper.clone());
        let moving = clamped.clone().detach().equal(free.detach()).float(); // 1 free, 0 stopped
        let velocity = free_velocity.clone() * moving;
        BallisticMotion {
            position: clamped,
            wall_impulse: velocity.clone() - free_velocity,
            velocity,
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const STEP: Ballistic =
        Ballistic { gravity: [0.0, -9.8], dt: 0.016, lower: [0.05, 0.05], upper: [0.95, 0.95] };

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn the_step_over_tensors_equals_the_plain_step(
            particles in proptest::collection::vec((0f32..1.0, 0f32..1.0, -4f32..4.0, -4f32..4.0), 1..20),
        ) {
            let device = Device::flex();
            let tensors = BallisticTensors::new(STEP, &device);
            let rows = |pick: fn(&(f32, f32, f32, f32)) -> [f32; 2]| {
                let flat: Vec<f32> = particles.iter().flat_map(pick).collect();
                Tensor::<1>::from_floats(flat.as_slice(), &device).reshape([particles.len(), 2])
            };
            let motion = tensors.step(rows(|p| [p.0, p.1]), rows(|p| [p.2, p.3]));
            let position: Vec<f32> = motion.position.into_data().try_to_vec().unwrap();
            let velocity: Vec<f32> = motion.velocity.into_data().try_to_vec().unwrap();
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
