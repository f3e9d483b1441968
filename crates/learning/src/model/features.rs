//! From frames to the numbers a network sees.
//!
//! Frame model: x, y, vx, vy scaled by the training split's smallest and largest values (the paper's
//! eq. 1) or its means and deviations, and the material, one-hot or as one number.
//!
//! Particle model ([`PARTICLE_FEATURES`]), per axis where there are two numbers:
//!
//! | numbers | feature |
//! |---|---|
//! | 2 | velocity, in units of u |
//! | 2 | push: velocity minus what the ballistic step foretold one frame ago; 0 at first; likewise |
//! | 2 | stop: velocity that the coming ballistic step loses at a wall; likewise |
//! | 8 | nearness exp(-d / s) of the left, lower, right, upper wall at the scales s of [`CONTACT_SCALE`], then of [`BODY_SCALE`] |
//! | 5 | shape of solids (`strain`): strain xx, yy, xy, bend along x and y |
//! | 4 | material, one-hot |
//!
//! The push tells a particle at rest on others from one in free fall: it sees what the others just did.
//! No feature says where a particle is in the domain, which may be larger than the one trained in.

use burn::tensor::{Device, Tensor};

use super::{Bodies, ballistic::BallisticTensors, ballistic::Fallen};
use eddy_frames::Material;
use eddy_inference::{
    checkpoint::{
        FeatureScaling, FrameOptions, MaterialInput, Normalization, layout::PARTICLE_FEATURES,
    },
    engine::scales::{BODY_SCALE, CONTACT_SCALE, velocity_unit},
};

/// Materials one-hot, `[R, 4]`.
pub(crate) fn one_hot(material: &[Material]) -> Vec<f32> {
    let row =
        |&material: &Material| Material::ALL.map(|kind| f32::from(u8::from(kind == material)));
    material.iter().flat_map(row).collect()
}

/// Each material's number divided by the largest, `[4, 1]`.
fn material_numbers(device: &Device) -> Tensor<2> {
    let largest = (Material::COUNT - 1) as f32;
    let numbers = Material::ALL.map(|material| f32::from(material as u8) / largest);
    Tensor::<1>::from_floats(numbers, device).reshape([Material::COUNT, 1])
}

/// Feature scaling for both networks, as tensors.
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

    /// Input of the frame model, `[R, F]`. `material` is one-hot, `[R, 4]`.
    pub(crate) fn frame(
        &self,
        options: &FrameOptions,
        bodies: &Bodies,
        material: Tensor<2>,
    ) -> Tensor<2> {
        let state = Tensor::cat(vec![bodies.position.clone(), bodies.velocity.clone()], 1);
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

    /// Input of the particle model, `[R, F]`. `push` and the ballistic step `fallen` are `[R, 2]`,
    /// `shape` is `[R, 5]`.
    pub(crate) fn particle(
        &self,
        bodies: &Bodies,
        push: Tensor<2>,
        fallen: &Fallen,
        walls: &BallisticTensors,
        shape: Tensor<2>,
        material: Tensor<2>,
    ) -> Tensor<2> {
        let below = (bodies.position.clone() - walls.lower.clone()).clamp_min(0.0);
        let above = (walls.upper.clone() - bodies.position.clone()).clamp_min(0.0);
        let distance = Tensor::cat(vec![below, above], 1); // [R, 4]
        let velocities = vec![bodies.velocity.clone(), push, fallen.stopped.clone()];
        let features = Tensor::cat(
            vec![
                Tensor::cat(velocities, 1).div_scalar(self.velocity_unit),
                distance.clone().mul_scalar(-1.0 / CONTACT_SCALE).exp(),
                distance.mul_scalar(-1.0 / BODY_SCALE).exp(),
                shape,
                material,
            ],
            1,
        );
        debug_assert_eq!(features.dims()[1], PARTICLE_FEATURES);
        features
    }
}
