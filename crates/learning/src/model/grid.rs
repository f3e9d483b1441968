//! The layers on the grid, which connect a particle with its surroundings: particles are summed on the nodes around them
//! (P2G), convolutions process three levels of nodes, and particles gather the result (G2P).
//!
//! The grid is sparse: only nodes that particles touch exist, so that the cost grows with the number of particles and not
//! with the domain. A convolution is a linear layer on the concatenated rows of the nodes around a node; missing nodes count
//! as zeros.

use burn::tensor::{Tensor, activation::relu};

use super::{
    fused, fused_layers,
    grid_context::{GridContext, Table},
    linear::Linear,
    sparse,
};

/// The layers on the grid, and the layer after them.
#[derive(Clone, Debug)]
pub(crate) struct GridLayers {
    /// In the order of [`layout`](eddy_inference::checkpoint::layout), from `grid.0.a` to `grid.0.c`.
    pub(crate) grid: [Linear; 11],
    /// From features and gathered values to the core's input.
    pub(crate) context: Linear,
}

impl GridLayers {
    /// The values that each particle gathers, `[R, C0]`, from `encoded`, `[R, C0]`, and `position`, `[R, 2]`.
    pub(crate) fn forward(
        &self,
        context: &GridContext,
        encoded: Tensor<2>,
        position: &Tensor<2>,
    ) -> Tensor<2> {
        let [a0, b0, down1, a1, down2, a2, b2, up1, b1, up0, c0] = &self.grid;
        let level = |level| GridLevel { context, level };
        let fused = fused::runs_on(&encoded.device());
        let write = if fused { fused_layers::write } else { sparse::write };
        let written = write(context, encoded, position.clone()); // [M0, C0 + 5]
        let fine = level(0).around(b0, level(0).around(a0, written, true), true); // [M0, C0]
        let middle = level(1).around(a1, level(1).down(down1, fine.clone()), true); // [M1, C1]
        let coarse = level(2).around(a2, level(2).down(down2, middle.clone()), true); // [M2, C2]
        let coarse = level(2).around(b2, coarse, true);
        let middle = level(1).around(b1, level(1).up(up1, coarse, middle), true);
        let fine = level(0).around(c0, level(0).up(up0, middle, fine), false);
        let read = if fused { fused_layers::read } else { sparse::read };
        read(context, fine, position.clone()) // [R, C0]
    }
}

/// A level of the grid.
struct GridLevel<'a> {
    context: &'a GridContext,
    level: usize,
}

impl GridLevel<'_> {
    /// A 3 x 3 convolution, `[M, C]` to `[M, C']`.
    fn around(&self, linear: &Linear, rows: Tensor<2>, rectify: bool) -> Tensor<2> {
        self.gather(linear, rows, Table::Neighbours(self.level), rectify)
    }

    /// A 2 x 2 convolution of each node's children, `[M', C']` to `[M, C]`, with ReLU.
    fn down(&self, linear: &Linear, rows: Tensor<2>) -> Tensor<2> {
        self.gather(linear, rows, Table::Children(self.level), true)
    }

    fn gather(&self, linear: &Linear, rows: Tensor<2>, table: Table, rectify: bool) -> Tensor<2> {
        let Linear { weight, bias } = linear.clone();
        let nodes = &self.context.nodes;
        if fused::runs_on(&weight.device()) {
            return fused_layers::gathered(nodes, table, rectify, rows, weight, bias);
        }
        let output = sparse::gathered(nodes, table, rows, weight, bias);
        if rectify { relu(output) } else { output }
    }

    /// A transposed 2 x 2 convolution of each node's parent, `[M', C']` to `[M, C]`, plus the skip connection, with ReLU.
    fn up(&self, linear: &Linear, parents: Tensor<2>, skip: Tensor<2>) -> Tensor<2> {
        let Linear { weight, bias } = linear.clone();
        let nodes = &self.context.nodes;
        let spread = if fused::runs_on(&weight.device()) {
            fused_layers::spread(nodes, self.level, parents, weight, bias)
        } else {
            sparse::spread(nodes, self.level, parents, weight, bias)
        };
        relu(skip + spread)
    }
}
