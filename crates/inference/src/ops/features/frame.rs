//! The frame model's input features: x, y, vx, vy, normalised by minimum and maximum of the training split (the paper's eq. 1) or by
//! mean and standard deviation, and the material, one-hot or as one number.

use crate::checkpoint::{
    Description, FeatureScaling, MaterialInput, Normalization, layout::frame_features,
};

/// Features that change from frame to frame: x, y, vx, vy.
pub(crate) const STATE: usize = 4;

/// The scales of the features.
#[derive(Clone, Copy, Debug)]
pub struct FrameFeatures {
    /// Subtracted from x, y, vx, vy.
    origin: [f32; STATE],
    /// Divisor of the difference.
    range: [f32; STATE],
    material: MaterialInput,
    /// Materials that there are inputs for.
    materials: usize,
    /// F.
    count: usize,
}

impl FrameFeatures {
    /// Of the described network.
    pub fn new(description: &Description) -> Self {
        let Normalization { minimum, maximum, mean, standard_deviation, .. } =
            description.normalization;
        let (origin, range) = match description.frame.scaling {
            FeatureScaling::MinMax => {
                (minimum, std::array::from_fn(|axis| maximum[axis] - minimum[axis]))
            }
            FeatureScaling::ZScore => (mean, standard_deviation),
        };
        Self {
            origin,
            range,
            material: description.frame.material,
            materials: description.material_inputs,
            count: frame_features(description),
        }
    }

    /// x, y, vx, vy of a particle, scaled.
    #[inline(always)]
    pub(crate) fn state(&self, [x, y]: [f32; 2], [vx, vy]: [f32; 2]) -> [f32; STATE] {
        let state = [x, y, vx, vy];
        std::array::from_fn(
            #[inline(always)]
            |feature| (state[feature] - self.origin[feature]) / self.range[feature],
        )
    }

    /// The number of a material that is one feature.
    pub(crate) fn number(&self, material: u8) -> f32 {
        f32::from(material) / (self.materials - 1) as f32
    }

    /// The features of all particles of T frames, `[T R, F]`, from positions and velocities, `[T R]`, and the numbers of their
    /// materials, `[R]`.
    pub fn forward(
        &self,
        position: &[[f32; 2]],
        velocity: &[[f32; 2]],
        material: &[u8],
    ) -> Vec<f32> {
        let count = self.count;
        let mut features = vec![0.0; position.len() * count];
        let bodies = position.iter().zip(velocity).zip(material.iter().cycle());
        for (row, ((x, v), &material)) in features.chunks_exact_mut(count).zip(bodies) {
            row[..STATE].copy_from_slice(&self.state(*x, *v));
            match self.material {
                MaterialInput::OneHot => row[STATE + usize::from(material)] = 1.0,
                MaterialInput::Scalar => row[STATE] = self.number(material),
            }
        }
        features
    }

    /// The gradients by positions and velocities from `gradient`, that by the features, `[T R, F]`.
    pub fn backward(&self, gradient: &[f32]) -> [Vec<[f32; 2]>; 2] {
        [0, 2].map(|first| {
            let rows = gradient.chunks_exact(self.count);
            rows.map(|by| [first, first + 1].map(|axis| by[axis] / self.range[axis])).collect()
        })
    }
}
