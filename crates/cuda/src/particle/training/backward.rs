//! The gradients of frames, last frames first.

use super::{Training, plan::PARTICLE_THREADS};
use crate::{
    device::{Pointer, count},
    error::Result,
    kernels::particle::training::{
        gradients::{
            TrainDecodeGradient, TrainEncodeGradient, TrainOutputGradient, TrainShapeGradient,
        },
        grid::{TrainGatherGradient, TrainMeansGradient},
    },
    training::Matrix,
};

/// Threads of a block that has nodes, and of a node, of the gradient by means.
const MEAN_THREADS: [usize; 2] = [128, 8];

impl Training {
    fn weight(&self, matrix: &Matrix) -> Pointer<f32> {
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
        self.launch(by_particle, TrainOutputGradient { plan, first: count(sheet) })?;
        let w = self.weight(&self.layout.context);
        self.launch(
            self.tiles(batch, self.constants.decode_gradient_bytes()),
            TrainDecodeGradient { plan, w, first: count(first), frames: count(frames) },
        )?;
        let shape = self.sums_on_nodes(c0.div_ceil(4), sheets);
        self.launch(shape, TrainGatherGradient { plan, first: count(sheet) })?;
        self.layers_on_nodes(&self.node_layers.backward, sheet, sheets)?;
        let [threads, of_node] = MEAN_THREADS;
        let by_node = Self::over(of_node * self.memory.nodes[0], threads, sheets);
        self.launch(by_node, TrainMeansGradient { plan, first: count(sheet) })?;
        let [encoder, second] = &self.layout.encoder;
        self.launch(
            self.tiles(sheets, self.constants.encode_gradient_bytes()),
            TrainEncodeGradient {
                plan,
                first_matrix: self.weight(encoder),
                second_matrix: self.weight(second),
                first: count(sheet),
                predicted: predicted.into(),
            },
        )?;
        if predicted && self.store.links.is_some() {
            self.launch(by_particle, TrainShapeGradient { plan })?;
        }
        Ok(())
    }
}
