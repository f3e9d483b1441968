//! The networks' layers as [`fused`](super::fused) operations of the kernels. `grid` has the layers on the particle model's
//! grid, `particles` its features and predicted motion, `cells` the recurrent cells.

mod cells;
mod grid;
mod particles;

pub(crate) use cells::cells;
pub(crate) use grid::{gathered, read, spread, write};
pub(crate) use particles::{advance, expected_velocities, features, shape};

use burn::tensor::Tensor;

use super::fused::{Operation, apply, input};
use eddy_inference::{
    checkpoint::Activation,
    kernels::{
        activation::{Elu, Relu, Sigmoid, Tanh, relu_gradient},
        encoder::{Encoder, Gradients, Means},
    },
    ops::linear::Linear,
};

/// A linear layer, optionally with ReLU: `input` `[R, I]`, `weight` `[I, O]` and `bias` `[O]` to `[R, O]`.
pub(crate) fn linear(
    rectify: bool,
    input: Tensor<2>,
    weight: Tensor<2>,
    bias: Tensor<1>,
) -> Tensor<2> {
    let shape = [input.dims()[0], bias.dims()[0]];
    let inputs = [self::input(input), self::input(weight), self::input(bias)];
    apply(LinearLayer { rectify }, inputs, shape)
}

#[derive(Clone, Copy, Debug)]
struct LinearLayer {
    rectify: bool,
}

impl Operation<3> for LinearLayer {
    type Kept = ();

    fn forward(&self, [input, weight, bias]: [&[f32]; 3]) -> (Vec<f32>, ()) {
        (Linear { weight, bias, rectify: self.rectify }.forward(input), ())
    }

    fn backward(
        &self,
        [input, weight, bias]: [&[f32]; 3],
        output: &[f32],
        (): (),
        gradient: &[f32],
        [by_input, by_weight, _]: [bool; 3],
    ) -> [Vec<f32>; 3] {
        let layer = Linear { weight, bias, rectify: self.rectify };
        let by = layer.backward(input, output, gradient, by_input, by_weight);
        [by.input, by.weight, by.bias]
    }
}

/// A linear layer with ReLU on two concatenated inputs: `left` `[R, I]`, `right` `[R, J]`, `weight` `[I + J, O]` and `bias`
/// `[O]` to `[R, O]`.
pub(crate) fn concatenated(
    [left, right]: [Tensor<2>; 2],
    weight: Tensor<2>,
    bias: Tensor<1>,
) -> Tensor<2> {
    let [rows, width] = left.dims();
    let shape = [rows, bias.dims()[0]];
    apply(Concatenated { width }, [input(left), input(right), input(weight), input(bias)], shape)
}

#[derive(Clone, Copy, Debug)]
struct Concatenated {
    /// I.
    width: usize,
}

impl Concatenated {
    /// The layers of the two inputs, whose outputs are added.
    fn layers<'a>(&self, weight: &'a [f32], bias: &'a [f32]) -> [Linear<'a>; 2] {
        let (left, right) = weight.split_at(self.width * bias.len());
        [
            Linear { weight: left, bias, rectify: false },
            Linear { weight: right, bias, rectify: true },
        ]
    }
}

impl Operation<4> for Concatenated {
    type Kept = ();

    fn forward(&self, [left, right, weight, bias]: [&[f32]; 4]) -> (Vec<f32>, ()) {
        let [first, second] = self.layers(weight, bias);
        let mut output = first.forward(left);
        second.add(right, &mut output);
        (output, ())
    }

    fn backward(
        &self,
        [left, right, weight, bias]: [&[f32]; 4],
        output: &[f32],
        (): (),
        gradient: &[f32],
        [by_left, by_right, by_weight, _]: [bool; 4],
    ) -> [Vec<f32>; 4] {
        let [first, second] = self.layers(weight, bias);
        let gradient = relu_gradient(second.rectify, output, gradient);
        let second = Linear { rectify: false, ..second };
        let left = first.backward(left, output, &gradient, by_left, by_weight);
        let right = second.backward(right, output, &gradient, by_right, by_weight);
        [left.input, right.input, [left.weight, right.weight].concat(), left.bias]
    }
}

/// The mean over particles of a linear layer with activation: `points` `[B N, F]`, `weight` `[F, E]` and
/// `bias` `[E]` to `[B, E]`. `F` is 5 or 8.
pub(crate) fn encode(
    activation: Activation,
    particles: usize,
    points: Tensor<2>,
    weight: Tensor<2>,
    bias: Tensor<1>,
) -> Tensor<2> {
    let [rows, features] = points.dims();
    let shape = [rows / particles, bias.dims()[0]];
    let inputs = [input(points), input(weight), input(bias)];
    let kind = Encode { activation, particles };
    match features {
        5 => apply(EncodeOf::<5>(kind), inputs, shape),
        8 => apply(EncodeOf::<8>(kind), inputs, shape),
        other => unreachable!("{other} features: the material is one input or four"),
    }
}

#[derive(Clone, Copy, Debug)]
struct Encode {
    activation: Activation,
    particles: usize,
}

#[derive(Clone, Copy, Debug)]
struct EncodeOf<const F: usize>(Encode);

impl<const F: usize> Operation<3> for EncodeOf<F> {
    /// Sums of slopes.
    type Kept = Vec<f32>;

    fn forward(&self, [points, weight, bias]: [&[f32]; 3]) -> (Vec<f32>, Self::Kept) {
        let Encode { activation, particles } = self.0;
        let layer = Encoder::<F> { weight, bias, particles };
        let Means { means, slopes } = match activation {
            Activation::Sigmoid => layer.forward(Sigmoid, points),
            Activation::Tanh => layer.forward(Tanh, points),
            Activation::Relu => layer.forward(Relu, points),
            Activation::Elu => layer.forward(Elu, points),
        };
        (means, slopes)
    }

    fn backward(
        &self,
        [points, weight, bias]: [&[f32]; 3],
        _means: &[f32],
        slopes: Self::Kept,
        gradient: &[f32],
        [by_points, _, _]: [bool; 3],
    ) -> [Vec<f32>; 3] {
        let Encode { activation, particles } = self.0;
        let layer = Encoder::<F> { weight, bias, particles };
        let Gradients { points, weight, bias } = match activation {
            Activation::Sigmoid => layer.backward(Sigmoid, points, &slopes, gradient, by_points),
            Activation::Tanh => layer.backward(Tanh, points, &slopes, gradient, by_points),
            Activation::Relu => layer.backward(Relu, points, &slopes, gradient, by_points),
            Activation::Elu => layer.backward(Elu, points, &slopes, gradient, by_points),
        };
        [points, weight, bias]
    }
}
