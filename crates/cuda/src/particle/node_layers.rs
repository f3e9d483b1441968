//! How layers on nodes are numbered and launched, for predictions and trainings.

use eddy_inference::checkpoint::grid::Stencil;

use crate::{
    device::count,
    kernels::particle::{
        node_layers::{FROM_CHILDREN, NEIGHBOURS, TILE_COLUMNS, TO_CHILDREN},
        products::WARP_ROWS,
    },
};

/// A stencil as the kernels number it.
pub(super) fn stencil_number(stencil: Stencil) -> i32 {
    count(match stencil {
        Stencil::Neighbours => NEIGHBOURS,
        Stencil::Children => FROM_CHILDREN,
        Stencil::Parent => TO_CHILDREN,
    })
}

/// Blocks of a layer with so many padded outputs on so many nodes, `tiles_of` of the kernels.
pub(super) fn tiles(stencil: i32, outputs: i32, nodes: usize) -> usize {
    let to_children = stencil == stencil_number(Stencil::Parent);
    let targets = if to_children { Stencil::Parent.children() } else { 1 };
    nodes.div_ceil(WARP_ROWS) * (targets * outputs as usize).div_ceil(TILE_COLUMNS)
}
