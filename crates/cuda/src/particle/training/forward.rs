//! Frames through the network, and the loss.

use super::{Training, plan::PARTICLE_THREADS};
use crate::{
    device::{Address, Argument, Shape},
    error::Result,
    kernels::Kernel,
    training::{Matrix, Settings},
};

/// Threads of a block that lists cells, `CELL_THREADS` of the kernels.
const CELL_THREADS: usize = 1024;
/// Blocks that transpose a matrix.
const TRANSPOSING: usize = 16;

impl Training {
    /// Transposes the matrices for the forward pass.
    pub(super) fn transpose(&self) -> Result<()> {
        self.launch(
            Kernel::TrainTranspose,
            Shape::new(TRANSPOSING, self.layout.packing.matrices().len(), 256),
            &[
                self.matrices.address().into(),
                self.optimizer.weights.address().into(),
                self.transposed.address().into(),
            ],
        )
    }

    fn transposed(&self, matrix: &Matrix) -> Address {
        self.transposed.address().plus(matrix.first)
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
            &[plan, self.transposed(encoder).into(), self.transposed(second).into(), sheet.into()],
        )?;
        let shape = self.sums_on_nodes(c0.div_ceil(4) + 1, sheets);
        self.launch(Kernel::TrainToNodes, shape, &[plan, sheet.into()])?;
        self.layers_on_nodes(&self.node_layers.forward, sheet, sheets)?;
        self.launch(
            Kernel::TrainDecode,
            self.tiles(batch, self.constants.decode_bytes()),
            &[plan, self.transposed(&self.layout.context).into(), first.into(), frames.into()],
        )?;
        let shape = Self::over(most, PARTICLE_THREADS, sheets);
        self.launch(Kernel::TrainAdvance, shape, &[plan, sheet.into()])
    }

    /// The loss, once all frames are predicted.
    pub(super) fn loss(&self) -> Result<()> {
        let Settings { batch, warm_up, unroll, relative, error_floor, observed_weight, .. } =
            self.settings;
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
                error_floor.into(),
                observed_weight.into(),
                plan.scales.into(),
                self.tables.progress.address().into(),
                self.tables.outcomes.address().into(),
            ],
        )
    }
}
