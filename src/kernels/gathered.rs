//! Linear layers whose rows are gathered from other rows by a table: the convolutions on the
//! [grid](super::nodes)'s nodes.
//!
//! | layer | what a row is gathered from | weight in memory |
//! |---|---|---|
//! | [`Convolution`] | the 9 neighbours of a node | `[9 I, O]` |
//! | [`Down`] | the 4 children of a node | `[4 I, O]` |
//! | [`Up`], the transpose of `Down` | the share of the node's parent that is meant for it | `[I, 4 O]` |
//!
//! A neighbour or child that is missing counts as zeros. ReLU follows if `rectify` says so.
//!
//! 1. `products`: gathered rows times a matrix, and the matrix's gradient.
//! 2. Here: the layers out of these.

mod products;

use std::borrow::Cow;

use super::matrix::{Matrix, sum_rows};
use products::{add_products, by_matrix, shares};

/// Gradients of a layer; those not asked for are empty.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// By the input, of its shape.
    pub input: Vec<f32>,
    /// By the weight, of its shape.
    pub weight: Vec<f32>,
    /// By the bias, `[O]`.
    pub bias: Vec<f32>,
}

/// 3 x 3 convolution, y = sum over neighbours k of x_k W_k, + b.
#[derive(Clone, Copy, Debug)]
pub struct Convolution<'a> {
    /// Each node's neighbours, as in [`Level`](super::nodes::Level), `[M]`.
    pub neighbours: &'a [[u32; 9]],
    /// W, `[9 I, O]`.
    pub weight: &'a [f32],
    /// b, `[O]`.
    pub bias: &'a [f32],
    /// Whether ReLU follows.
    pub rectify: bool,
}

/// 2 x 2 convolution with stride 2, from children to parents: y = sum over children k of x_k W_k, + b.
#[derive(Clone, Copy, Debug)]
pub struct Down<'a> {
    /// Each parent's children, as in [`Level`](super::nodes::Level), `[P]`.
    pub children: &'a [[u32; 4]],
    /// Each child's place among them, `[M]`.
    pub parent: &'a [u32],
    /// W, `[4 I, O]`.
    pub weight: &'a [f32],
    /// b, `[O]`.
    pub bias: &'a [f32],
    /// Whether ReLU follows.
    pub rectify: bool,
}

/// Transposed 2 x 2 convolution, from parents to children: child k has y = x W_k + b.
#[derive(Clone, Copy, Debug)]
pub struct Up<'a> {
    /// Each parent's children, as in [`Level`](super::nodes::Level), `[P]`.
    pub children: &'a [[u32; 4]],
    /// Each child's place among them, `[M]`.
    pub parent: &'a [u32],
    /// W, `[I, 4 O]`: the columns of child 0 first.
    pub weight: &'a [f32],
    /// b, `[O]`.
    pub bias: &'a [f32],
}

impl Convolution<'_> {
    /// y, `[M, O]`, from x, `[M, I]`.
    pub fn forward(&self, input: &[f32]) -> Vec<f32> {
        let Self { neighbours, weight, bias, rectify } = *self;
        let weight = Matrix::new(weight, weight.len() / bias.len(), bias.len());
        let mut output = bias.repeat(neighbours.len());
        add_products(neighbours, input, weight, &mut output, rectify);
        output
    }

    /// The gradients from `gradient`, that of the `output`, `[M, O]`.
    pub fn backward(
        &self,
        input: &[f32],
        output: &[f32],
        gradient: &[f32],
        by_input: bool,
        by_weight: bool,
    ) -> Gradients {
        let Self { neighbours, weight, bias, rectify } = *self;
        let outputs = bias.len();
        let inputs = weight.len() / 9 / outputs;
        let gradient = through(rectify, output, gradient);
        let mut by = Gradients::new(&gradient, outputs);
        if by_input {
            // A node is its neighbour k's neighbour 8 - k.
            let blocks = weight.chunks_exact(inputs * outputs).rev();
            let back: Vec<f32> = blocks.flat_map(|block| transposed(block, outputs)).collect();
            by.input = vec![0.0; input.len()];
            let back = Matrix::new(&back, 9 * outputs, inputs);
            add_products(neighbours, &gradient, back, &mut by.input, false);
        }
        if by_weight {
            by.weight = by_matrix(neighbours, input, inputs, &gradient, outputs);
        }
        by
    }
}

