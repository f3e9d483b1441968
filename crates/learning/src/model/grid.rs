//! The layers on the grid, which connect a particle with its surroundings: particles are summed on the nodes around them
//! (P2G), convolutions process two to four levels of nodes, and particles gather the result (G2P).
//!
//! The grid is sparse: only nodes that particles touch exist, so that the cost grows with the number of particles and not
//! with the domain. A convolution is a linear layer on the concatenated rows of the nodes around a node; missing nodes count
//! as zeros.

use std::collections::BTreeMap;

use burn::tensor::{Tensor, activation::relu};

use super::{
    fused, fused_layers,
    grid_context::{GridContext, Table},
    linear::Linear,
    sparse,
};
use eddy_inference::checkpoint::grid::{GridLayer, Stencil};

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
        // What later layers add, [M, C] of its level.
        let mut skipped = BTreeMap::new();
        for (number, (layer, linear)) in self.plan.iter().zip(&self.grid).enumerate() {
            let GridLayer { stencil, level, skip, rectified, .. } = *layer;
            rows = match stencil {
                Stencil::Neighbours => {
                    gather(context, linear, rows, Table::Neighbours(level), rectified)
                }
                Stencil::Children => {
                    gather(context, linear, rows, Table::Children(level), rectified)
                }
                Stencil::Parent => {
                    let sum = spread(context, linear, level, rows);
                    relu(match skip.and_then(|layer| skipped.remove(&layer)) {
                        Some(skip) => skip + sum,
                        None => sum,
                    })
                }
            };
            if self.plan.iter().any(|layer| layer.skip == Some(number)) {
                skipped.insert(number, rows.clone());
            }
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
