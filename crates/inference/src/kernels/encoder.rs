//! A linear layer with an activation, and the mean over particles: mean of f(x W + b), without storing the values in between.
//!
//! The gradient recomputes the activations, which is faster than reading them from memory.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::activation::Activate;

/// Outputs per block: two of the longest vectors.
const PACK: usize = 32;

/// The layer, with F features and E outputs.
#[derive(Clone, Copy, Debug)]
pub struct Encoder<'a, const F: usize> {
    /// W, `[F, E]`.
    pub weight: &'a [f32],
    /// b, `[E]`.
    pub bias: &'a [f32],
    /// Number of particles to average over, N.
    pub particles: usize,
}

/// Gradients of the layer.
#[derive(Clone, Debug, Default)]
pub struct Gradients {
    /// By the features, `[B N, F]`; empty if not requested.
    pub points: Vec<f32>,
    /// By the weights, `[F, E]`.
    pub weight: Vec<f32>,
    /// By the bias, `[E]`.
    pub bias: Vec<f32>,
}

/// Weights and bias, zero-padded to whole packs of outputs: `[F + 1, P]`, bias last.
struct Padded {
    values: Vec<f32>,
    width: usize,
}

impl Padded {
    fn new<const F: usize>(layer: &Encoder<F>) -> Self {
        let outputs = layer.bias.len();
        let width = outputs.next_multiple_of(PACK);
        let mut values = vec![0.0; (F + 1) * width];
        let rows = layer.weight.chunks_exact(outputs).chain([layer.bias]);
        for (row, from) in values.chunks_exact_mut(width).zip(rows) {
            row[..outputs].copy_from_slice(from);
        }
        Self { values, width }
    }
}

impl<const F: usize> Encoder<'_, F> {
    /// The means, `[B, E]`, over the particles `points`, `[B N, F]`.
    pub fn forward<A: Activate>(&self, activation: A, points: &[f32]) -> Vec<f32> {
        let padded = Padded::new(self);
        let outputs = self.bias.len();
        let (points, _) = points.as_chunks::<F>();
        let mut means = vec![0.0; points.len() / self.particles * outputs];
        means.par_chunks_exact_mut(outputs).zip(points.par_chunks_exact(self.particles)).for_each(
            |(means, points)| {
                let mut sums = vec![0.0; padded.width];
                let layer = &padded;
                Arch::new().dispatch(Forward { activation, layer, points, sums: &mut sums });
                let share = 1.0 / points.len() as f32;
                for (mean, sum) in means.iter_mut().zip(&sums) {
                    *mean = share * sum;
                }
            },
        );
        means
    }

    /// The gradients from `gradient`, that by the means, `[B, E]`.
    pub fn backward<A: Activate>(
        &self,
        activation: A,
        points: &[f32],
        gradient: &[f32],
        by_points: bool,
    ) -> Gradients {
        let padded = Padded::new(self);
        let outputs = self.bias.len();
        let (points, _) = points.as_chunks::<F>();
        let windows = points.len() / self.particles;
        let size = padded.values.len();
        // A partial sum per window, added up in their order: any number of threads gives the same bits.
        let mut parts = vec![0.0; windows * size];
        let mut moved = vec![[0.0; F]; if by_points { points.len() } else { 0 }];
        let moved_parts: Vec<&mut [[f32; F]]> = if by_points {
            moved.chunks_exact_mut(self.particles).collect()
        } else {
            (0..windows).map(|_| [].as_mut_slice()).collect()
        };
        parts
            .par_chunks_exact_mut(size)
            .zip(points.par_chunks_exact(self.particles))
            .zip(gradient.par_chunks_exact(outputs))
            .zip(moved_parts)
            .for_each(|(((part, points), gradient), moved)| {
                let share = 1.0 / points.len() as f32;
                let mut above = vec![0.0; padded.width];
                for (above, gradient) in above.iter_mut().zip(gradient) {
                    *above = share * gradient;
                }
                let (layer, above) = (&padded, above.as_slice());
                Arch::new().dispatch(Backward { activation, layer, points, above, part });
                if by_points {
                    Arch::new().dispatch(BackwardPoints {
                        activation,
                        layer,
                        points,
                        above,
                        moved,
                    });
                }
            });
        let mut sums = vec![0.0; size];
        super::matrix::sum_rows(&parts, &mut sums);
        let mut rows = sums.chunks_exact(padded.width).map(|row| &row[..outputs]);
        let weight = rows.by_ref().take(F).flatten().copied().collect();
        let bias = rows.flatten().copied().collect();
        Gradients { points: moved.into_flattened(), weight, bias }
    }
}

