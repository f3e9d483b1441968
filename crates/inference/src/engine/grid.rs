//! The sparse grid that connects a particle with its surroundings: the packed layers, and the lists that they read and write.

use std::collections::BTreeMap;

use super::merged::MERGED_NODE_FEATURES;
use crate::{
    checkpoint::{
        GridOptions, Weights,
        grid::{MAX_LISTS, READ, Stencil, WRITTEN, grid_layers, grid_lists},
        layout,
    },
    kernels::nodes::{Level, Nodes},
    ops::convolution::packed::Convolution,
};

/// The packed layers.
#[derive(Debug)]
pub(super) struct Grid {
    pub(super) layers: Vec<Convolution>,
    /// Level of each list.
    levels_of_lists: Vec<usize>,
    /// Length of the rows of each list, padded to whole panels of the layers that write it.
    pub(super) widths: Vec<usize>,
    pub(super) cell_width: f32,
    /// Number of levels.
    pub(super) levels: usize,
    /// E.
    pub(super) encoded: usize,
}

/// The nodes of a frame, and the buffers between layers.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    pub(super) nodes: Nodes,
    /// The lists, `[nodes + 1, its width]`; the last row is zero.
    pub(super) lists: [Vec<f32>; MAX_LISTS],
    /// What [`Walls`](crate::ops::node_inputs::rows::Walls) keeps of columns of nodes.
    pub(super) columns: Vec<[f32; 2]>,
}

impl Grid {
    /// Packs the layers of a grid from the tensors of [`merged`](super::merged).
    pub(super) fn pack(
        lanes: usize,
        grid: &GridOptions,
        tensors: &BTreeMap<String, Weights>,
    ) -> Self {
        let layers = grid_layers(grid);
        let tensors = |layer: &str| layout::names(layer).map(|name| &tensors[&name]);
        // Both lists of a level are as wide as its widest layer.
        let mut widest = vec![0; grid.channels.len()];
        for layer in &layers {
            let [_, bias] = tensors(&layer.name);
            let width = bias.values.len().next_multiple_of(lanes);
            widest[layer.level] = width.max(widest[layer.level]);
        }
        let levels_of_lists: Vec<_> = grid_lists(grid).iter().map(|&(level, _)| level).collect();
        let mut widths: Vec<_> = levels_of_lists.iter().map(|&level| widest[level]).collect();
        let [weight, _] = tensors(&layers[0].name);
        let inputs = weight.shape[1] / Stencil::Neighbours.places();
        widths[WRITTEN] = inputs.next_multiple_of(lanes);
        let pack = |layer| Convolution::pack(lanes, layer, &layers, tensors(&layer.name));
        Self {
            layers: layers.iter().map(pack).collect(),
            levels_of_lists,
            widths,
            cell_width: grid.cell_width,
            levels: grid.channels.len(),
            encoded: inputs - MERGED_NODE_FEATURES,
        }
    }

    /// Length of the rows that particles are summed in.
    pub(super) fn written_width(&self) -> usize {
        self.widths[WRITTEN]
    }

    /// Length of the rows that particles gather.
    pub(super) fn read_width(&self) -> usize {
        self.widths[READ]
    }

    /// Resizes the lists to the nodes.
    pub(super) fn resize(&self, scratch: &mut Scratch) {
        let Scratch { nodes, lists, .. } = scratch;
        for ((list, &level), &width) in
            lists.iter_mut().zip(&self.levels_of_lists).zip(&self.widths)
        {
            resize(list, nodes.level(level), width);
        }
    }
}

/// Resizes a list to the nodes of a level, with a row of zeros behind them, and reserves as much as they can grow without allocating.
fn resize(list: &mut Vec<f32>, level: &Level, width: usize) {
    let length = level.len() * width;
    list.truncate(length);
    list.reserve((level.capacity() + 1) * width - list.len());
    list.resize(length, 0.0);
    list.resize(length + width, 0.0);
}
