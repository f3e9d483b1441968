//! Adam (Kingma and Ba 2015) in one pass over each tensor, Muon (`muon`) for the matrices of hidden layers where it is chosen, and
//! the running average of the weights (Polyak and Juditsky 1992) that is validated and saved instead of the weights.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::{OptimizerConfig, OptimizerKind, TrainConfig, muon};
use eddy_inference::{
    checkpoint::{Description, layout, plan::Plan},
    kernels::vectors::zip,
};

/// Values per task.
const CHUNK: usize = 1 << 16;

/// Decay of the first moment.
const BETA_1: f32 = 0.9;
/// Decay of the second moment.
const BETA_2: f32 = 0.999;

/// The state of the optimizer.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Optimizer {
    /// Number of steps.
    pub(super) steps: u32,
    /// Moments of each tensor; empty before its first step.
    pub(super) moments: Vec<Moments>,
    /// Rows and columns of each tensor that Muon changes; Adam changes the others, and those beyond the end.
    pub(super) matrices: Vec<Option<[usize; 2]>>,
}

/// Running means of a tensor.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Moments {
    /// First moment: of the gradient. Of Muon, the momentum.
    pub(super) first: Vec<f32>,
    /// Second moment: of the squared gradient. Of Muon, zeros.
    pub(super) second: Vec<f32>,
    /// Of the values; empty if weights are not averaged.
    pub(super) average: Vec<f32>,
}

/// The numbers that change from step to step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Correction {
    /// Learning rate with the bias correction of the first moment.
    pub(super) rate: f32,
    /// Square root of the bias correction of the second moment.
    pub(super) root: f32,
    /// Learning rate without that correction, for Muon.
    pub(super) plain_rate: f32,
    /// Decay of the average.
    pub(super) kept: f32,
}

impl Correction {
    /// Of step number `steps`, from 1.
    pub(super) fn new(steps: u32, rate: f64, config: &OptimizerConfig) -> Self {
        let power = i32::try_from(steps).unwrap_or(i32::MAX);
        Self {
            rate: (rate / (1.0 - f64::from(BETA_1).powi(power))) as f32,
            root: (1.0 - f64::from(BETA_2).powi(power)).sqrt() as f32,
            plain_rate: rate as f32,
            // A shorter average in the first steps, to forget the initial weights, at which it begins.
            kept: config.average.min((1.0 + power as f32) / (10.0 + power as f32)),
        }
    }
}

/// A step for all tensors.
pub(super) struct OptimizerStep<'a> {
    optimizer: &'a mut Optimizer,
    correction: Correction,
    epsilon: f32,
    clip: f32,
    /// Whether the weights are averaged.
    averaged: bool,
    /// Whether norms are computed even without clipping.
    measured: bool,
    /// Sum of the squared norms of the gradients so far.
    squares: f64,
}

impl Optimizer {
    /// The state before the first step.
    pub(super) fn new(config: &TrainConfig, description: &Description) -> Self {
        let muon = config.optimizer.kind == OptimizerKind::Muon;
        let layers = Plan::new(description).layers.into_iter();
        let tensors = layers.flat_map(|layer| {
            let hidden = muon && layout::is_hidden(&layer.weight);
            [hidden.then_some([layer.input, layer.output]), None]
        });
        let matrices = tensors.collect::<Vec<_>>();
        let knots = config.network.stiffness_knots.len().max(1);
        Self { matrices: matrices.repeat(knots), ..Self::default() }
    }

    /// The moments of the tensors that Adam changes.
    pub(super) fn moments_of_adam(&self) -> impl Iterator<Item = &Moments> {
        let moments = self.moments.iter().enumerate();
        moments.filter(|&(tensor, _)| self.matrix(tensor).is_none()).map(|(_, moments)| moments)
    }

    /// Rows and columns of a tensor that Muon changes.
    fn matrix(&self, tensor: usize) -> Option<[usize; 2]> {
        self.matrices.get(tensor).copied().flatten()
    }

    /// Starts a step.
    pub(super) fn step(&mut self, rate: f64, config: &OptimizerConfig) -> OptimizerStep<'_> {
        self.steps += 1;
        OptimizerStep {
            correction: Correction::new(self.steps, rate, config),
            optimizer: self,
            epsilon: config.epsilon,
            clip: config.clip,
            averaged: config.average > 0.0,
            measured: false,
            squares: 0.0,
        }
    }
}

