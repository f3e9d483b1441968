//! Frames through the network, and the loss.

use eddy_inference::checkpoint::plan::FrameStage;

use crate::{
    device::{Pointer, Queue, Shape, count},
    error::Result,
    kernels::{
        AXES, Constants,
        frame::{
            cells::{ActivationForward, CellsForward, Dropout},
            encoder::{Encode, EncodeTensor, Pool},
            loss::{Advance, Density},
        },
        training::batch_loss::Loss,
    },
    training::Settings,
};

use super::{LayerMemory, Training};

/// The frames of a segment that the decoder runs on.
pub(super) struct Decoded {
    /// The first of them.
    pub(super) from: usize,
    /// Their number.
    pub(super) frames: usize,
    /// Where they start in the memory of the mixer's outputs, the gradient by these, and the decoder's outputs.
    pub(super) mixed: Pointer<f32>,
    pub(super) d_mixed: Pointer<f32>,
    pub(super) output: Pointer<f32>,
}

impl Training {
    /// The means of frames `first..first + frames` over their particles, through the second Linear.
    fn means(&self, first: usize, frames: usize) -> Result<()> {
        let (batch, rows) = (self.settings.batch, frames * self.settings.batch);
        let Constants { encoder, particles, .. } = self.constants;
        let sums =
            self.at(&self.sums, first, self.chunks * self.constants.encoder_sums() * encoder);
        let pooled = self.at(&self.pooled, first, self.constants.pooled_columns());
        let states = self.at(&self.states, first, particles);
        let (windows, progress) = (self.tables.windows.pointer(), self.tables.progress.pointer());
        let (w, scaling) = (self.weight(&self.layout.points), self.scaling.pointer());
        let grid = [self.chunks, batch, frames * encoder.div_ceil(256)];
        let (shape, batch) = (Shape { grid, block: [256, 1], shared: 0 }, count(batch));
        if self.device.rounds_to_tf32() {
            let material = self.store.material.pointer();
            self.launch(
                shape,
                EncodeTensor { states, material, windows, progress, w, scaling, sums, batch },
            )?;
        } else {
            let (order, segments) = (self.store.order.pointer(), self.store.segments.pointer());
            self.launch(
                shape,
                Encode { states, order, segments, windows, progress, w, scaling, sums, batch },
            )?;
        }
        self.launch(Shape::new(rows, 1, 256), Pool { sums, pooled, chunks: count(self.chunks) })?;
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
        self.stages.iter().try_for_each(|&stage| match stage {
            FrameStage::Means => self.means(first, frames),
            FrameStage::Maxima => {
                let maximum = self.maximum.as_ref();
                maximum.map_or(Ok(()), |maximum| self.maxima(maximum, first, frames))
            }
            FrameStage::Core(number) => self.core_forward(number, first, frames),
            FrameStage::Mix => self.mix(first, frames),
            FrameStage::Decode => self.decode(first, frames),
        })
    }

    fn mix(&self, first: usize, frames: usize) -> Result<()> {
        let Decoded { from, frames, mixed, .. } = self.decoded(first, frames);
        let signal = self.outputs(self.layers.len() - 1);
        let signal = signal.plus(from * self.settings.batch * self.constants.hidden_columns());
        self.forward_product(&self.layout.mixer, signal, mixed, frames * self.settings.batch)?;
        self.launch(self.units(frames), ActivationForward { y: mixed })
    }

    fn decode(&self, first: usize, frames: usize) -> Result<()> {
        let Decoded { from, frames, mixed, output, .. } = self.decoded(first, frames);
        let rows = frames * self.settings.batch;
        self.forward_product(&self.layout.decoder, mixed, output, rows)?;
        self.launch(
            self.particles(frames),
            Advance {
                states: self.states.pointer(),
                output: self.output.pointer(),
                store: self.bodies(),
                windows: self.tables.windows.pointer(),
                progress: self.tables.progress.pointer(),
                material: self.store.material.pointer(),
                weights: self.tables.error_weights.pointer(),
                squares: self.squares.pointer(),
                f: self.frames_argument(),
                first: count(from),
            },
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

    /// A layer of the core.
    fn core_forward(&self, number: usize, first: usize, frames: usize) -> Result<()> {
        let (batch, rows, wide) =
            (self.settings.batch, frames * self.settings.batch, self.constants.hidden_columns());
        let (layer, (matrix, recurrent)) = (&self.layers[number], &self.layout.core[number]);
        let gates = matrix.columns;
        let sums = self.at(&layer.sums, first, gates);
        let input = match number {
            0 => self.at(&self.input, first, self.constants.input_columns()),
            _ => self.outputs(number - 1).plus(first * batch * wide),
        };
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
        let Some(dropped) = &layer.dropped else { return Ok(()) };
        let output = self.at(&layer.states, first + 1, wide);
        self.dropout(number, output, self.at(dropped, first, wide), first, frames, 1.0)
    }

    /// The states of frames `first..first + frames` from the sums.
    fn cells_forward(
        &self,
        layer: &LayerMemory,
        gates: usize,
        first: usize,
        frames: usize,
    ) -> Result<()> {
        self.launch(
            self.units(1),
            CellsForward {
                sums: self.at(&layer.sums, first, gates),
                recurrent: self.recurrent(layer, gates, first),
                states: self.at(&layer.states, first, self.constants.hidden_columns()),
                list: self.numbers_of_states(),
                frames: count(frames),
            },
        )
    }

    /// The products of a layer's last outputs from frame `first` on, where its core has them.
    pub(super) fn recurrent(
        &self,
        layer: &LayerMemory,
        gates: usize,
        first: usize,
    ) -> Pointer<f32> {
        let products = layer.recurrent.as_ref();
        products.map_or(Pointer::NULL, |products| self.at(products, first, gates))
    }

    /// From a layer's outputs of all frames to its cells.
    pub(super) fn numbers_of_states(&self) -> u64 {
        count((self.frames() + 1) * self.settings.batch * self.constants.hidden_columns())
    }

    /// Dropout of a layer's outputs, or of their gradients.
    pub(super) fn dropout(
        &self,
        layer: usize,
        from: Pointer<f32>,
        to: Pointer<f32>,
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
                Shape::new(blocks.div_ceil(128), 1, 128),
                Dropout {
                    from: from.plus(skipped),
                    to: to.plus(skipped),
                    schedule: self.tables.schedule.pointer(),
                    progress: self.tables.progress.pointer(),
                    first: count(window * hidden),
                    rows: count(rows),
                    rate: self.settings.dropout,
                    ones,
                },
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
            self.launch(
                Shape { grid: [unroll, batch, 1], block: [256, 1], shared: 8 * nodes },
                Density {
                    states: self.states.pointer(),
                    output: self.output.pointer(),
                    store: self.bodies(),
                    windows: self.tables.windows.pointer(),
                    progress: self.tables.progress.pointer(),
                    densities: self.densities.pointer(),
                    gradient: gradient.pointer(),
                    f: self.frames_argument(),
                    grid: self.grid,
                    factor,
                },
            )?;
        }
        self.launch(
            Shape::new(1, 1, 256),
            Loss {
                squares: self.squares.pointer(),
                chunks: count(self.constants.particles.div_ceil(256)),
                densities: self.densities.pointer(),
                density_factor: factor,
                f: self.unroll_argument(),
                relative: relative.into(),
                error_floor,
                observed_weight,
                scales: self.scales.pointer(),
                progress: self.tables.progress.pointer(),
                outcomes: self.tables.outcomes.pointer(),
            },
        )
    }
}
