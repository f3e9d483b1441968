//! Frames through the network, and the loss.

use crate::{
    device::{Address, Argument, Queue, Shape},
    error::Result,
    kernels::{AXES, Constants, Kernel},
    training::Settings,
};

use super::{BODY, LayerMemory, SUMS, Training};

/// The frames of a segment that the decoder runs on.
pub(super) struct Decoded {
    /// The first of them.
    pub(super) from: usize,
    /// Their number.
    pub(super) frames: usize,
    /// Where they start in the memory of the mixer's outputs, the gradient by these, and the decoder's outputs.
    pub(super) mixed: Address,
    pub(super) d_mixed: Address,
    pub(super) output: Address,
}

impl Training {
    /// The means of frames `first..first + frames` over their particles, through the second Linear.
    pub(super) fn means(&self, first: usize, frames: usize) -> Result<()> {
        let (batch, rows) = (self.settings.batch, frames * self.settings.batch);
        let Constants { encoder, particles, .. } = self.constants;
        let sums = self.at(&self.sums, first, self.chunks * SUMS * encoder);
        let pooled = self.at(&self.pooled, first, self.constants.pooled_columns());
        let states: Argument = self.at(&self.states, first, particles * BODY).into();
        let rest: [Argument; 6] = [
            self.tables.windows.address().into(),
            self.tables.progress.address().into(),
            self.weight(&self.layout.points).into(),
            self.scaling.address().into(),
            sums.into(),
            batch.into(),
        ];
        let grid = [self.chunks, batch, frames * encoder.div_ceil(256)];
        let shape = Shape { grid, block: [256, 1], shared: 0 };
        if self.device.rounds_to_tf32() {
            let material = self.store.material.address().into();
            let arguments: Vec<_> = [states, material].into_iter().chain(rest).collect();
            self.launch(Kernel::EncodeTensor, shape, &arguments)?;
        } else {
            let order =
                [&self.store.order, &self.store.segments].map(|buffer| buffer.address().into());
            let arguments: Vec<_> = [states].into_iter().chain(order).chain(rest).collect();
            self.launch(Kernel::Encode, shape, &arguments)?;
        }
        self.launch(
            Kernel::Pool,
            Shape::new(rows, 1, 256),
            &[sums.into(), pooled.into(), self.chunks.into()],
        )?;
        let (matrix, columns) = (&self.layout.pooled, self.constants.input_columns());
        self.product(
            Queue::Main,
            [pooled, self.weight(matrix), self.at(&self.input, first, columns)],
            [false, false],
            [matrix.rows, matrix.columns, columns],
            [rows, matrix.rows, matrix.columns],
            false,
        )
    }

    /// Frames `first..first + frames` through the network.
    pub(super) fn forward(&self, first: usize, frames: usize) -> Result<()> {
        let (batch, wide) = (self.settings.batch, self.constants.hidden_columns());
        if self.constants.mean() {
            self.means(first, frames)?;
        }
        if let Some(maximum) = &self.maximum {
            self.maxima(maximum, first, frames)?;
        }
        let mut signal = self.at(&self.input, first, self.constants.input_columns());
        for number in 0..self.layers.len() {
            signal = self.core_forward(number, signal, first, frames)?;
        }

        let Decoded { from, frames, mixed, output, .. } = self.decoded(first, frames);
        let rows = frames * batch;
        let signal = signal.plus((from - first) * batch * wide);
        self.forward_product(&self.layout.mixer, signal, mixed, rows)?;
        self.launch(Kernel::ActivationForward, self.units(frames), &[mixed.into()])?;
        self.forward_product(&self.layout.decoder, mixed, output, rows)?;
        self.launch(
            Kernel::Advance,
            self.particles(frames),
            &[
                self.states.address().into(),
                self.output.address().into(),
                self.bodies().into(),
                self.tables.windows.address().into(),
                self.tables.progress.address().into(),
                self.store.material.address().into(),
                self.tables.error_weights.address().into(),
                self.squares.address().into(),
                self.frames_argument(),
                from.into(),
            ],
        )
    }

    /// What the decoder sees of frames `first..first + frames`.
    pub(super) fn decoded(&self, first: usize, frames: usize) -> Decoded {
        let decoded = self.settings.first_decoded();
        let (from, wide) = (first.max(decoded), self.constants.hidden_columns());
        Decoded {
            from,
            frames: first + frames - from,
            mixed: self.at(&self.mixed, from - decoded, wide),
            d_mixed: self.at(&self.d_mixed, from - decoded, wide),
            output: self.at(&self.output, from - decoded, self.constants.output_columns()),
        }
    }

