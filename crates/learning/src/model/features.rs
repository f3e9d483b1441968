//! The networks' input features.
//!
//! Frame model: x, y, vx, vy, normalised by minimum and maximum of the training split (the paper's eq. 1) or by mean and
//! standard deviation, and the material, one-hot or as one number.
//!
//! Particle model ([`particle_features`]); pairs are along x and y:
//!
//! | inputs | feature |
//! |---|---|
//! | 2 | velocity, in units of u |
//! | 2 | velocity residual: velocity minus the one that the ballistic step expected one frame ago; 0 at first; likewise |
//! | 2 | wall impulse: velocity change at a wall in the coming ballistic step; likewise |
//! | 8 | proximity exp(-d / s) to the left, lower, right, upper wall at the scale s = [`CONTACT_SCALE`], then [`BODY_SCALE`] |
//! | 5 | shape of solids (`strain`): strain xx, yy, xy, bend along x and y |
//! | 4 | material, one-hot |
//! | 1 | stiffness of the stream, [`stiffness_feature`]; only of a network that is conditioned on it |
//!
//! The velocity residual distinguishes a particle that rests on others from one in free fall. No feature gives the position
//! in the domain, which may be larger than in training.
//!
//! [`particle_features`]: eddy_inference::checkpoint::layout::particle_features
//! [`stiffness_feature`]: eddy_inference::engine::scales::stiffness_feature

use burn::tensor::{Device, Tensor};

use super::{
    ballistic::{BallisticMotion, BallisticTensors},
    state::ParticleState,
};
use eddy_frames::Material;
use eddy_inference::{
    checkpoint::{FeatureScaling, FrameOptions, MaterialInput, Normalization},
    engine::scales::{BODY_SCALE, CONTACT_SCALE, velocity_unit},
};

/// Each material's number divided by the largest, `[4, 1]`.
fn material_numbers(device: &Device) -> Tensor<2> {
    let largest = (Material::COUNT - 1) as f32;
    let numbers = Material::ALL.map(|material| f32::from(material as u8) / largest);
    Tensor::<1>::from_floats(numbers, device).reshape([Material::COUNT, 1])
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
    pub(crate) velocity_unit: f32,
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

    /// Input of the frame model, `[R, F]`. `material` is one-hot, `[R, 4]`.
    pub(crate) fn frame(
        &self,
        options: &FrameOptions,
        state: &ParticleState,
        material: Tensor<2>,
    ) -> Tensor<2> {
        let state = Tensor::cat(vec![state.position.clone(), state.velocity.clone()], 1);
        let state = match options.scaling {
            FeatureScaling::MinMax => (state - self.minimum.clone()) / self.range.clone(),
            FeatureScaling::ZScore => (state - self.mean.clone()) / self.deviation.clone(),
        };
        let material = match options.material {
            MaterialInput::OneHot => material,
            MaterialInput::Scalar => material.matmul(material_numbers(&state.device())),
        };
        Tensor::cat(vec![state, material], 1)
    }

    /// Input of the particle model, `[R, F]`. `residual` is the velocity residual, `[R, 2]`, and `motion` the coming ballistic
    /// step; `shape` is `[R, 5]`, `constants` [`StaticInputs::constants`](super::state::StaticInputs::constants).
    pub(crate) fn particle(
        &self,
        state: &ParticleState,
        residual: Tensor<2>,
        motion: &BallisticMotion,
        walls: &BallisticTensors,
        shape: Tensor<2>,
        constants: Tensor<2>,
    ) -> Tensor<2> {
        let below = (state.position.clone() - walls.lower.clone()).clamp_min(0.0);
        let above = (walls.upper.clone() - state.position.clone()).clamp_min(0.0);
        let distance = Tensor::cat(vec![below, above], 1); // [R, 4]
        let velocities = vec![state.velocity.clone(), residual, motion.wall_impulse.clone()];
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
