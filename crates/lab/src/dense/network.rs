//! The network on the processor, with Adam (Kingma and Ba 2015) without clipping.

use eddy_inference::{checkpoint::Activation, ops::linear::Linear};

use super::trainer::{BETAS, Move};

/// Shares of a new gradient in the first and the second moment.
const SHARES: [f32; 2] = [(1.0 - BETAS[0]) as f32, (1.0 - BETAS[1]) as f32];

/// The network.
pub(super) struct Network {
    layers: Vec<Layer>,
    activation: Activation,
}

struct Layer {
    weight: Tensor,
    bias: Tensor,
}

/// Values with their moments.
struct Tensor {
    values: Vec<f32>,
    first: Vec<f32>,
    second: Vec<f32>,
}

impl Network {
    /// From the weights `[in, out]` and bias of each layer.
    pub(super) fn new(activation: Activation, weights: Vec<[Vec<f32>; 2]>) -> Self {
        let layer = |tensors: [Vec<f32>; 2]| {
            let [weight, bias] = tensors.map(Tensor::new);
            Layer { weight, bias }
        };
        Self { layers: weights.into_iter().map(layer).collect(), activation }
    }

    /// The mean squared error of predictions.
    pub(super) fn loss(&self, input: &[f32], truth: &[f32]) -> f64 {
        let signals = self.forward(input);
        super::error(signals.last().map_or(input, Vec::as_slice), truth)
    }

    /// A step on a batch, unless the error is not finite. Returns the mean squared error before it.
    pub(super) fn step(&mut self, input: &[f32], truth: &[f32], by: Move) -> f64 {
        let signals = self.forward(input);
        let Some(predicted) = signals.last() else { return f64::NAN };
        let loss = super::error(predicted, truth);
        if !loss.is_finite() {
            return loss;
        }
        let scale = 2.0 / truth.len() as f32;
        // By the output of the layer, [B, O].
        let mut gradient: Vec<f32> =
            predicted.iter().zip(truth).map(|(p, t)| scale * (p - t)).collect();
        for number in (0..self.layers.len()).rev() {
            let below = if number == 0 { input } else { &signals[number - 1] };
            let linear = self.layers[number].linear();
            let gradients = linear.backward(below, &signals[number], &gradient, number > 0, true);
            let layer = &mut self.layers[number];
            layer.weight.change(&gradients.weight, by);
            layer.bias.change(&gradients.bias, by);
            gradient = gradients.input;
            let slopes = below.iter().map(|&y| slope(self.activation, y));
            gradient.iter_mut().zip(slopes).for_each(|(gradient, slope)| *gradient *= slope);
        }
        loss
    }

    /// The outputs of all layers, `[B, O]` each.
    fn forward(&self, input: &[f32]) -> Vec<Vec<f32>> {
        let mut signals: Vec<Vec<f32>> = Vec::with_capacity(self.layers.len());
        let last = self.layers.len() - 1;
        for (number, layer) in self.layers.iter().enumerate() {
            let below = signals.last().map_or(input, Vec::as_slice);
            let mut signal = layer.linear().forward(below);
            if number < last {
                signal.iter_mut().for_each(|x| *x = activate(self.activation, *x));
            }
            signals.push(signal);
        }
        signals
    }
}

impl Layer {
    fn linear(&self) -> Linear<'_> {
        Linear { weight: &self.weight.values, bias: &self.bias.values, activation: None }
    }
}

impl Tensor {
    fn new(values: Vec<f32>) -> Self {
        let zeros = || vec![0.0; values.len()];
        Self { first: zeros(), second: zeros(), values }
    }

    fn change(&mut self, gradient: &[f32], by: Move) {
        let Move { rate, correction, epsilon } = by;
        let [first_share, second_share] = SHARES;
        let moments = self.first.iter_mut().zip(&mut self.second);
        for ((value, (first, second)), gradient) in
            self.values.iter_mut().zip(moments).zip(gradient)
        {
            *first += first_share * (gradient - *first);
            *second += second_share * (gradient * gradient - *second);
            *value -= rate * *first / (second.sqrt() * correction + epsilon);
        }
    }
}

fn activate(kind: Activation, x: f32) -> f32 {
    match kind {
        Activation::Sigmoid => 1.0 / (1.0 + (-x).exp()),
        Activation::Tanh => x.tanh(),
        Activation::Relu => x.max(0.0),
        Activation::Elu if x > 0.0 => x,
        Activation::Elu => x.exp_m1(),
    }
}

/// Derivative of the activation, from its value.
fn slope(kind: Activation, y: f32) -> f32 {
    match kind {
        Activation::Sigmoid => y * (1.0 - y),
        Activation::Tanh => 1.0 - y * y,
        Activation::Relu if y > 0.0 => 1.0,
        Activation::Relu => 0.0,
        Activation::Elu if y > 0.0 => 1.0,
        Activation::Elu => y + 1.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_slope_is_that_of_the_activation() {
        for kind in Activation::ALL {
            for x in [-2.0, -0.3, 0.4, 1.7] {
                let step = 1e-3;
                let expected = (activate(kind, x + step) - activate(kind, x - step)) / (2.0 * step);
                let found = slope(kind, activate(kind, x));
                assert!((found - expected).abs() < 1e-3, "{kind:?} {x}: {found}, {expected}");
            }
        }
    }
}