    /// A layer of the core; gives where its outputs for these frames are.
    pub(super) fn core_forward(
        &self,
        number: usize,
        input: Address,
        first: usize,
        frames: usize,
    ) -> Result<Address> {
        let (batch, rows, wide) =
            (self.settings.batch, frames * self.settings.batch, self.constants.hidden_columns());
        let (layer, (matrix, recurrent)) = (&self.layers[number], &self.layout.core[number]);
        let gates = matrix.columns;
        let sums = self.at(&layer.sums, first, gates);
        let states = self.at(&layer.states, first, wide);
        self.forward_product(matrix, input, sums, rows)?;
        match (recurrent, &layer.recurrent) {
            (Some(recurrent), Some(products)) => {
                for t in first..first + frames {
                    let states = self.at(&layer.states, t, wide);
                    self.forward_product(recurrent, states, self.at(products, t, gates), batch)?;
                    self.cells_forward(layer, gates, t, 1)?;
                }
            }
            _ => self.cells_forward(layer, gates, first, frames)?,
        }
        let output = states.plus(batch * wide);
        let Some(dropped) = &layer.dropped else { return Ok(output) };
        let to = self.at(dropped, first, wide);
        self.dropout(number, output, to, first, frames, 1.0)?;
        Ok(to)
    }

    /// The states of frames `first..first + frames` from the sums.
    fn cells_forward(
        &self,
        layer: &LayerMemory,
        gates: usize,
        first: usize,
        frames: usize,
    ) -> Result<()> {
        let [sums, products, states, list] = self.cell_arguments(layer, gates, first);
        self.launch(
            Kernel::CellsForward,
            self.units(1),
            &[sums, products, states, list, frames.into()],
        )
    }

    /// What both kernels of the cells begin with: sums, products of the last outputs and states, from frame `first` on, and the
    /// numbers from a layer's outputs of all frames to its cells.
    pub(super) fn cell_arguments(
        &self,
        layer: &LayerMemory,
        gates: usize,
        first: usize,
    ) -> [Argument; 4] {
        let wide = self.constants.hidden_columns();
        let products = layer.recurrent.as_ref();
        let list = (self.frames() + 1) * self.settings.batch * wide;
        [
            self.at(&layer.sums, first, gates).into(),
            products.map_or(Address::NULL, |products| self.at(products, first, gates)).into(),
            self.at(&layer.states, first, wide).into(),
            (list as u64).into(),
        ]
    }

    /// Dropout of a layer's outputs, or of their gradients.
    pub(super) fn dropout(
        &self,
        layer: usize,
        from: Address,
        to: Address,
        first: usize,
        frames: usize,
        ones: f32,
    ) -> Result<()> {
        let (batch, hidden, rank) =
            (self.settings.batch, self.constants.hidden, self.device.rank());
        // Words are drawn in the order of the forward pass: the warm-up's frames layer by layer, then frame by frame; in a
        // frame for the whole batch, of which this device has the windows from `rank.number * batch` on.
        let before = first * self.layers.len() + layer * frames;
        let together = if rank.count == 1 { frames } else { 1 };
        for frame in (0..frames).step_by(together) {
            let window = (before + frame) * batch * rank.count + rank.number * batch;
            let rows = together * batch;
            // Blocks of 16 words need not begin with the numbers.
            let blocks = (rows * hidden).div_ceil(16) + 1;
            let skipped = frame * batch * self.constants.hidden_columns();
            self.launch(
                Kernel::Dropout,
                Shape::new(blocks.div_ceil(128), 1, 128),
                &[
                    from.plus(skipped).into(),
                    to.plus(skipped).into(),
                    self.tables.schedule.address().into(),
                    self.tables.progress.address().into(),
                    ((window * hidden) as u64).into(),
                    rows.into(),
                    self.settings.dropout.into(),
                    ones.into(),
                ],
            )?;
        }
        Ok(())
    }

    /// Density maps and the loss, once all frames are predicted.
    pub(super) fn loss(&self) -> Result<()> {
        let Settings {
            batch,
            unroll,
            density_weight,
            density_nodes,
            observed_weight,
            relative,
            error_floor,
            ..
        } = self.settings;
        let nodes = density_nodes.pow(AXES as u32);
        let factor = if self.density_gradient.is_some() {
            density_weight / (unroll * batch * nodes) as f32
        } else {
            0.0
        };
        if let Some(gradient) = &self.density_gradient {
            let mut grid: Vec<u32> =
                self.grid.iter().flatten().map(|number| number.to_bits()).collect();
            grid.push(density_nodes as u32);
            self.launch(
                Kernel::Density,
                Shape { grid: [unroll, batch, 1], block: [256, 1], shared: 8 * nodes },
                &[
                    self.states.address().into(),
                    self.output.address().into(),
                    self.bodies().into(),
                    self.tables.windows.address().into(),
                    self.tables.progress.address().into(),
                    self.densities.address().into(),
                    gradient.address().into(),
                    self.frames_argument(),
                    Argument::from_bytes(bytemuck::cast_slice(&grid)),
                    factor.into(),
                ],
            )?;
        }
        self.launch(
            Kernel::Loss,
            Shape::new(1, 1, 256),
            &[
                self.squares.address().into(),
                self.constants.particles.div_ceil(256).into(),
                self.densities.address().into(),
                factor.into(),
                self.unroll_argument(),
                usize::from(relative).into(),
                error_floor.into(),
                observed_weight.into(),
                self.scales.address().into(),
                self.tables.progress.address().into(),
                self.tables.outcomes.address().into(),
            ],
        )
    }
}
