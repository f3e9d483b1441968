//! Frames through the network, and the loss.

use eddy_inference::checkpoint::plan::Stage;

use super::{Training, plan::PARTICLE_THREADS};
use crate::{
    device::{Pointer, Shape, count},
    error::Result,
    kernels::{
        particle::training::{
            grid::{CELL_THREADS, TrainCells, TrainToNodes},
            particles::{TrainAdvance, TrainDecode, TrainEncode},
            weights::TrainTranspose,
        },
        training::batch_loss::{Loss, Unroll},
    },
    training::{Matrix, Settings},
};

/// Blocks that transpose a matrix.
const TRANSPOSING: usize = 16;

impl Training {
    /// Transposes the matrices for the forward pass.
    pub(super) fn transpose(&self) -> Result<()> {
        self.launch(
            Shape::new(TRANSPOSING, self.layout.packing.matrices().len(), 256),
            TrainTranspose {
                matrices: self.matrices.pointer(),
                w: self.optimizer.weights.pointer(),
                transposed: self.transposed.pointer(),
            },
        )
    }

    fn transposed(&self, matrix: &Matrix) -> Pointer<f32> {
        self.transposed.pointer().plus(matrix.first)
    }

    /// Frames `first..first + frames` through the network.
    pub(super) fn forward(&self, first: usize, frames: usize) -> Result<()> {
        let batch = self.settings.batch;
        let (sheet, sheets) = (first * batch, frames * batch);
        let (plan, most) = (self.plan(), self.store.most());
        let c0 = self.constants.network.channels[0];
        let cells = Shape::new(1, sheets, CELL_THREADS);
        self.launch(cells, TrainCells { plan, first: count(sheet) })?;
        for &stage in &self.constants.network.stages {
            match stage {
                Stage::Encode => {
                    let [first_matrix, second_matrix] =
                        self.layout.encoder.each_ref().map(|matrix| self.transposed(matrix));
                    let shape = self.tiles(sheets, self.constants.encode_bytes());
                    let first = count(sheet);
                    self.launch(shape, TrainEncode { plan, first_matrix, second_matrix, first })?;
                }
                Stage::ToNodes => {
                    let shape = self.sums_on_nodes(c0.div_ceil(4) + 1, sheets);
                    self.launch(shape, TrainToNodes { plan, first: count(sheet) })?;
                }
                Stage::Convolution(layer) => {
                    self.layer_on_nodes(self.node_layers.forward[layer], sheet, sheets)?;
                }
                Stage::Decode => {
                    let shape = self.tiles(batch, self.constants.decode_bytes());
                    let w = self.transposed(&self.layout.context);
                    let (first, frames) = (count(first), count(frames));
                    self.launch(shape, TrainDecode { plan, w, first, frames })?;
                }
            }
        }
        let shape = Self::over(most, PARTICLE_THREADS, sheets);
        self.launch(shape, TrainAdvance { plan, first: count(sheet) })
    }

    /// The loss, once all frames are predicted.
    pub(super) fn loss(&self) -> Result<()> {
        let Settings { batch, warm_up, unroll, relative, error_floor, observed_weight, .. } =
            self.settings;
        let [batch, warm_up, unroll] = [batch, warm_up, unroll].map(count);
        let plan = &self.memory.plan;
        self.launch(
            Shape::new(1, 1, 256),
            Loss {
                squares: plan.squares,
                chunks: count(self.store.most().div_ceil(PARTICLE_THREADS)),
                densities: Pointer::NULL,
                density_factor: 0.0,
                f: Unroll { batch, warm_up, unroll, decoded: 0 },
                relative: relative.into(),
                error_floor,
                observed_weight,
                scales: plan.scales,
                progress: self.tables.progress.pointer(),
                outcomes: self.tables.outcomes.pointer(),
            },
        )
    }
}
