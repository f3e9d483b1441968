//! A linear layer, y = x W + b with x `[R, I]`, W `[I, O]`, b `[O]`, optionally followed by an activation function.
//!
//! 1. This file: whole lists of rows, for training, with the gradients. Products are those of `kernels/matrix` and `kernels/narrow`.
//! 2. `packed`, `rows`: for predictions, weights in the order in which they are read, and blocks of rows whose sums stay in
//!    registers. The [`engine`](crate::engine) runs the layers of a block of particles one after the other.
//! 3. `device.cu`: for predictions on GPUs, a tile of rows at a time. Trainings multiply with cuBLASLt, or, in the particle model, on
//!    tensor cores (`particle/products.cu` of `eddy-cuda`).

pub(crate) mod packed;
pub(crate) mod rows;

use crate::{
    checkpoint::Activation,
    kernels::{
        activation::{activate, gradient_before},
        matrix::{Accumulate, Matrix, multiply, product, sum_rows},
        narrow::{Panels, Rows, add_products, matrix_gradient, products},
    },
};

/// The layers of a tile of rows on GPUs.
pub const DEVICE: &str = include_str!("device.cu");

/// Largest size of a weight for the products of [`narrow`](crate::kernels::narrow).
const MAX_NARROW: usize = 1 << 13;

/// A layer with I inputs and O outputs.
#[derive(Clone, Copy, Debug)]
pub struct Linear<'a> {
    /// W, `[I, O]`.
    pub weight: &'a [f32],
    /// b, `[O]`.
    pub bias: &'a [f32],
    /// What follows, if anything does.
    pub activation: Option<Activation>,
}

/// Gradients of a layer; those that were not requested are empty.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// By x.
    pub input: Vec<f32>,
    /// By W.
    pub weight: Vec<f32>,
    /// By b, `[O]`.
    pub bias: Vec<f32>,
}

impl Linear<'_> {
    /// y, `[R, O]`, from x, `[R, I]`.
    pub fn forward(&self, input: &[f32]) -> Vec<f32> {
        let matrix = self.matrix();
        let [inputs, _] = matrix.shape();
        if self.is_narrow() {
            let rows = Rows::plain(input, inputs);
            let mut output =
                products(rows, &Panels::new(matrix), Some(self.bias), self.is_rectified());
            self.activate(&mut output);
            return output;
        }
        let mut output = self.bias.repeat(input.len() / inputs);
        self.add(input, &mut output);
        output
    }

    /// Adds x W to y, without b, before the activation: for a layer whose inputs are in two lists.
    pub fn add(&self, input: &[f32], output: &mut [f32]) {
        let matrix = self.matrix();
        let [inputs, _] = matrix.shape();
        if self.is_narrow() {
            let rows = Rows::plain(input, inputs);
            add_products(rows, &Panels::new(matrix), self.is_rectified(), output);
        } else {
            let input = Matrix::new(input, input.len() / inputs, inputs);
            multiply(input, matrix, output, Accumulate::Add);
        }
        self.activate(output);
    }

    /// The gradients from `gradient`, that by y, `[R, O]`.
    pub fn backward(
        &self,
        input: &[f32],
        output: &[f32],
        gradient: &[f32],
        by_input: bool,
        by_weight: bool,
    ) -> Gradients {
        let gradient = gradient_before(self.activation, output, gradient);
        let mut by = Gradients::new(&gradient, self.bias.len());
        let matrix = self.matrix();
        let [inputs, outputs] = matrix.shape();
        if self.is_narrow() {
            if by_input {
                let above = Rows::plain(&gradient, outputs);
                by.input = products(above, &Panels::new(matrix.transposed()), None, false);
            }
            if by_weight {
                by.weight = matrix_gradient(Rows::plain(input, inputs), &gradient, outputs);
            }
            return by;
        }
        let rows = input.len() / inputs;
        let above = Matrix::new(&gradient, rows, outputs);
        if by_input {
            by.input = product(above, matrix.transposed());
        }
        if by_weight {
            by.weight = product(Matrix::new(input, rows, inputs).transposed(), above);
        }
        by
    }

    fn matrix(&self) -> Matrix<'_> {
        Matrix::new(self.weight, self.weight.len() / self.bias.len(), self.bias.len())
    }

    /// Whether the products of [`narrow`](crate::kernels::narrow) have the activation.
    fn is_rectified(&self) -> bool {
        self.is_narrow() && self.activation == Some(Activation::Relu)
    }

    /// Applies the activation, if there is one and the products do not have it.
    fn activate(&self, output: &mut [f32]) {
        if let Some(activation) = self.activation.filter(|_| !self.is_rectified()) {
            activate(activation, output);
        }
    }

    fn is_narrow(&self) -> bool {
        self.weight.len() <= MAX_NARROW
    }
}

impl Gradients {
    /// The gradient by the bias alone, from the gradient by the sums, `[R, O]`.
    pub(crate) fn new(gradient: &[f32], outputs: usize) -> Self {
        let mut bias = vec![0.0; outputs];
        sum_rows(gradient, &mut bias);
        Self { input: Vec::new(), weight: Vec::new(), bias }
    }
}
