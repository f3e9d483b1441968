//! From the decoder's outputs to a particle's next state. `x`, `v`: position (domain lengths) and velocity (domain lengths per
//! second), `x'`, `v'` those of the next frame, `o` the outputs, `x_b`, `v_b` the state after the
//! [ballistic step](super::ballistic).
//!
//! | model | outputs | next state |
//! |---|---|---|
//! | particle | [`ResidualStep`]: `[4]` | `v' = v_b + u (o_1, o_2)`, `x' = x_b + u dt (o_3, o_4)`, both limited |
//! | frame | [`FrameOutput::Displacement`]: `[2]` | `v' = v + o`, `x' = x + v' dt` |
//! | frame | [`FrameOutput::Residual`]: `[2]` | `v' = v_b + o`, `x' = x_b + o dt / 2` |
//! | frame | [`FrameOutput::Position`]: `[2]` | `x' = mean + deviation o`, `v' = (x' - x) / dt` |
//!
//! `u` is the unit of velocities. The particle model's position has its own residual because a frame spans many substeps: an early
//! impulse moves a particle further than a late one. `v'` is limited to the range in training extended by a quarter on each side,
//! `x'` to the effective walls, so that rollouts stay finite; no gradient passes a limit, or a wall that stops the ballistic step.
//! What is not a number stays so in predictions, where it is reported; in training it becomes the lower limit, so that a window
//! which diverges has a finite loss and no gradient.
//!
//! This file has both on processors, with their gradients, `device.cu` the particle model's on GPUs; the frame
//! model's is `frame/motion.cu` of `eddy-cuda`, beside the kernels that take its constants as an argument. The definition in burn
//! is `Pass::advance` in `model/definition.rs` of `eddy-learning`.

use super::ballistic::{Ballistic, Motion, clamped};
use crate::{
    checkpoint::{Description, FrameOutput},
    engine::scales::{velocity_limits, velocity_unit},
};

/// The ballistic step and the particle model's step on GPUs.
pub const DEVICE: &str = include_str!("device.cu");

/// The particle model's step from the decoder's outputs to the next state.
#[derive(Clone, Copy, Debug)]
pub struct ResidualStep {
    /// The step to which residuals are added.
    pub ballistic: Ballistic,
    /// u (domain lengths per second).
    pub velocity_unit: f32,
    /// Smallest velocity, by axis (domain lengths per second).
    pub slowest: [f32; 2],
    /// Largest velocity, by axis (domain lengths per second).
    pub fastest: [f32; 2],
}

/// The gradients by a particle's state and by the outputs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepGradient<const O: usize> {
    /// By the position.
    pub position: [f32; 2],
    /// By the velocity.
    pub velocity: [f32; 2],
    /// By the outputs.
    pub output: [f32; O],
}

impl ResidualStep {
    /// Of the described network.
    pub fn new(description: &Description) -> Self {
        let (slowest, fastest) = velocity_limits(&description.normalization);
        Self {
            ballistic: Ballistic::new(description),
            velocity_unit: velocity_unit(&description.normalization),
            slowest,
            fastest,
        }
    }

    /// The next state from that after the ballistic step.
    #[inline(always)]
    pub fn from_ballistic(&self, fallen: &Motion, output: &[f32; 4]) -> Motion {
        self.limited(self.unlimited(fallen, output))
    }

    /// The next state.
    #[inline(always)]
    pub fn next(&self, position: [f32; 2], velocity: [f32; 2], output: &[f32; 4]) -> Motion {
        self.from_ballistic(&self.ballistic.step(position, velocity), output)
    }

    /// The same for training.
    pub fn next_in_training(
        &self,
        position: [f32; 2],
        velocity: [f32; 2],
        output: &[f32; 4],
    ) -> Motion {
        let Self { ballistic: Ballistic { lower, upper, .. }, slowest, fastest, .. } = self;
        let (place, speed) = self.unlimited(&self.ballistic.step(position, velocity), output);
        let held = |x: [f32; 2], low: &[f32; 2], high: &[f32; 2]| {
            [0, 1].map(|axis| x[axis].max(low[axis]).min(high[axis]))
        };
        (held(place, lower, upper), held(speed, slowest, fastest))
    }

    #[inline(always)]
    fn unlimited(&self, (position, velocity): &Motion, output: &[f32; 4]) -> Motion {
        // Loops: closures of `map` and `from_fn` may not be inlined and would lose the SIMD instruction set.
        let (mut place, mut speed) = ([0.0; 2], [0.0; 2]);
        for axis in 0..2 {
            speed[axis] = velocity[axis] + output[axis] * self.velocity_unit;
            place[axis] =
                position[axis] + output[2 + axis] * self.velocity_unit * self.ballistic.dt;
        }
        (place, speed)
    }