/// Sums over the particles of a window.
struct Forward<'a, A, const F: usize> {
    activation: A,
    layer: &'a Padded,
    points: &'a [[f32; F]],
    sums: &'a mut [f32],
}

impl<A: Activate, const F: usize> WithSimd for Forward<'_, A, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { activation, layer, points, sums } = self;
        let (rows, _) = S::as_simd_f32s(&layer.values);
        let (sums, _) = S::as_mut_simd_f32s(sums);
        let width = layer.width / S::F32_LANES;
        // Two vectors at once, to hide the latency of their dependency chains.
        for (pair, sums) in sums.chunks_exact_mut(2).enumerate() {
            let column = 2 * pair;
            let mut weight = [[rows[column]; 2]; F];
            for f in 0..F {
                weight[f] = [rows[f * width + column], rows[f * width + column + 1]];
            }
            let bias = [rows[F * width + column], rows[F * width + column + 1]];
            let mut sum = [simd.splat_f32s(0.0); 2];
            for point in points {
                let mut x = bias;
                for f in 0..F {
                    let feature = simd.splat_f32s(point[f]);
                    x[0] = simd.mul_add_e_f32s(feature, weight[f][0], x[0]);
                    x[1] = simd.mul_add_e_f32s(feature, weight[f][1], x[1]);
                }
                sum[0] = simd.add_f32s(sum[0], activation.value(simd, x[0]));
                sum[1] = simd.add_f32s(sum[1], activation.value(simd, x[1]));
            }
            sums[0] = sum[0];
            sums[1] = sum[1];
        }
    }
}

/// Gradients by weights and bias from one window.
struct Backward<'a, A, const F: usize> {
    activation: A,
    layer: &'a Padded,
    points: &'a [[f32; F]],
    /// Gradient by each particle's outputs, `[P]`.
    above: &'a [f32],
    /// Gradient by weights and bias, `[F + 1, P]`.
    part: &'a mut [f32],
}

impl<A: Activate, const F: usize> WithSimd for Backward<'_, A, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { activation, layer, points, above, part } = self;
        let (rows, _) = S::as_simd_f32s(&layer.values);
        let (above, _) = S::as_simd_f32s(above);
        let (part, _) = S::as_mut_simd_f32s(part);
        let width = layer.width / S::F32_LANES;
        for (column, &above) in above.iter().enumerate() {
            let mut weight = [rows[column]; F];
            for f in 0..F {
                weight[f] = rows[f * width + column];
            }
            let bias = rows[F * width + column];
            let mut by_weight = [simd.splat_f32s(0.0); F];
            let mut by_bias = simd.splat_f32s(0.0);
            for point in points {
                let mut x = bias;
                for f in 0..F {
                    x = simd.mul_add_e_f32s(simd.splat_f32s(point[f]), weight[f], x);
                }
                let by_x =
                    simd.mul_f32s(above, activation.slope(simd, x, activation.value(simd, x)));
                for f in 0..F {
                    by_weight[f] =
                        simd.mul_add_e_f32s(simd.splat_f32s(point[f]), by_x, by_weight[f]);
                }
                by_bias = simd.add_f32s(by_bias, by_x);
            }
            for f in 0..F {
                part[f * width + column] = by_weight[f];
            }
            part[F * width + column] = by_bias;
        }
    }
}

/// Gradients by the features of one window.
struct BackwardPoints<'a, A, const F: usize> {
    activation: A,
    layer: &'a Padded,
    points: &'a [[f32; F]],
    above: &'a [f32],
    moved: &'a mut [[f32; F]],
}

impl<A: Activate, const F: usize> WithSimd for BackwardPoints<'_, A, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { activation, layer, points, above, moved } = self;
        let (rows, _) = S::as_simd_f32s(&layer.values);
        let (above, _) = S::as_simd_f32s(above);
        let width = above.len();
        for (point, moved) in points.iter().zip(moved) {
            let mut by_feature = [simd.splat_f32s(0.0); F];
            for (column, &above) in above.iter().enumerate() {
                let mut x = rows[F * width + column];
                for f in 0..F {
                    x = simd.mul_add_e_f32s(simd.splat_f32s(point[f]), rows[f * width + column], x);
                }
                let by_x =
                    simd.mul_f32s(above, activation.slope(simd, x, activation.value(simd, x)));
                for f in 0..F {
                    by_feature[f] =
                        simd.mul_add_e_f32s(by_x, rows[f * width + column], by_feature[f]);
                }
            }
            for f in 0..F {
                moved[f] = simd.reduce_sum_f32s(by_feature[f]);
            }
        }
    }
}
