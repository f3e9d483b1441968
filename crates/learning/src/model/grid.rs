//! The layers on the grid, which connect a particle with its surroundings: particles are summed on the nodes around them
//! (P2G), convolutions process two to four levels of nodes, and particles gather the result (G2P).
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
use eddy_inference::checkpoint::layout::{GridLayer, Stencil};

/// The layers on the grid, and the layer after them.
#[derive(Clone, Debug)]
pub(crate) struct GridLayers {
    /// What each layer reads and writes.
    pub(crate) plan: Vec<GridLayer>,
    /// Their weights.
    pub(crate) grid: Vec<Linear>,
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
        let fused = fused::runs_on(&encoded.device());
        let write = if fused { fused_layers::write } else { sparse::write };
        let mut rows = write(context, encoded, position.clone()); // [M0, C0 + 5]
        let mut outputs = Vec::with_capacity(self.plan.len());
        for (number, (layer, linear)) in self.plan.iter().zip(&self.grid).enumerate() {
            let rectify = number + 1 < self.plan.len();
            let level = layer.level;
            rows = match layer.stencil {
                Stencil::Neighbours => {
                    gather(context, linear, rows, Table::Neighbours(level), rectify)
                }
                Stencil::Children => gather(context, linear, rows, Table::Children(level), rectify),
                Stencil::Parent { skip } => {
                    let skip: &Tensor<2> = &outputs[skip];
                    relu(skip.clone() + spread(context, linear, level, rows))
                }
            };
            outputs.push(rows.clone()); // [M, C] of its level
        }
        let read = if fused { fused_layers::read } else { sparse::read };
        read(context, rows, position.clone()) // [R, C0]
    }
}

/// A convolution, `[M', C']` to `[M, C]`.
fn gather(
    context: &GridContext,
    linear: &Linear,
    rows: Tensor<2>,
    table: Table,
    rectify: bool,
) -> Tensor<2> {
    let Linear { weight, bias } = linear.clone();
    let nodes = &context.nodes;
    if fused::runs_on(&weight.device()) {
        return fused_layers::gathered(nodes, table, rectify, rows, weight, bias);
    }
    let output = sparse::gathered(nodes, table, rows, weight, bias);
    if rectify { relu(output) } else { output }
}

/// A transposed 2 x 2 convolution of the parents of a level's nodes, `[M', C']` to `[M, C]`.
fn spread(context: &GridContext, linear: &Linear, level: usize, parents: Tensor<2>) -> Tensor<2> {
    let Linear { weight, bias } = linear.clone();
    let nodes = &context.nodes;
    if fused::runs_on(&weight.device()) {
        return fused_layers::spread(nodes, level, parents, weight, bias);
    }
    sparse::spread(nodes, level, parents, weight, bias)
}
