//! Linear layers on rows that a table gathers from other rows: the convolutions on the nodes of the
//! [grid](super::nodes).
//!
//! | layer | a row is gathered from | weight |
//! |---|---|---|
//! | [`Convolution`] by [`Table::Neighbours`] | the 9 neighbours of a node | `[9 I, O]` |
//! | [`Convolution`] by [`Table::Children`] | the 4 children of a node | `[4 I, O]` |
//! | [`TransposedConvolution`] | the part of its parent's outputs for this child | `[I, 4 O]` |
//!
//! Missing neighbours and children count as zeros. The products are those of [`narrow`](super::narrow).

use crate::{checkpoint::Activation, ops::linear::Gradients};

use super::{
    activation::gradient_before,
    matrix::{Matrix, transposed},
    narrow::{Panels, Rows, matrix_gradient, products},
};

/// The rows that a layer gathers.
#[derive(Clone, Copy, Debug)]
pub enum Table<'a> {
    /// Each node's neighbours, as in [`Level`](super::nodes::Level), `[M]`.
    Neighbours(&'a [[u32; 9]]),
    /// The children of a coarser level.
    Children {
        /// Each parent's children, as in [`Level`](super::nodes::Level), `[P]`.
        children: &'a [[u32; 4]],
        /// Each child's place among them, `[M]`.
        parent: &'a [u32],
    },
}

/// y = sum over k of x_k W_k, + b: a 3 x 3 convolution over neighbours, or a 2 x 2 convolution with stride 2 from children
/// to parents.
#[derive(Clone, Copy, Debug)]
pub struct Convolution<'a> {
    /// The gathered rows.
    pub table: Table<'a>,
    /// W, `[K I, O]`.
    pub weight: &'a [f32],
    /// b, `[O]`.
    pub bias: &'a [f32],
    /// Whether ReLU follows.
    pub rectify: bool,
}

/// Transposed 2 x 2 convolution, from parents to children: child k has y = x W_k + b.
#[derive(Clone, Copy, Debug)]
pub struct TransposedConvolution<'a> {
    /// Each parent's children, as in [`Level`](super::nodes::Level), `[P]`.
    pub children: &'a [[u32; 4]],
    /// Each child's place among them, `[M]`.
    pub parent: &'a [u32],
    /// W, `[I, 4 O]`: the columns of child 0 first.
    pub weight: &'a [f32],
    /// b, `[O]`.
    pub bias: &'a [f32],
}

impl<'a> Table<'a> {
    /// K.
    fn places(self) -> usize {
        match self {
            Self::Neighbours(_) => 9,
            Self::Children { .. } => 4,
        }
    }

    /// The gathered rows of `input`, `[.., width]`.
    fn rows(self, input: &'a [f32], width: usize) -> Rows<'a> {
        match self {
            Self::Neighbours(neighbours) => Rows::gathered(input, width, neighbours),
            Self::Children { children, .. } => Rows::gathered(input, width, children),
        }
    }
}

impl Convolution<'_> {
    /// y, `[M, O]`, from x, `[.., I]`.
    pub fn forward(&self, input: &[f32]) -> Vec<f32> {
        let rows = self.table.rows(input, self.inputs());
        products(rows, &Panels::new(self.matrix()), Some(self.bias), self.rectify)
    }

    /// The gradients from `gradient`, that by the `output`, `[M, O]`.
    pub fn backward(
        &self,
        input: &[f32],
        output: &[f32],
        gradient: &[f32],
        by_input: bool,
        by_weight: bool,
    ) -> Gradients {
        let (inputs, outputs) = (self.inputs(), self.bias.len());
        let gradient = gradient_before(self.rectify.then_some(Activation::Relu), output, gradient);
        let mut by = Gradients::new(&gradient, outputs);
        if by_weight {
            by.weight = matrix_gradient(self.table.rows(input, inputs), &gradient, outputs);
        }
        if !by_input {
            return by;
        }
        by.input = match self.table {
            Table::Neighbours(neighbours) => {
                // A node is neighbour 8 - k of its neighbour k.
                let blocks = self.weight.chunks_exact(inputs * outputs).rev();
                let turned = |block| Matrix::new(block, inputs, outputs).transposed();
                let back = Panels::stacked(&blocks.map(turned).collect::<Vec<_>>());
                products(Rows::gathered(&gradient, outputs, neighbours), &back, None, false)
            }
            Table::Children { parent, .. } => {
                let mut by_input = vec![0.0; input.len()];
                add_shares(parent, &gradient, self.matrix().transposed(), &mut by_input);
                by_input
            }
        };
        by
    }

    /// I.
    fn inputs(&self) -> usize {
        self.weight.len() / self.table.places() / self.bias.len()
    }

    /// W.
    fn matrix(&self) -> Matrix<'_> {
        Matrix::new(self.weight, self.weight.len() / self.bias.len(), self.bias.len())
    }
}

impl TransposedConvolution<'_> {
    /// y, `[M, O]`, from x, `[P, I]`.
    pub fn forward(&self, input: &[f32]) -> Vec<f32> {
        let Self { parent, bias, .. } = *self;
        let mut output = bias.repeat(parent.len());
        add_shares(parent, input, self.matrix(), &mut output);
        output
    }

    /// The gradients from `gradient`, that by y, `[M, O]`.
    pub fn backward(
        &self,
        input: &[f32],
        gradient: &[f32],
        by_input: bool,
        by_weight: bool,
    ) -> Gradients {
        let Self { children, bias, .. } = *self;
        let mut by = Gradients::new(gradient, bias.len());
        let above = Rows::gathered(gradient, bias.len(), children);
        if by_input {
            by.input = products(above, &Panels::new(self.matrix().transposed()), None, false);
        }
        if by_weight {
            let [inputs, _] = self.matrix().shape();
            by.weight = transposed(&matrix_gradient(above, input, inputs), inputs);
        }
        by
    }

    /// W.
    fn matrix(&self) -> Matrix<'_> {
        let outputs = 4 * self.bias.len();
        Matrix::new(self.weight, self.weight.len() / outputs, outputs)
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
