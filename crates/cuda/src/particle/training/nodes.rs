//! The layers on nodes in either direction, and how they are launched.

#![expect(unsafe_code, reason = "a struct that the device reads")]

use eddy_inference::checkpoint::grid::Stencil;

use super::{
    Training, WARP,
    layout::{Layout, TrainingConstants},
    plan::Plan,
};
use crate::{
    device::{Address, Argument, Shape},
    error::Result,
    kernels::Kernel,
};

/// Threads of a block, `NODE_LAYER_THREADS` of the kernels.
const THREADS: usize = 128;
/// Warps that share the sums over particles: two for each row of a stencil, `SUM_THREADS` of the kernels.
const SUM_WARPS: usize = 6;
/// Nodes and columns of a block.
const TILE: [usize; 2] = [16, 8];

/// `struct NodeLayer` of the kernels.
#[derive(Clone, Copy)]
#[repr(C)]
pub(super) struct LayerPass {
    weights: u64,
    bias: u64,
    from: u64,
    to: u64,
    /// A list that is added; where no gradient passes.
    add: u64,
    mask: u64,
    stencil: i32,
    /// Level of the nodes that rows are made for.
    level: i32,
    width: i32,
    outputs: i32,
    rectified: i32,
    row_step: i32,
    place_step: i32,
    unused: i32,
}

// SAFETY: integers without padding between them: 6 x 8 + 8 x 4 bytes.
unsafe impl bytemuck::Zeroable for LayerPass {}
// SAFETY: as above.
unsafe impl bytemuck::Pod for LayerPass {}

/// The layers of both passes, in their order.
pub(super) struct NodeLayers {
    pub(super) forward: Vec<LayerPass>,
    pub(super) backward: Vec<LayerPass>,
}

/// `NEIGHBOURS`, `FROM_CHILDREN`, `TO_CHILDREN` of the kernels.
pub(super) fn stencil_number(stencil: Stencil) -> i32 {
    match stencil {
        Stencil::Neighbours => 0,
        Stencil::Children => 1,
        Stencil::Parent => 2,
    }
}
/// `ITSELF` of the kernels.
pub(super) const ITSELF: i32 = 3;

impl LayerPass {
    /// Blocks for so many nodes of a sheet.
    fn blocks(&self, nodes: usize) -> usize {
        let to_children = self.stencil == stencil_number(Stencil::Parent);
        let targets = if to_children { Stencil::Parent.children() } else { 1 };
        let [rows, width] = TILE;
        nodes.div_ceil(rows) * (targets * self.outputs as usize).div_ceil(width)
    }
}

impl NodeLayers {
    /// With the transposed matrices and those as they are.
    pub(super) fn new(
        layout: &Layout,
        constants: &TrainingConstants,
        plan: &Plan,
        [transposed, weights]: [Address; 2],
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
            forward.push(LayerPass {
                weights: own.0,
                bias: own.plus(matrix.bias * matrix.columns).0,
                from: fields[from],
                to: fields[to],
                add: layer.skip.map_or(0, |skip| fields[skip + 1]),
                mask: 0,
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
            backward.push(LayerPass {
                weights: weights.plus(matrix.first + first as usize).0,
                bias: 0,
                from: slopes[to],
                to: slopes[from],
                add: later.map_or(0, |layer| slopes[layer + 1]),
                mask: if from == 0 { 0 } else { fields[from] },
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
        backward.reverse();
        Self { forward, backward }
    }
}

impl Training {
    /// The layers of a pass on `sheets` sheets from `first` on.
    pub(super) fn layers_on_nodes(
        &self,
        pass: &[LayerPass],
        first: usize,
        sheets: usize,
    ) -> Result<()> {
        for layer in pass {
            let blocks = layer.blocks(self.memory.nodes[layer.level as usize]);
            let layer = Argument::from_bytes(bytemuck::bytes_of(layer));
            let shape = Shape::new(blocks, sheets, THREADS);
            self.launch(Kernel::TrainLayer, shape, &[self.plan(), layer, first.into()])?;
        }
        Ok(())
    }

    /// Blocks for sums over the particles around nodes, so many numbers a node, 32 a block.
    pub(super) fn sums_on_nodes(&self, numbers: usize, sheets: usize) -> Shape {
        let blocks = (self.memory.nodes[0] * numbers).div_ceil(WARP);
        Shape::new(blocks, sheets, SUM_WARPS * WARP)
    }
}
