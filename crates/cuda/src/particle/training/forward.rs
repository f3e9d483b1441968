//! Frames through the network, and the loss.

use super::{Training, plan::PARTICLE_THREADS};
use crate::{
    device::{Address, Argument, Shape},
    error::Result,
    kernels::Kernel,
    particle::layout::{MOST_PARTS, NODE_THREADS, ROWS, odd},
    training::{Matrix, Settings},
};
use eddy_inference::checkpoint::grid::Stencil;

/// Threads of a block that lists cells, `CELL_THREADS` of the kernels.
const CELL_THREADS: usize = 512;
/// Threads of a block of the sums on nodes.
pub(super) const NODE_SUM_THREADS: usize = 128;

/// A layer on nodes, in either direction.
pub(super) struct NodeLayer {
    pub(super) stencil: Stencil,
    pub(super) weights: Address,
    pub(super) bias: Address,
    /// Lists read and written, and their widths.
    pub(super) lists: [u64; 2],
    pub(super) widths: [usize; 2],
    /// Level of the blocks' nodes.
    pub(super) level: usize,
    /// A list that is added; where no gradient passes.
    pub(super) add: u64,
    pub(super) mask: u64,
    pub(super) rectified: bool,
}

/// `NEIGHBOURS`, `FROM_CHILDREN`, `TO_CHILDREN` of the kernels.
pub(super) fn stencil_number(stencil: Stencil) -> usize {
    match stencil {
        Stencil::Neighbours => 0,
        Stencil::Children => 1,
        Stencil::Parent => 2,
    }
}

impl Training {
    /// A layer on the nodes of `sheets` sheets from `first` on.
    pub(super) fn layer(&self, layer: &NodeLayer, first: usize, sheets: usize) -> Result<()> {
        let NodeLayer {
            stencil, weights, bias, lists: [from, to], widths: [width, outputs], ..
        } = *layer;
        let (inner, columns) = (stencil.places() * width, stencil.children() * outputs);
        let nodes = self.constants.nodes;
        let items = nodes / ROWS * columns / 4;
        let parts = (NODE_THREADS / items).min(inner / 16).clamp(1, MOST_PARTS);
        let shared = 4 * (nodes * odd(inner)).max((parts - 1) * nodes * columns);
        let places = [weights.0, bias.0, from, to, layer.add, layer.mask];
        let stencil = stencil_number(stencil);
        let numbers = [stencil, layer.level, width, outputs, usize::from(layer.rectified), parts];
        let mut bytes = bytemuck::cast_slice(&places).to_vec();
        bytes.extend_from_slice(bytemuck::cast_slice(&numbers.map(|number| number as u32)));
        let blocks = self.memory.nodes[layer.level].div_ceil(nodes);
        let shape = Shape { shared, ..Shape::new(blocks, sheets, NODE_THREADS) };
        let arguments = [self.plan(), Argument::from_bytes(&bytes), first.into()];
        self.launch(Kernel::TrainLayer, shape, &arguments)
    }

    pub(super) fn weight(&self, matrix: &Matrix) -> Address {
        self.optimizer.weight(matrix)
    }

    /// Frames `first..first + frames` through the network.
    pub(super) fn forward(&self, first: usize, frames: usize) -> Result<()> {
        let batch = self.settings.batch;
        let (sheet, sheets) = (first * batch, frames * batch);
        let (plan, most) = (self.plan(), self.store.most());
        let c0 = self.constants.network.channels[0];
        let cells = Shape::new(1, sheets, CELL_THREADS);
        self.launch(Kernel::TrainCells, cells, &[plan, sheet.into()])?;
        let [encoder, second] = &self.layout.encoder;
        self.launch(
            Kernel::TrainEncode,
            self.tiles(sheets, self.constants.encode_bytes()),
            &[plan, self.weight(encoder).into(), self.weight(second).into(), sheet.into()],
        )?;
        let items = self.memory.nodes[0] * (c0.div_ceil(4) + 1);
        let shape = Self::over(items, NODE_SUM_THREADS, sheets);
        self.launch(Kernel::TrainToNodes, shape, &[plan, sheet.into()])?;
        // The first list, then the output of each layer.
        let (sizes, fields) = (self.constants.fields(), &self.memory.plan.fields);
        let layers = &self.constants.network.grid;
        for (from, (matrix, layer)) in self.layout.grid.iter().zip(layers).enumerate() {
            let to = from + 1;
            let node_layer = NodeLayer {
                stencil: layer.stencil,
                weights: self.weight(matrix),
                bias: self.weight(matrix).plus(matrix.bias * matrix.columns),
                lists: [fields[from], fields[to]],
                widths: [sizes[from].1, sizes[to].1],
                level: layer.node_level(),
                add: layer.skip.map_or(0, |skip| fields[skip + 1]),
                mask: 0,
                rectified: layer.rectified,
            };
            self.layer(&node_layer, sheet, sheets)?;
        }
        self.launch(
            Kernel::TrainDecode,
            self.tiles(batch, self.constants.decode_bytes()),
            &[plan, self.weight(&self.layout.context).into(), first.into(), frames.into()],
        )?;
        let shape = Self::over(most, PARTICLE_THREADS, sheets);
        self.launch(Kernel::TrainAdvance, shape, &[plan, sheet.into()])
    }

    /// The loss, once all frames are predicted.
    pub(super) fn loss(&self) -> Result<()> {
        let Settings { batch, warm_up, unroll, relative, observed_weight, .. } = self.settings;
        let counts = [batch, warm_up, unroll, 0].map(|count| count as u32);
        let plan = &self.memory.plan;
        self.launch(
            Kernel::Loss,
            Shape::new(1, 1, 256),
            &[
                plan.squares.into(),
                self.store.most().div_ceil(PARTICLE_THREADS).into(),
                Address::NULL.into(),
                0.0.into(),
                Argument::from_bytes(bytemuck::cast_slice(&counts)),
                usize::from(relative).into(),
                observed_weight.into(),
                plan.scales.into(),
                self.tables.progress.address().into(),
                self.tables.outcomes.address().into(),
            ],
        )
    }
}
