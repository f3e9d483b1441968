//! A linear layer with an activation, and the mean over particles: mean of f(x W + b), without storing the values in between.
//!
//! A fused form: a linear layer, then the mean, then the layer's gradient by its weights take 17 times as long (64 outputs of 80,000
//! particles, one thread).
//!
//! The pass that computes the means also sums what the gradients by weights and bias need. The gradient by the features
//! recomputes the activations, which is faster than reading them from memory.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::activation::{Activate, Elu, Relu, Sigmoid, Tanh};
use crate::checkpoint::Activation;

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

/// The means, and what the gradients by weights and bias need: every particle of a window gets the same gradient g from the
/// mean, so that the one by W is g times the sum over particles of f'(x W + b) x, which does not depend on g.
#[derive(Clone, Debug)]
pub struct Means {
    /// `[B, E]`.
    pub means: Vec<f32>,
    /// Sums over particles of slopes times features, and of slopes, `[B, F + 1, P]`.
    pub slopes: Vec<f32>,
}

impl<const F: usize> Encoder<'_, F> {
    /// The means over the particles `points`, `[B N, F]`, with the sums for the gradients: one pass, and one exponential for
    /// both.
    pub fn forward(&self, activation: Activation, points: &[f32]) -> Means {
        // One loop for each function.
        match activation {
            Activation::Sigmoid => self.forward_with(Sigmoid, points),
            Activation::Tanh => self.forward_with(Tanh, points),
            Activation::Relu => self.forward_with(Relu, points),
            Activation::Elu => self.forward_with(Elu, points),
        }
    }

    fn forward_with<A: Activate>(&self, activation: A, points: &[f32]) -> Means {
        let padded = Padded::new(self);
        let outputs = self.bias.len();
        let (points, _) = points.as_chunks::<F>();
        let windows = points.len() / self.particles;
        let mut means = vec![0.0; windows * outputs];
        let mut slopes = vec![0.0; windows * padded.values.len()];
        means
            .par_chunks_exact_mut(outputs)
            .zip(slopes.par_chunks_exact_mut(padded.values.len()))
            .zip(points.par_chunks_exact(self.particles))
            .for_each(|((means, slopes), points)| {
                let mut sums = vec![0.0; padded.width];
                let layer = &padded;
                let sums = sums.as_mut_slice();
                Arch::new().dispatch(Forward { activation, layer, points, sums, slopes });
                let share = 1.0 / points.len() as f32;
                for (mean, sum) in means.iter_mut().zip(sums) {
                    *mean = share * *sum;
                }
            });
        Means { means, slopes }
    }

    /// The gradients from `gradient`, that by the means, `[B, E]`, with the `slopes` of the forward pass.
    pub fn backward(
        &self,
        activation: Activation,
        points: &[f32],
        slopes: &[f32],
        gradient: &[f32],
        by_points: bool,
    ) -> Gradients {
        let outputs = self.bias.len();
        let width = outputs.next_multiple_of(PACK);
        let share = 1.0 / self.particles as f32;
        let mut sums = vec![0.0; (F + 1) * width];
        // In the order of the windows: any number of threads gives the same bits.
        for (slopes, gradient) in
            slopes.chunks_exact((F + 1) * width).zip(gradient.chunks_exact(outputs))
        {
            let mut above = vec![0.0; width];
            for (above, gradient) in above.iter_mut().zip(gradient) {
                *above = share * gradient;
            }
            for (sums, slopes) in sums.chunks_exact_mut(width).zip(slopes.chunks_exact(width)) {
                for ((sum, slope), above) in sums.iter_mut().zip(slopes).zip(&above) {
                    *sum += slope * above;
                }
            }
        }
        let mut rows = sums.chunks_exact(width).map(|row| &row[..outputs]);
        let weight = rows.by_ref().take(F).flatten().copied().collect();
        let bias = rows.flatten().copied().collect();
        let points =
            if by_points { self.by_points(activation, points, gradient) } else { Vec::new() };
        Gradients { points, weight, bias }
    }

    /// The gradient by the features, `[B N, F]`, which computes the slopes again.
    fn by_points(&self, activation: Activation, points: &[f32], gradient: &[f32]) -> Vec<f32> {
        match activation {
            Activation::Sigmoid => self.by_points_with(Sigmoid, points, gradient),
            Activation::Tanh => self.by_points_with(Tanh, points, gradient),
            Activation::Relu => self.by_points_with(Relu, points, gradient),
            Activation::Elu => self.by_points_with(Elu, points, gradient),
        }
    }

    fn by_points_with<A: Activate>(
        &self,
        activation: A,
        points: &[f32],
        gradient: &[f32],
    ) -> Vec<f32> {
        let padded = Padded::new(self);
        let (points, _) = points.as_chunks::<F>();
        let mut moved = vec![[0.0; F]; points.len()];
        moved
            .par_chunks_exact_mut(self.particles)
            .zip(points.par_chunks_exact(self.particles))
            .zip(gradient.par_chunks_exact(self.bias.len()))
            .for_each(|((moved, points), gradient)| {
                let share = 1.0 / points.len() as f32;
                let mut above = vec![0.0; padded.width];
                for (above, gradient) in above.iter_mut().zip(gradient) {
                    *above = share * gradient;
                }
                let (layer, above) = (&padded, above.as_slice());
                Arch::new().dispatch(BackwardPoints { activation, layer, points, above, moved });
            });
        moved.into_flattened()
    }
}

/// Sums over the particles of a window.
struct Forward<'a, A, const F: usize> {
    activation: A,
    layer: &'a Padded,
    points: &'a [[f32; F]],
    /// Of activations, `[P]`.
    sums: &'a mut [f32],
    /// Of slopes times features, and of slopes, `[F + 1, P]`.
    slopes: &'a mut [f32],
}