impl OptimizerStep<'_> {
    /// Updates a tensor. A gradient whose norm exceeds the limit is clipped.
    pub(super) fn change(&mut self, tensor: usize, values: &mut [f32], gradient: &[f32]) {
        self.change_by_share(tensor, values, gradient, 1.0);
    }

    /// As [`Self::change`], by a share of the gradient, after it is clipped.
    pub(super) fn change_by_share(
        &mut self,
        tensor: usize,
        values: &mut [f32],
        gradient: &[f32],
        share: f32,
    ) {
        let matrix = self.optimizer.matrix(tensor);
        let moments = &mut self.optimizer.moments;
        if moments.len() <= tensor {
            moments.resize_with(tensor + 1, Moments::default);
        }
        let Moments { first, second, average } = &mut moments[tensor];
        if self.averaged && average.is_empty() {
            average.extend_from_slice(values);
        }
        first.resize(values.len(), 0.0);
        second.resize(values.len(), 0.0);
        let norm = if self.measured || self.clip.is_finite() { norm(gradient) } else { 0.0 };
        self.squares += f64::from(share) * f64::from(norm) * f64::from(norm);
        let scale = share * if self.clip.is_finite() { (self.clip / norm).min(1.0) } else { 1.0 };
        let Correction { rate, root, plain_rate, kept } = self.correction;
        if let Some(shape) = matrix {
            muon::change(shape, values, gradient, first, scale, plain_rate);
        } else {
            let constants = Constants { scale, rate, inverse: 1.0 / root, epsilon: self.epsilon };
            values
                .par_chunks_mut(CHUNK)
                .zip(gradient.par_chunks(CHUNK))
                .zip(first.par_chunks_mut(CHUNK).zip(second.par_chunks_mut(CHUNK)))
                .for_each(|((values, gradient), (first, second))| {
                    Arch::new().dispatch(Change { constants, values, gradient, first, second });
                });
        }
        if self.averaged {
            for (mean, value) in average.iter_mut().zip(values) {
                *mean = *value + kept * (*mean - *value);
            }
        }
    }

    /// The same step, with [`OptimizerStep::gradient_norm`] computed even without clipping.
    pub(super) fn measured(self) -> Self {
        Self { measured: true, ..self }
    }

    /// Norm of the gradient by all tensors updated so far, before clipping.
    pub(super) fn gradient_norm(&self) -> f64 {
        self.squares.sqrt()
    }
}

/// The constants of a step for a tensor.
#[derive(Clone, Copy)]
struct Constants {
    /// Factor of the gradient.
    scale: f32,
    rate: f32,
    /// Factor of the square root of the second moment.
    inverse: f32,
    epsilon: f32,
}

struct Change<'a> {
    constants: Constants,
    values: &'a mut [f32],
    gradient: &'a [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
}

impl WithSimd for Change<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Constants { scale, rate, inverse, epsilon } = self.constants;
        let [scale, rate, inverse, epsilon] =
            [scale, -rate, inverse, epsilon].map(|number| simd.splat_f32s(number));
        let (to_first, to_second) = (simd.splat_f32s(1.0 - BETA_1), simd.splat_f32s(1.0 - BETA_2));
        zip(
            simd,
            [self.gradient],
            [self.values, self.first, self.second],
            #[inline(always)]
            |[gradient], [value, first, second]| {
                let gradient = simd.mul_f32s(gradient, scale);
                let change = simd.sub_f32s(gradient, first);
                let first = simd.mul_add_e_f32s(to_first, change, first);
                let change = simd.sub_f32s(simd.mul_f32s(gradient, gradient), second);
                let second = simd.mul_add_e_f32s(to_second, change, second);
                let root = simd.sqrt_f32s(second);
                let direction = simd.div_f32s(first, simd.mul_add_e_f32s(root, inverse, epsilon));
                [simd.mul_add_e_f32s(rate, direction, value), first, second]
            },
        );
    }
}

/// Euclidean norm. Summed chunk by chunk in a fixed order, so that the number of threads does not
/// change the result.
fn norm(gradient: &[f32]) -> f32 {
    let sums: Vec<f64> = gradient
        .par_chunks(CHUNK)
        .map(|chunk| {
            let mut lanes = [0.0f32; 16];
            let (packs, rest) = chunk.as_chunks::<16>();
            for pack in packs {
                for (sum, g) in lanes.iter_mut().zip(pack) {
                    *sum += g * g;
                }
            }
            let rest: f32 = rest.iter().map(|g| g * g).sum();
            lanes.iter().map(|&sum| f64::from(sum)).sum::<f64>() + f64::from(rest)
        })
        .collect();
    sums.iter().sum::<f64>().sqrt() as f32
}