    /// NaN stays NaN.
    #[inline(always)]
    fn limited(&self, (mut place, mut speed): Motion) -> Motion {
        for axis in 0..2 {
            speed[axis] = clamped(speed[axis], self.slowest[axis], self.fastest[axis]);
            place[axis] = self.ballistic.clamp_axis(axis, place[axis]);
        }
        (place, speed)
    }

    /// The gradients from those by the next state.
    pub fn gradient(
        &self,
        position: [f32; 2],
        velocity: [f32; 2],
        output: &[f32; 4],
        (by_place, by_speed): (&[f32; 2], &[f32; 2]),
    ) -> StepGradient<4> {
        let Self { ballistic, velocity_unit: unit, slowest, fastest } = self;
        let fallen = ballistic.step(position, velocity);
        let (place, speed) = self.unlimited(&fallen, output);
        let moving = ballistic.moving(position, velocity);
        let mut by = StepGradient { position: [0.0; 2], velocity: [0.0; 2], output: [0.0; 4] };
        for axis in 0..2 {
            let within = |x: f32, low: f32, high: f32| x >= low && x <= high;
            let inside = within(place[axis], ballistic.lower[axis], ballistic.upper[axis]);
            let usual = within(speed[axis], slowest[axis], fastest[axis]);
            let by_place = if inside { by_place[axis] } else { 0.0 };
            let by_speed = if usual { by_speed[axis] } else { 0.0 };
            if moving[axis] {
                by.position[axis] = by_place;
                by.velocity[axis] = ballistic.dt * by_place + by_speed;
            }
            by.output[axis] = unit * by_speed;
            by.output[2 + axis] = unit * ballistic.dt * by_place;
        }
        by
    }
}

/// What the outputs of a frame model's decoder mean.
#[derive(Clone, Copy, Debug)]
pub struct Decoded {
    /// Which outputs they are.
    pub output: FrameOutput,
    /// The step to which a residual is added.
    pub ballistic: Ballistic,
    /// Mean position in training (domain lengths).
    pub mean: [f32; 2],
    /// Standard deviation of positions in training (domain lengths).
    pub deviation: [f32; 2],
}
impl Decoded {
    /// Of the described network.
    pub fn new(description: &Description) -> Self {
        let scale = &description.normalization;
        Self {
            output: description.frame.output,
            ballistic: Ballistic::new(description),
            mean: [scale.mean[0], scale.mean[1]],
            deviation: [scale.standard_deviation[0], scale.standard_deviation[1]],
        }
    }

    /// Position (domain lengths) and velocity (domain lengths per second) one frame later.
    #[inline(always)]
    pub fn next(&self, x: [f32; 2], v: [f32; 2], output: [f32; 2]) -> ([f32; 2], [f32; 2]) {
        let dt = self.ballistic.dt;
        match self.output {
            FrameOutput::Displacement => {
                let velocity = [0, 1].map(|axis| v[axis] + output[axis]);
                ([0, 1].map(|axis| x[axis] + velocity[axis] * dt), velocity)
            }
            FrameOutput::Residual => {
                let (position, velocity) = self.ballistic.step(x, v);
                let farther = [0, 1].map(|axis| position[axis] + 0.5 * dt * output[axis]);
                (farther, [0, 1].map(|axis| velocity[axis] + output[axis]))
            }
            FrameOutput::Position => {
                let position =
                    [0, 1].map(|axis| self.mean[axis] + self.deviation[axis] * output[axis]);
                (position, [0, 1].map(|axis| (position[axis] - x[axis]) / dt))
            }
        }
    }

