//! The networks' input features over tensors: the definition of `ops::features` of `eddy-inference`, which lists them.

use burn::tensor::{Device, Tensor};

use super::ballistic::BallisticTensors;
use eddy_inference::{
    checkpoint::{FeatureScaling, FrameOptions, MaterialInput, Normalization},
    engine::scales::{BODY_SCALE, CONTACT_SCALE, velocity_unit},
};

/// The number of each material that is one feature, `[M, 1]`.
fn material_numbers(materials: usize, device: &Device) -> Tensor<2> {
    let largest = (materials - 1) as f32;
    let numbers: Vec<f32> = (0..materials).map(|material| material as f32 / largest).collect();
    Tensor::<1>::from_floats(numbers.as_slice(), device).reshape([materials, 1])
}

/// The normalisation of both networks, as tensors.
#[derive(Clone, Debug)]
pub(crate) struct Scaling {
    /// Smallest x, y, vx, vy, `[1, 4]`.
    minimum: Tensor<2>,
    /// Largest minus smallest, `[1, 4]`.
    range: Tensor<2>,
    /// Mean x, y, vx, vy, `[1, 4]`.
    mean: Tensor<2>,
    /// Their standard deviations, `[1, 4]`.
    deviation: Tensor<2>,
    /// [`velocity_unit`].
    velocity_unit: f32,
}

impl Scaling {
    pub(crate) fn new(scale: &Normalization, device: &Device) -> Self {
        let row = |values: &[f32]| Tensor::<1>::from_floats(values, device).unsqueeze::<2>();
        let range: Vec<f32> =
            scale.maximum.iter().zip(&scale.minimum).map(|(high, low)| high - low).collect();
        Self {
            minimum: row(&scale.minimum),
            range: row(&range),
            mean: row(&scale.mean),
            deviation: row(&scale.standard_deviation),
            velocity_unit: velocity_unit(scale),
        }
    }

    /// Positions (domain lengths) from standard deviations off the mean, `[R, 2]`.
    pub(crate) fn position(&self, scaled: Tensor<2>) -> Tensor<2> {
        let [mean, deviation] =
            [&self.mean, &self.deviation].map(|t| t.clone().slice([0..1, 0..2]));
        mean + scaled * deviation
    }

    /// Input of the frame model, `[R, F]`. `material` is one-hot, `[R, M]`.
    pub(crate) fn frame(
        &self,
        options: &FrameOptions,
        [position, velocity]: [Tensor<2>; 2],
        material: Tensor<2>,
    ) -> Tensor<2> {
        let state = Tensor::cat(vec![position, velocity], 1);
        let state = match options.scaling {
            FeatureScaling::MinMax => (state - self.minimum.clone()) / self.range.clone(),
            FeatureScaling::ZScore => (state - self.mean.clone()) / self.deviation.clone(),
        };
        let material = match options.material {
            MaterialInput::OneHot => material,
            MaterialInput::Scalar => {
                let [_, materials] = material.dims();
                material.matmul(material_numbers(materials, &state.device()))
            }
        };
        Tensor::cat(vec![state, material], 1)
    }

    /// Input of the particle model, `[R, F]`. `expected` are the velocities that the ballistic step expected of the frame, `[R, 2]`;
    /// `shape` is `[R, 5]`, `constants` `[R, 4]` or `[R, 5]`.
    pub(crate) fn particle(
        &self,
        [position, velocity, expected]: [Tensor<2>; 3],
        ballistic: &BallisticTensors,
        shape: Tensor<2>,
        constants: Tensor<2>,
    ) -> Tensor<2> {
        let motion = ballistic.step(position.clone(), velocity.clone());
        let below = (position.clone() - ballistic.lower.clone()).clamp_min(0.0);
        let above = (ballistic.upper.clone() - position).clamp_min(0.0);
        let distance = Tensor::cat(vec![below, above], 1); // [R, 4]
        let velocities = vec![velocity.clone(), velocity - expected, motion.wall_impulse];
        Tensor::cat(
            vec![
                Tensor::cat(velocities, 1).div_scalar(self.velocity_unit),
                distance.clone().mul_scalar(-1.0 / CONTACT_SCALE).exp(),
                distance.mul_scalar(-1.0 / BODY_SCALE).exp(),
                shape,
                constants,
            ],
            1,
        )
    }
}
