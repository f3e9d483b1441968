//! A convolution on the nodes of the [grid](crate::kernels::nodes): a linear layer whose rows a table gathers from other rows.
//!
//! | [`Stencil`] | output of a node m | W |
//! |---|---|---|
//! | `Neighbours` | b + sum over k of x_k W_k; x_k is its neighbour k, of 3 x 3 | `[9 I, O]` |
//! | `Children` | b + sum over k of x_k W_k; x_k is its child k, of 2 x 2 | `[4 I, O]` |
//! | `Parent` | b + x W_k + a; m is child k of x, a is the same node in the list that is added | `[I, 4 O]`: the columns of child 0 first |
//!
//! ReLU follows where the layer is rectified. Missing neighbours and children count as zeros.
//!
//! 1. This file: whole lists of rows, for training, with the gradients. Products are those of `kernels/narrow`.
//! 2. `packed`: for predictions, a block of nodes with the packed weights of [`linear`].
//! 3. `particle/node_layers.cu` of `eddy-cuda`, beside the code that launches it: on GPUs, for predictions and both passes of training.

pub(crate) mod packed;

use super::linear;
use crate::{
    checkpoint::{
        Activation,
        grid::{GridLayer, Stencil},
    },
    kernels::{
        activation::{activate, gradient_before},
        matrix::{Matrix, transposed},
        narrow::{Panels, Rows, matrix_gradient, products},
        nodes::Nodes,
    },
};

/// A layer with I inputs and O outputs.
#[derive(Clone, Copy, Debug)]
pub struct Convolution<'a> {
    /// The nodes of all levels.
    pub nodes: &'a Nodes,
    /// What it reads and writes.
    pub layer: &'a GridLayer,
    /// W.
    pub weight: &'a [f32],
    /// b, `[O]`.
    pub bias: &'a [f32],
}

impl Convolution<'_> {
    /// y, `[M, O]`, from x, `[.., I]`, and from a, `[M, O]`, where the layer reads parents.
    ///
    /// # Panics
    /// If a is missing there, or given to another layer.
    pub fn forward(&self, input: &[f32], added: Option<&[f32]>) -> Vec<f32> {
        if self.layer.stencil != Stencil::Parent {
            assert!(added.is_none(), "only layers that read parents have a skip connection");
            let (panels, rectify) = (Panels::new(self.matrix()), self.layer.rectified);
            return products(self.rows(input, self.inputs()), &panels, Some(self.bias), rectify);
        }
        let parent = self.parent();
        let mut output = self.bias.repeat(parent.len());
        add_shares(parent, input, self.matrix(), &mut output);
        let added = added.expect("layers that read parents have a skip connection");
        output.iter_mut().zip(added).for_each(|(sum, added)| *sum += added);
        if let Some(activation) = self.activation() {
            activate(activation, &mut output);
        }
        output
    }

    /// The gradients by x, W and b from `gradient`, that by the `output`, `[M, O]`; and by a, `[M, O]`, of a layer that reads parents.
    pub fn backward(
        &self,
        input: &[f32],
        output: &[f32],
        gradient: &[f32],
    ) -> (linear::Gradients, Vec<f32>) {
        let (inputs, outputs) = (self.inputs(), self.bias.len());
        let gradient = gradient_before(self.activation(), output, gradient);
        let mut by = linear::Gradients::new(&gradient, outputs);
        if self.layer.stencil != Stencil::Parent {
            by.weight = matrix_gradient(self.rows(input, inputs), &gradient, outputs);
        }
        match self.layer.stencil {
            Stencil::Neighbours => {
                // A node is neighbour 8 - k of its neighbour k.
                let blocks = self.weight.chunks_exact(inputs * outputs).rev();
                let turned = |block| Matrix::new(block, inputs, outputs).transposed();
                let back = Panels::stacked(&blocks.map(turned).collect::<Vec<_>>());
                by.input = products(self.rows(&gradient, outputs), &back, None, false);
            }
            Stencil::Children => {
                by.input = vec![0.0; input.len()];
                let parent = &self.nodes.level(self.layer.level - 1).parent;
                add_shares(parent, &gradient, self.matrix().transposed(), &mut by.input);
            }
            Stencil::Parent => {
                let children = &self.nodes.level(self.layer.node_level()).children;
                let above = Rows::gathered(&gradient, outputs, children);
                let back = Panels::new(self.matrix().transposed());
                by.input = products(above, &back, None, false);
                by.weight = transposed(&matrix_gradient(above, input, inputs), inputs);
                return (by, gradient.into_owned());
            }
        }
        (by, Vec::new())
    }

    /// What follows, if anything does.
    fn activation(&self) -> Option<Activation> {
        self.layer.rectified.then_some(Activation::Relu)
    }

    /// I.
    fn inputs(&self) -> usize {
        let Self { layer: GridLayer { stencil, .. }, weight, bias, .. } = self;
        weight.len() / (stencil.places() * stencil.children() * bias.len())
    }

    /// W.
    fn matrix(&self) -> Matrix<'_> {
        let columns = self.layer.stencil.children() * self.bias.len();
        Matrix::new(self.weight, self.weight.len() / columns, columns)
    }

    /// The rows of neighbours or children, from a list `[.., width]`.
    fn rows<'r>(&'r self, list: &'r [f32], width: usize) -> Rows<'r> {
        let level = self.nodes.level(self.layer.level);
        match self.layer.stencil {
            Stencil::Neighbours => Rows::gathered(list, width, &level.neighbours),
            Stencil::Children => Rows::gathered(list, width, &level.children),
            Stencil::Parent => unreachable!("a child's row is its parent's"),
        }
    }

    /// Each node's place among the children of all parents.
    fn parent(&self) -> &[u32] {
        &self.nodes.level(self.layer.level).parent
    }
}

/// Adds to each row m of `sums`, `[M, O]`, the part of its parent's products for this child: row `parent[m]`, counted in
/// rows of O, of the product of `input`, `[P, I]`, and the matrix, `[I, 4 O]`.
fn add_shares(parent: &[u32], input: &[f32], matrix: Matrix, sums: &mut [f32]) {
    let [inputs, outputs] = matrix.shape();
    let products = products(Rows::plain(input, inputs), &Panels::new(matrix), None, false);
    let width = outputs / 4;
    for (sums, &place) in sums.chunks_exact_mut(width).zip(parent) {
        let share = &products[place as usize * width..][..width];
        for (sum, share) in sums.iter_mut().zip(share) {
            *sum += share;
        }
    }
}

#[cfg(test)]
mod tests;