    /// The gradients from those by the next state. None by a particle's state passes a wall that stops the ballistic step.
    pub fn gradient(
        &self,
        x: [f32; 2],
        v: [f32; 2],
        (by_place, by_speed): (&[f32; 2], &[f32; 2]),
    ) -> StepGradient<2> {
        let dt = self.ballistic.dt;
        let moving = self.ballistic.moving(x, v);
        let mut by = StepGradient { position: [0.0; 2], velocity: [0.0; 2], output: [0.0; 2] };
        for axis in 0..2 {
            let (by_place, by_speed) = (by_place[axis], by_speed[axis]);
            match self.output {
                FrameOutput::Displacement => {
                    by.position[axis] = by_place;
                    by.velocity[axis] = by_speed + dt * by_place;
                    by.output[axis] = by_speed + dt * by_place;
                }
                FrameOutput::Residual => {
                    if moving[axis] {
                        by.position[axis] = by_place;
                        by.velocity[axis] = by_speed + dt * by_place;
                    }
                    by.output[axis] = by_speed + 0.5 * dt * by_place;
                }
                FrameOutput::Position => {
                    by.position[axis] = -by_speed / dt;
                    by.output[axis] = self.deviation[axis] * (by_place + by_speed / dt);
                }
            }
        }
        by
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const STEP: ResidualStep = ResidualStep {
        ballistic: Ballistic { gravity: [0.0, -0.3], dt: 0.5, lower: [0.05; 2], upper: [3.95; 2] },
        velocity_unit: 0.7,
        slowest: [-3.0, -4.0],
        fastest: [3.0, 2.0],
    };

    proptest! {
        #[test]
        fn gradients_are_differences(
            position in prop::array::uniform2(0.05f32..3.95),
            velocity in prop::array::uniform2(-4f32..4.0),
            output in prop::array::uniform4(-3f32..3.0),
            by in prop::array::uniform4(-1f32..1.0),
        ) {
            const H: f32 = 1e-3;
            let of = |numbers: [f32; 8]| {
                let [x, y, u, v, a, b, c, d] = numbers;
                let (place, speed) = STEP.next([x, y], [u, v], &[a, b, c, d]);
                let all = place.into_iter().chain(speed).zip(by);
                all.map(|(number, by)| f64::from(number * by)).sum::<f64>()
            };
            let ([x, y], [u, v], [a, b, c, d]) = (position, velocity, output);
            let [by_x, by_y, by_u, by_v] = by;
            let found = STEP.gradient(position, velocity, &output, (&[by_x, by_y], &[by_u, by_v]));
            let found = found.position.into_iter().chain(found.velocity).chain(found.output);
            for (number, found) in found.enumerate() {
                let moved = |by: f32| {
                    let mut numbers = [x, y, u, v, a, b, c, d];
                    numbers[number] += by;
                    of(numbers)
                };
                let (above, below) = (moved(H) - of([x, y, u, v, a, b, c, d]), of([x, y, u, v, a, b, c, d]) - moved(-H));
                // Where a limit or a wall begins to hold, the two sides differ.
                if (above - below).abs() < 1e-5 {
                    let expected = (above + below) / f64::from(2.0 * H);
                    prop_assert!((expected - f64::from(found)).abs() < 1.5e-2, "{number}: {expected} {found}");
                }
            }
        }
    }

    #[test]
    fn next_states_are_limited_and_nan_stays_nan() {
        let (place, speed) = STEP.next([3.9, 0.1], [2.9, -1.0], &[9.0, f32::NAN, 9.0, -9.0]);
        assert_eq!((place, speed[0]), ([3.95, 0.05], 3.0));
        assert!(speed[1].is_nan());
        let (output, by) = ([9.0, f32::NAN, 0.1, -0.1], [1.0; 2]);
        let (_, speed) = STEP.next_in_training([0.5, 0.5], [0.1, -1.0], &output);
        assert_eq!(speed, [3.0, -4.0]);
        let gradient = STEP.gradient([0.5, 0.5], [0.1, -1.0], &output, (&by, &by));
        assert_eq!(gradient.output[..2], [0.0, 0.0]);
    }

    #[test]
    fn zeros_are_constant_velocity_free_fall_or_the_mean() {
        let ballistic =
            Ballistic { gravity: [0.0, -1.0], dt: 0.5, lower: [0.0; 2], upper: [4.0; 2] };
        let decoded = |output| Decoded { output, ballistic, mean: [1.0, 2.0], deviation: [3.0; 2] };
        let next = |output, o| decoded(output).next([1.0, 3.0], [2.0, 0.0], o);
        let zero = [0.0; 2];
        assert_eq!(next(FrameOutput::Displacement, zero), ([2.0, 3.0], [2.0, 0.0]));
        assert_eq!(next(FrameOutput::Residual, zero), ([2.0, 2.875], [2.0, -0.5]));
        assert_eq!(next(FrameOutput::Position, zero), ([1.0, 2.0], [0.0, -2.0]));
        // A residual that cancels gravity keeps the velocity.
        assert_eq!(next(FrameOutput::Residual, [0.0, 0.5]), ([2.0, 3.0], [2.0, 0.0]));
        assert_eq!(next(FrameOutput::Position, [1.0, 0.0]), ([4.0, 2.0], [6.0, -2.0]));
    }
}
