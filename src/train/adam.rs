//! Adam (Kingma and Ba 2015), one pass over the numbers of a tensor.

use rayon::prelude::*;

use super::OptimizerConfig;

/// Numbers that a thread takes at once.
const CHUNK: usize = 1 << 16;

/// Decay of the mean of gradients.
const BETA_1: f32 = 0.9;
/// Decay of the mean of squared gradients.
const BETA_2: f32 = 0.999;

/// What is remembered of the gradients of each tensor.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Adam {
    /// Steps done.
    pub(super) steps: u32,
    /// By the tensor's number; empty before its first step.
    pub(super) moments: Vec<Moments>,
}

/// Running means of a tensor's gradient, number by number.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Moments {
    /// Of the gradient.
    pub(super) first: Vec<f32>,
    /// Of its square.
    pub(super) second: Vec<f32>,
}

/// One step for all tensors.
pub(super) struct AdamStep<'a> {
    adam: &'a mut Adam,
    /// Learning rate, corrected for the first moment's start from zero.
    rate: f32,
    /// Square root of the second moment's correction.
    correction: f32,
    epsilon: f32,
    clip: f32,
    /// Sum of the squared norms of the gradients so far.
    squares: f64,
}

impl Adam {
    /// Begins a step.
    pub(super) fn step(&mut self, rate: f64, config: &OptimizerConfig) -> AdamStep<'_> {
        self.steps += 1;
        let steps = i32::try_from(self.steps).unwrap_or(i32::MAX);
        AdamStep {
            adam: self,
            rate: (rate / (1.0 - f64::from(BETA_1).powi(steps))) as f32,
            correction: (1.0 - f64::from(BETA_2).powi(steps)).sqrt() as f32,
            epsilon: config.epsilon,
            clip: config.clip,
            squares: 0.0,
        }
    }
}

impl AdamStep<'_> {
    /// Changes one tensor. A gradient whose norm is above the limit is shortened to it.
    pub(super) fn change(&mut self, tensor: usize, values: &mut [f32], gradient: &[f32]) {
        let Self { rate, correction, epsilon, .. } = *self;
        let moments = &mut self.adam.moments;
        if moments.len() <= tensor {
            moments.resize_with(tensor + 1, Moments::default);
        }
        let Moments { first, second } = &mut moments[tensor];
        first.resize(values.len(), 0.0);
        second.resize(values.len(), 0.0);
        let norm = norm(gradient);
        self.squares += f64::from(norm) * f64::from(norm);
        let shorter = if self.clip.is_finite() { (self.clip / norm).min(1.0) } else { 1.0 };
        values
            .par_chunks_mut(CHUNK)
            .zip(gradient.par_chunks(CHUNK))
            .zip(first.par_chunks_mut(CHUNK).zip(second.par_chunks_mut(CHUNK)))
            .for_each(|((values, gradient), (first, second))| {
                let moments = first.iter_mut().zip(second);
                for ((x, g), (m, v)) in values.iter_mut().zip(gradient).zip(moments) {
                    let g = g * shorter;
                    *m += (1.0 - BETA_1) * (g - *m);
                    *v = BETA_2 * *v + (1.0 - BETA_2) * (g * g);
                    *x -= rate * *m / (v.sqrt() / correction + epsilon);
                }
            });
    }

    /// Norm of the gradient by all tensors changed so far, before any was shortened.
    pub(super) fn gradient_norm(&self) -> f64 {
        self.squares.sqrt()
    }
}

/// Euclidean norm. Summed chunk by chunk in a fixed order, so that the number of threads does not
/// matter.
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