impl Down<'_> {
    /// y, `[P, O]`, from x, `[M, I]`.
    pub fn forward(&self, input: &[f32]) -> Vec<f32> {
        let Self { children, weight, bias, rectify, .. } = *self;
        let weight = Matrix::new(weight, weight.len() / bias.len(), bias.len());
        let mut output = bias.repeat(children.len());
        add_products(children, input, weight, &mut output, rectify);
        output
    }

    /// The gradients from `gradient`, that of the `output`, `[P, O]`.
    pub fn backward(
        &self,
        input: &[f32],
        output: &[f32],
        gradient: &[f32],
        by_input: bool,
        by_weight: bool,
    ) -> Gradients {
        let Self { children, parent, weight, bias, rectify } = *self;
        let outputs = bias.len();
        let gradient = through(rectify, output, gradient);
        let mut by = Gradients::new(&gradient, outputs);
        if by_input {
            let back = Matrix::new(weight, weight.len() / outputs, outputs).transposed();
            by.input = vec![0.0; input.len()];
            shares(parent, &gradient, back, &mut by.input);
        }
        if by_weight {
            let inputs = weight.len() / 4 / outputs;
            by.weight = by_matrix(children, input, inputs, &gradient, outputs);
        }
        by
    }
}

impl Up<'_> {
    /// y, `[M, O]`, from x, `[P, I]`.
    pub fn forward(&self, input: &[f32]) -> Vec<f32> {
        let Self { parent, bias, .. } = *self;
        let mut output = bias.repeat(parent.len());
        shares(parent, input, self.matrix(), &mut output);
        output
    }

    /// The gradients from `gradient`, that of y, `[M, O]`.
    pub fn backward(
        &self,
        input: &[f32],
        gradient: &[f32],
        by_input: bool,
        by_weight: bool,
    ) -> Gradients {
        let Self { children, bias, .. } = *self;
        let mut by = Gradients::new(gradient, bias.len());
        if by_input {
            by.input = vec![0.0; input.len()];
            let back = self.matrix().transposed();
            add_products(children, gradient, back, &mut by.input, false);
        }
        if by_weight {
            let [inputs, _] = self.matrix().shape();
            let back = by_matrix(children, gradient, bias.len(), input, inputs);
            by.weight = transposed(&back, inputs);
        }
        by
    }

    /// W.
    fn matrix(&self) -> Matrix<'_> {
        let outputs = 4 * self.bias.len();
        Matrix::new(self.weight, self.weight.len() / outputs, outputs)
    }
}

impl Gradients {
    /// That by the bias alone.
    fn new(gradient: &[f32], outputs: usize) -> Self {
        let mut bias = vec![0.0; outputs];
        sum_rows(gradient, &mut bias);
        Self { input: Vec::new(), weight: Vec::new(), bias }
    }
}

/// The gradient before ReLU from that after it.
fn through<'a>(rectify: bool, output: &[f32], gradient: &'a [f32]) -> Cow<'a, [f32]> {
    if !rectify {
        return Cow::Borrowed(gradient);
    }
    let pairs = gradient.iter().zip(output);
    Cow::Owned(pairs.map(|(by, &y)| if y > 0.0 { *by } else { 0.0 }).collect())
}

/// Rows and columns of a matrix exchanged.
fn transposed(matrix: &[f32], columns: usize) -> Vec<f32> {
    let column = |column: usize| matrix[column..].iter().step_by(columns);
    (0..columns).flat_map(column).copied().collect()
}

#[cfg(test)]
mod tests;
