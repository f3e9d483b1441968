//! From the output of the frame model's decoder to a particle's next state.

use super::Ballistic;
use crate::checkpoint::{Description, FrameOutput};

/// What the decoder's output means, see [`FrameOutput`].
#[derive(Clone, Copy, Debug)]
pub struct Decoded {
    /// Which output it is.
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
}

#[cfg(test)]
mod tests {
    use super::*;

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
