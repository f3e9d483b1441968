//! The gradients of frames, last frames first.

use super::{Training, plan::PARTICLE_THREADS};
use crate::{device::Address, error::Result, kernels::Kernel, training::Matrix};

/// Threads of a block that has nodes, and of a node, of the gradient by means.
const MEAN_THREADS: [usize; 2] = [128, 8];

impl Training {
    fn weight(&self, matrix: &Matrix) -> Address {
        self.optimizer.weight(matrix)
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
            &[plan, self.weight(&self.layout.context).into(), first.into(), frames.into()],
        )?;
        let shape = self.sums_on_nodes(c0.div_ceil(4), sheets);
        self.launch(Kernel::TrainGatherGradient, shape, &[plan, sheet.into()])?;
        self.layers_on_nodes(&self.node_layers.backward, sheet, sheets)?;
        let [threads, of_node] = MEAN_THREADS;
        let by_node = Self::over(of_node * self.memory.nodes[0], threads, sheets);
        self.launch(Kernel::TrainMeansGradient, by_node, &[plan, sheet.into()])?;
        let [encoder, second] = &self.layout.encoder;
        self.launch(
            Kernel::TrainEncodeGradient,
            self.tiles(sheets, self.constants.encode_gradient_bytes()),
            &[
                plan,
                self.weight(encoder).into(),
                self.weight(second).into(),
                sheet.into(),
                usize::from(predicted).into(),
            ],
        )?;
        if predicted && self.store.links.is_some() {
            self.launch(Kernel::TrainShapeGradient, by_particle, &[plan])?;
        }
        Ok(())
    }
}
