//! The frame model's pointwise encoder: the first Linear and the activation, for every particle.
//!
//! A fused form, as [`kernels::encoder`](crate::kernels::encoder) for training: nothing of the shape `[N, E]` is ever stored. The mean is accumulated as the points are computed, a panel of units at a
//! time. The maximum needs the second Linear first, which processes points in blocks.

use std::collections::BTreeMap;

use pulp::Simd;

use crate::{
    checkpoint::{Activation, Description, MaterialInput, Weights, layout},
    kernels::activation::Activate,
    ops::{
        features::{FrameFeatures, STATE},
        linear::packed::{Aligned, Linear, add_products, outputs},
    },
};
use eddy_frames::Particles;

/// Independent partial sums: point n is added to sum n mod 4.
const PARTIAL_SUMS: usize = 4;

/// Points per block of the second Linear.
pub(super) const BLOCK: usize = 48;

/// The first Linear of the encoder, the features' scales and the activation.
#[derive(Debug)]
pub(super) struct Encoder {
    lanes: usize,
    width: usize,
    activation: Activation,
    features: FrameFeatures,
    /// Weights of x, y, vx, vy, `[panel, feature, lane]`.
    weight: Aligned,
    /// Bias plus the material's contribution, `[material, panel, lane]`.
    base: Aligned,
}

impl Encoder {
    /// Packs the encoder of a described frame model.
    pub(super) fn pack(
        lanes: usize,
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
    ) -> Self {
        let Description { sizes, frame, .. } = description;
        let [weights, biases] = layout::names("encoder.0").map(|name| &tensors[&name].values);
        let count = layout::frame_features(description);
        let features = FrameFeatures::new(description);
        let panels = sizes.encoder.div_ceil(lanes);
        let mut weight = Aligned::zeros(panels * STATE * lanes);
        let mut base = Aligned::zeros(description.material_inputs * panels * lanes);
        for (unit, row) in weights.chunks_exact(count).enumerate() {
            let (panel, lane) = (unit / lanes, unit % lanes);
            for (feature, number) in row[..STATE].iter().enumerate() {
                weight.get_mut()[(panel * STATE + feature) * lanes + lane] = *number;
            }
            for number in 0..description.material_inputs {
                let part = match frame.material {
                    MaterialInput::OneHot => row[STATE + number],
                    MaterialInput::Scalar => row[STATE] * features.number(number as u8),
                };
                let at = (number * panels + panel) * lanes + lane;
                base.get_mut()[at] = biases[unit] + part;
            }
        }
        let (activation, width) = (frame.activation, sizes.encoder);
        Self { lanes, width, activation, features, weight, base }
    }

    /// Number of panels.
    pub(super) fn panels(&self) -> usize {
        self.width.div_ceil(self.lanes)
    }

    /// E.
    pub(super) fn width(&self) -> usize {
        self.width
    }

    /// Writes x, y, vx, vy of every particle, scaled, to `features`.
    pub(super) fn scale(&self, particles: Particles<'_>, features: &mut [[f32; STATE]]) {
        for (particle, scaled) in features.iter_mut().enumerate() {
            let (position, velocity) = particles.motion(particle);
            *scaled = self.features.state(position, velocity);
        }
    }

    /// The mean of a panel of units over all particles.
    #[inline(always)]
    pub(super) fn mean<S: Simd>(
        &self,
        simd: S,
        panel: usize,
        features: &[[f32; STATE]],
        material: &[u8],
    ) -> S::f32s {
        let units = Panel::new(simd, self, panel);
        let mut sums = [simd.splat_f32s(0.0); PARTIAL_SUMS];
        let (groups, rest) = features.as_chunks::<PARTIAL_SUMS>();
        let (materials, rest_materials) = material.as_chunks::<PARTIAL_SUMS>();
        for (group, materials) in groups.iter().zip(materials) {
            for n in 0..PARTIAL_SUMS {
                let point = units.point(simd, &group[n], materials[n]);
                sums[n] = simd.add_f32s(sums[n], point);
            }
        }
        for (n, (state, material)) in rest.iter().zip(rest_materials).enumerate() {
            let point = units.point(simd, state, *material);
            sums[n] = simd.add_f32s(sums[n], point);
        }
        let [a, b, c, d] = sums;
        let sum = simd.add_f32s(simd.add_f32s(a, b), simd.add_f32s(c, d));
        simd.div_f32s(sum, simd.splat_f32s(features.len() as f32))
    }

