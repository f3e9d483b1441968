//! The layers on nodes in either direction, and how they are launched.

use eddy_inference::checkpoint::grid::Stencil;

use super::{
    Training, WARP,
    layout::{Layout, TrainingConstants},
};
use crate::{
    device::{Pointer, Shape, count},
    error::Result,
    kernels::particle::{
        node_layers::{NODE_LAYER_THREADS, NodeLayer},
        training::{grid::SUM_SHARES, node_layers::TrainLayer, plan::Plan},
    },
    particle::{
        layout::STENCIL_ROWS,
        node_layers::{stencil_number, tiles},
    },
};

/// Warps that share the sums over particles: `SUM_SHARES` of the kernels for each row of a stencil.
const SUM_WARPS: usize = SUM_SHARES * STENCIL_ROWS;

/// The layers of both passes, in the order of the forward pass.
pub(super) struct NodeLayers {
    pub(super) forward: Vec<NodeLayer>,
    pub(super) backward: Vec<NodeLayer>,
}

impl NodeLayers {
    /// With the transposed matrices and those as they are.
    pub(super) fn new(
        layout: &Layout,
        constants: &TrainingConstants,
        plan: &Plan,
        [transposed, weights]: [Pointer<f32>; 2],
    ) -> Self {
        let lists = constants.fields();
        let Plan { fields, slopes, .. } = plan;
        let layers = &constants.network.grid;
        let (mut forward, mut backward) = (Vec::new(), Vec::new());
        for (from, (matrix, layer)) in layout.grid.iter().zip(layers).enumerate() {
            let to = from + 1;
            let [width, outputs] = [from, to].map(|list| lists[list].1 as i32);
            let places = layer.stencil.places() as i32;
            let level = layer.node_level() as i32;
            let own = transposed.plus(matrix.first);
            forward.push(NodeLayer {
                weights: own,
                bias: own.plus(matrix.bias * matrix.columns),
                from: fields[from],
                to: fields[to],
                add: layer.skip.map_or(Pointer::NULL, |skip| fields[skip + 1]),
                mask: Pointer::NULL,
                stencil: stencil_number(layer.stencil),
                level,
                width,
                outputs,
                rectified: i32::from(layer.rectified),
                row_step: places * width,
                place_step: width,
                unused: 0,
            });
            // What went to the children comes from them, and the other way round. A node is neighbour 8 - k of its neighbour k.
            let (stencil, first, row_step, place_step) = match layer.stencil {
                Stencil::Neighbours => {
                    (Stencil::Neighbours, (places - 1) * width * outputs, outputs, -width * outputs)
                }
                Stencil::Children => (Stencil::Parent, 0, outputs, 0),
                Stencil::Parent => {
                    let children = Stencil::Parent.children() as i32;
                    (Stencil::Children, 0, children * outputs, outputs)
                }
            };
            // The lists that a later layer adds have a gradient from there.
            let later =
                layers.iter().position(|later| later.skip.is_some_and(|skip| skip + 1 == from));
            backward.push(NodeLayer {
                weights: weights.plus(matrix.first + first as usize),
                bias: Pointer::NULL,
                from: slopes[to],
                to: slopes[from],
                add: later.map_or(Pointer::NULL, |layer| slopes[layer + 1]),
                mask: if from == 0 { Pointer::NULL } else { fields[from] },
                stencil: stencil_number(stencil),
                level,
                width: outputs,
                outputs: width,
                rectified: 0,
                row_step,
                place_step,
                unused: 0,
            });
        }
        Self { forward, backward }
    }
}

impl Training {
    /// A layer of a pass on `sheets` sheets from `first` on.
    pub(super) fn layer_on_nodes(
        &self,
        layer: NodeLayer,
        first: usize,
        sheets: usize,
    ) -> Result<()> {
        let nodes = self.memory.nodes[layer.level as usize];
        let blocks = tiles(layer.stencil, layer.outputs, nodes);
        let shape = Shape::new(blocks, sheets, NODE_LAYER_THREADS);
        self.launch(shape, TrainLayer { plan: self.plan(), layer, first: count(first) })
    }

    /// Blocks for sums over the particles around nodes, so many numbers a node, 32 a block.
    pub(super) fn sums_on_nodes(&self, numbers: usize, sheets: usize) -> Shape {
        let blocks = (self.memory.nodes[0] * numbers).div_ceil(WARP);
        Shape::new(blocks, sheets, SUM_WARPS * WARP)
    }
}
