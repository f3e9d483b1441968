//! The gradients of frames, last frames first.

use eddy_inference::checkpoint::plan::Stage;

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
        for &stage in self.constants.network.stages.iter().rev() {
            match stage {
                Stage::Decode => {
                    let shape = self.tiles(batch, self.constants.decode_gradient_bytes());
                    let w = self.weight(&self.layout.context);
                    let (first, frames) = (count(first), count(frames));
                    self.launch(shape, TrainDecodeGradient { plan, w, first, frames })?;
                    let shape = self.sums_on_nodes(c0.div_ceil(4), sheets);
                    self.launch(shape, TrainGatherGradient { plan, first: count(sheet) })?;
                }
                Stage::Convolution(layer) => {
                    self.layer_on_nodes(self.node_layers.backward[layer], sheet, sheets)?;
                }
                Stage::ToNodes => {
                    let [threads, of_node] = MEAN_THREADS;
                    let by_node = Self::over(of_node * self.memory.nodes[0], threads, sheets);
                    self.launch(by_node, TrainMeansGradient { plan, first: count(sheet) })?;
                }
                Stage::Encode => {
                    let [first_matrix, second_matrix] =
                        self.layout.encoder.each_ref().map(|matrix| self.weight(matrix));
                    let shape = self.tiles(sheets, self.constants.encode_gradient_bytes());
                    let (first, predicted) = (count(sheet), predicted.into());
                    let kernel =
                        TrainEncodeGradient { plan, first_matrix, second_matrix, first, predicted };
                    self.launch(shape, kernel)?;
                }
            }
        }
        if predicted && self.store.links.is_some() {
            self.launch(by_particle, TrainShapeGradient { plan })?;
        }
        Ok(())
    }
}
