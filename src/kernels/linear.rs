//! A linear layer, y = x W + b, and its gradients.

use super::matrix::{Into, Matrix, multiply, product, sum_rows};

/// The layer, from `I` to `O` numbers.
#[derive(Clone, Copy, Debug)]
pub struct Linear<'a> {
    /// W, `[I, O]`.
    pub weight: &'a [f32],
    /// b, `[O]`.
    pub bias: &'a [f32],
}

/// Gradients of the layer; those not asked for are empty.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// By x, `[R, I]`.
    pub input: Vec<f32>,
    /// By W, `[I, O]`.
    pub weight: Vec<f32>,
    /// By b, `[O]`.
    pub bias: Vec<f32>,
}

impl Linear<'_> {
    /// y, `[R, O]`, from x, `[R, I]`.
    pub fn forward(&self, input: &[f32]) -> Vec<f32> {
        let (inputs, outputs) = (self.weight.len() / self.bias.len(), self.bias.len());
        let rows = input.len() / inputs;
        let mut output = self.bias.repeat(rows);
        let input = Matrix::new(input, rows, inputs);
        multiply(input, Matrix::new(self.weight, inputs, outputs), &mut output, Into::Add);
        output
    }

    /// The gradients from `gradient`, that of y, `[R, O]`.
    pub fn backward(
        &self,
        input: &[f32],
        gradient: &[f32],
        by_input: bool,
        by_weight: bool,
    ) -> Gradients {
        let (inputs, outputs) = (self.weight.len() / self.bias.len(), self.bias.len());
        let rows = input.len() / inputs;
        let above = Matrix::new(gradient, rows, outputs);
        let weight = Matrix::new(self.weight, inputs, outputs).transposed();
        let input = Matrix::new(input, rows, inputs).transposed();
        let mut bias = vec![0.0; outputs];
        sum_rows(gradient, &mut bias);
        Gradients {
            input: if by_input { product(above, weight) } else { Vec::new() },
            weight: if by_weight { product(input, above) } else { Vec::new() },
            bias,
        }
    }
}