    /// All units of a block of at most [`BLOCK`] particles, into `points`, `[BLOCK, E]`.
    #[inline(always)]
    fn block<S: Simd>(
        &self,
        simd: S,
        features: &[[f32; STATE]],
        material: &[u8],
        points: &mut [f32],
    ) {
        for panel in 0..self.panels() {
            let units = Panel::new(simd, self, panel);
            let range = outputs(panel, self.lanes, self.width);
            let rows = points.chunks_exact_mut(self.width);
            for (row, (state, material)) in rows.zip(features.iter().zip(material)) {
                let point = units.point(simd, state, *material);
                simd.partial_store_f32s(&mut row[range.clone()], point);
            }
        }
    }

    /// Raises `maxima`, `[H]`, to the second Linear's outputs for a block of at most [`BLOCK`] particles. `points` is a
    /// scratch buffer, `[BLOCK, E]`.
    #[inline(always)]
    pub(super) fn update_maxima<S: Simd>(
        &self,
        simd: S,
        second: &Linear,
        features: &[[f32; STATE]],
        material: &[u8],
        points: &mut [f32],
        maxima: &mut [f32],
    ) {
        self.block(simd, features, material, points);
        if const { S::REGISTER_COUNT >= 32 } {
            self.update_maxima_rows::<S, 6>(simd, second, features.len(), points, maxima);
        } else {
            self.update_maxima_rows::<S, 3>(simd, second, features.len(), points, maxima);
        }
    }

    #[inline(always)]
    fn update_maxima_rows<S: Simd, const R: usize>(
        &self,
        simd: S,
        second: &Linear,
        count: usize,
        points: &[f32],
        maxima: &mut [f32],
    ) {
        // Two panels at a time; the last one is repeated if their number is odd.
        for pair in (0..second.panels()).step_by(2) {
            let panels = [pair, (pair + 1).min(second.panels() - 1)];
            let weights = panels.map(|panel| second.panel(panel));
            let mut largest =
                panels.map(|panel| simd.partial_load_f32s(&maxima[second.outputs(panel)]));
            let biases =
                [second.bias::<S, R>(simd, panels[0]), second.bias::<S, R>(simd, panels[1])];
            for first in (0..count).step_by(R) {
                // The last particle is repeated to fill the block.
                let rows: [&[f32]; R] = std::array::from_fn(|r| {
                    let particle = (first + r).min(count - 1);
                    &points[particle * self.width..(particle + 1) * self.width]
                });
                let sums = add_products::<S, 2, R, 1>(simd, weights, rows, biases);
                for g in 0..2 {
                    for sum in sums[g] {
                        let larger = simd.greater_than_f32s(sum, largest[g]);
                        largest[g] = simd.select_f32s(larger, sum, largest[g]);
                    }
                }
            }
            for g in 0..2 {
                simd.partial_store_f32s(&mut maxima[second.outputs(panels[g])], largest[g]);
            }
        }
    }
}

/// A panel of units, its weights in registers.
struct Panel<'a, S: Simd> {
    activation: Activation,
    weights: [S::f32s; STATE],
    /// Bias and material, one material every `stride` vectors.
    base: &'a [S::f32s],
    stride: usize,
}

impl<'a, S: Simd> Panel<'a, S> {
    #[inline(always)]
    fn new(simd: S, encoder: &'a Encoder, panel: usize) -> Self {
        let mut weights = [simd.splat_f32s(0.0); STATE];
        let packed = S::as_simd_f32s(encoder.weight.get()).0;
        weights.copy_from_slice(&packed[panel * STATE..(panel + 1) * STATE]);
        let base = &S::as_simd_f32s(encoder.base.get()).0[panel..];
        Self { activation: encoder.activation, weights, base, stride: encoder.panels() }
    }

    /// The units at one particle.
    #[inline(always)]
    fn point(&self, simd: S, state: &[f32; STATE], material: u8) -> S::f32s {
        let mut sum = self.base[usize::from(material) * self.stride];
        for (weight, number) in self.weights.iter().zip(state) {
            sum = simd.mul_add_e_f32s(*weight, simd.splat_f32s(*number), sum);
        }
        self.activation.value(simd, sum)
    }
}
