//! The gradients of frames, last frames first.

use super::{
    Training,
    forward::{NODE_SUM_THREADS, NodeLayer},
    plan::PARTICLE_THREADS,
};
use crate::{
    device::{Address, Shape},
    error::Result,
    kernels::Kernel,
    training::Matrix,
};
use eddy_inference::checkpoint::grid::Stencil;

/// Blocks that turn a matrix.
const TURNING: usize = 16;

impl Training {
    /// The matrices for the way back.
    pub(super) fn turn(&self) -> Result<()> {
        self.launch(
            Kernel::TrainTurn,
            Shape::new(TURNING, self.layout.packing.matrices().len(), 256),
            &[
                self.turns.address().into(),
                self.optimizer.weights.address().into(),
                self.turned.address().into(),
            ],
        )
    }

    fn turned(&self, matrix: &Matrix) -> Address {
        self.turned.address().plus(matrix.first)
    }

    /// The gradients of frames `first..first + frames`, and by the particles of a frame that was predicted.
    pub(super) fn backward(&self, first: usize, frames: usize) -> Result<()> {
        let batch = self.settings.batch;
        let (sheet, sheets) = (first * batch, frames * batch);
        let predicted = first >= self.settings.warm_up;
        let (plan, most) = (self.plan(), self.store.most());
        let c0 = self.constants.network.channels[0];
        let by_particle = Self::over(most, PARTICLE_THREADS, sheets);
        self.launch(Kernel::TrainOutputGradient, by_particle, &[plan, sheet.into()])?;
        self.launch(
            Kernel::TrainDecodeGradient,
            self.tiles(batch, self.constants.decode_gradient_bytes()),
            &[plan, self.turned(&self.layout.context).into(), first.into(), frames.into()],
        )?;
        let items = self.memory.nodes[0] * c0.div_ceil(4);
        let shape = Self::over(items, NODE_SUM_THREADS, sheets);
        self.launch(Kernel::TrainGatherGradient, shape, &[plan, sheet.into()])?;
        self.node_layers_backward(sheet, sheets)?;
        let by_node = Self::over(self.memory.nodes[0], NODE_SUM_THREADS, sheets);
        self.launch(Kernel::TrainMeansGradient, by_node, &[plan, sheet.into()])?;
        let [encoder, second] = &self.layout.encoder;
        self.launch(
            Kernel::TrainEncodeGradient,
            self.tiles(sheets, self.constants.encode_gradient_bytes()),
            &[
                plan,
                self.turned(encoder).into(),
                self.turned(second).into(),
                sheet.into(),
                usize::from(predicted).into(),
            ],
        )?;
        if predicted && self.store.links.is_some() {
            self.launch(Kernel::TrainShapeGradient, by_particle, &[plan])?;
        }
        Ok(())
    }

    /// The gradients by the lists that the layers on nodes read, the last layer first.
    fn node_layers_backward(&self, sheet: usize, sheets: usize) -> Result<()> {
        let sizes = self.constants.fields();
        let super::plan::Plan { fields, slopes, .. } = &self.memory.plan;
        let layers = &self.constants.network.grid;
        for (from, (matrix, layer)) in self.layout.grid.iter().zip(layers).enumerate().rev() {
            let to = from + 1;
            // The lists that a later layer adds have a gradient from there.
            let later =
                layers.iter().position(|later| later.skip.is_some_and(|skip| skip + 1 == from));
            let node_layer = NodeLayer {
                // What went to the children comes from them, and the other way round.
                stencil: match layer.stencil {
                    Stencil::Neighbours => Stencil::Neighbours,
                    Stencil::Children => Stencil::Parent,
                    Stencil::Parent => Stencil::Children,
                },
                weights: self.turned(matrix),
                bias: Address::NULL,
                lists: [slopes[to], slopes[from]],
                widths: [sizes[to].1, sizes[from].1],
                level: layer.node_level(),
                add: later.map_or(0, |layer| slopes[layer + 1]),
                mask: if from == 0 { 0 } else { fields[from] },
                rectified: false,
            };
            self.layer(&node_layer, sheet, sheets)?;
        }
        Ok(())
    }
}