impl<A: Activate, const F: usize> WithSimd for Forward<'_, A, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { activation, layer, points, sums, slopes } = self;
        let (rows, _) = S::as_simd_f32s(&layer.values);
        let (sums, _) = S::as_mut_simd_f32s(sums);
        let (slopes, _) = S::as_mut_simd_f32s(slopes);
        let width = layer.width / S::F32_LANES;
        for (column, sum) in sums.iter_mut().enumerate() {
            let mut weight = [rows[column]; F];
            for f in 0..F {
                weight[f] = rows[f * width + column];
            }
            let bias = rows[F * width + column];
            let zero = simd.splat_f32s(0.0);
            let (mut values, mut by_weight, mut by_bias) = (zero, [zero; F], zero);
            for point in points {
                let mut x = bias;
                for f in 0..F {
                    x = simd.mul_add_e_f32s(simd.splat_f32s(point[f]), weight[f], x);
                }
                let value = activation.value(simd, x);
                let slope = activation.slope(simd, x, value);
                values = simd.add_f32s(values, value);
                for f in 0..F {
                    by_weight[f] =
                        simd.mul_add_e_f32s(simd.splat_f32s(point[f]), slope, by_weight[f]);
                }
                by_bias = simd.add_f32s(by_bias, slope);
            }
            *sum = values;
            for f in 0..F {
                slopes[f * width + column] = by_weight[f];
            }
            slopes[F * width + column] = by_bias;
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Means and gradients in double precision, written as in a textbook. `of` is the activation with its slope.
    fn reference<const F: usize>(
        layer: &Encoder<F>,
        of: &dyn Fn(f64) -> [f64; 2],
        points: &[f32],
        gradient: &[f32],
    ) -> [Vec<f64>; 4] {
        let (outputs, share) = (layer.bias.len(), 1.0 / layer.particles as f64);
        let mut means = vec![0.0; gradient.len()];
        let (mut by_points, mut by_weight) = (vec![0.0; points.len()], vec![0.0; F * outputs]);
        let mut by_bias = vec![0.0; outputs];
        for (number, point) in points.chunks_exact(F).enumerate() {
            let window = number / layer.particles;
            for output in 0..outputs {
                let weight = |f: usize| f64::from(layer.weight[f * outputs + output]);
                let products = (0..F).map(|f| f64::from(point[f]) * weight(f));
                let [value, slope] = of(products.sum::<f64>() + f64::from(layer.bias[output]));
                means[window * outputs + output] += share * value;
                let by_x = share * f64::from(gradient[window * outputs + output]) * slope;
                for f in 0..F {
                    by_points[number * F + f] += by_x * weight(f);
                    by_weight[f * outputs + output] += by_x * f64::from(point[f]);
                }
                by_bias[output] += by_x;
            }
        }
        [means, by_points, by_weight, by_bias]
    }

    fn check<const F: usize>(
        activation: Activation,
        of: &dyn Fn(f64) -> [f64; 2],
        [windows, particles, outputs]: [usize; 3],
        numbers: &mut dyn Iterator<Item = f32>,
    ) -> Result<(), TestCaseError> {
        let mut take = |count: usize| numbers.take(count).collect::<Vec<f32>>();
        let (weight, bias) = (take(F * outputs), take(outputs));
        let (points, gradient) = (take(windows * particles * F), take(windows * outputs));
        let layer = Encoder::<F> { weight: &weight, bias: &bias, particles };
        let Means { means, slopes } = layer.forward(activation, &points);
        let found = layer.backward(activation, &points, &slopes, &gradient, true);
        let without = layer.backward(activation, &points, &slopes, &gradient, false);
        prop_assert!(without.points.is_empty());
        prop_assert_eq!((&without.weight, &without.bias), (&found.weight, &found.bias));
        let found = [means, found.points, found.weight, found.bias];
        for (found, expected) in found.iter().zip(reference(&layer, of, &points, &gradient)) {
            prop_assert_eq!(found.len(), expected.len());
            let largest = expected.iter().fold(1e-3f64, |largest, x| largest.max(x.abs()));
            for (&found, expected) in found.iter().zip(expected) {
                let apart = (f64::from(found) - expected).abs();
                prop_assert!(apart < 5e-6 * largest, "found {found}, expected {expected}");
            }
        }
        Ok(())
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        #[test]
        fn means_and_gradients_are_those_of_double_precision(
            sizes in (1usize..4, 1usize..60, 1usize..70).prop_map(|(b, n, e)| [b, n, e]),
            seed in any::<u64>(),
        ) {
            let mut state = seed;
            let mut numbers = std::iter::from_fn(|| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                Some((state >> 40) as f32 / (1u64 << 23) as f32 - 1.0)
            });
            let elu = |x: f64| if x > 0.0 { [x, 1.0] } else { [x.exp() - 1.0, x.exp()] };
            let relu = |x: f64| if x > 0.0 { [x, 1.0] } else { [0.0, 0.0] };
            let tanh = |x: f64| [x.tanh(), 1.0 - x.tanh().powi(2)];
            let sigmoid = |x: f64| {
                let y = 1.0 / (1.0 + (-x).exp());
                [y, y * (1.0 - y)]
            };
            check::<5>(Activation::Elu, &elu, sizes, &mut numbers)?;
            check::<8>(Activation::Elu, &elu, sizes, &mut numbers)?;
            check::<8>(Activation::Relu, &relu, sizes, &mut numbers)?;
            check::<5>(Activation::Tanh, &tanh, sizes, &mut numbers)?;
            check::<8>(Activation::Sigmoid, &sigmoid, sizes, &mut numbers)?;
        }
    }
}
