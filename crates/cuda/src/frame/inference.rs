//! Streams predicted on a device: a frame of up to [`MOST_STREAMS`] streams at once, their states stay on the device.
//!
//! Frames and predictions lie in memory of the host that the device reads and writes itself, so that a step is one graph
//! without copies. There is a graph for each of a few numbers of rows; rows that no stream needs compute with an idle one.

#![expect(unsafe_code, reason = "launches, and memory that the device reads and writes")]

use std::{collections::BTreeMap, num::NonZeroUsize, sync::Arc};

use eddy_inference::{
    checkpoint::{Description, Weights},
    engine::StreamStart,
};
use eddy_threads::{DisjointSlice, Task, ThreadPool};

use super::{layout::Layout, maximum::Points, stream::Memory};
use crate::{
    device::{Address, Argument, Buffer, Device, HostBuffer, Queue, Shape},
    error::Result,
    graphs::Graphs,
    kernels::{AXES, Constants, Kernel, motion, scaling},
    streams::{Body, Step, StreamModel, copy_bodies, copy_motion, copy_threads},
    training::{InTraining, Matrix},
};

/// Streams of a step.
pub const MOST_STREAMS: usize = 64;
/// Rows that graphs are made for.
const SIZES: [usize; 5] = [1, 8, 16, 32, MOST_STREAMS];
/// Particles of a block of the encoder, `STREAM_TILE` of the kernels.
const TILE: usize = 64;
/// Rows of a matrix in a part of a product, `PART` of the kernels.
const PART: usize = 64;
/// Rows that `product_of_rows` takes at once.
const ROWS: usize = 8;
/// Streams whose particles' outputs are in memory at the same time, for a pooling by the maximum.
const GROUP: usize = 8;
/// Numbers in 256 bytes: products of memory that is aligned alike are computed alike.
const ALIGNMENT: usize = 64;
/// Numbers of a body.
const BODY: usize = size_of::<Body>() / size_of::<f32>();

/// Streams from which on several threads copy frames.
const WORTH_THREADS: usize = 4;
/// Threads that copy, unless another number is given: more do not make the memory faster.
const COPY_THREADS: usize = 4;

/// A frame model that predicts streams on a device.
pub struct Inference {
    device: Arc<dyn Device>,
    constants: Constants,
    layout: Layout,
    /// `struct Motion` of the kernels.
    motion: [[f32; AXES]; 6],
    weights: Buffer,
    scaling: Buffer,
    rows: Buffer,
    frames: Buffer,
    /// States before the frame, `[layers, B, HP]`.
    before: Buffer,
    sums: Buffer,
    pooled: Buffer,
    /// Of the core, `[B, IP]`.
    input: Buffer,
    /// For a pooling by the maximum.
    points: Option<Points>,
    signal: Buffer,
    /// Parts of a product, and of one with the states.
    parts: [Buffer; 2],
    host_rows: HostBuffer,
    host_frames: HostBuffer,
    host_next: HostBuffer,
    /// For rows without a stream.
    idle: Memory,
    /// Copies frames to and from the memory of the host.
    threads: ThreadPool,
    /// By the number of rows.
    graphs: Graphs<usize>,
}

impl Inference {
    /// The network of a checkpoint on a device that has its kernels.
    ///
    /// # Errors
    /// [`CudaError::Unsupported`](crate::CudaError::Unsupported), [`CudaError::Memory`](crate::CudaError::Memory),
    /// [`CudaError::Call`](crate::CudaError::Call).
    pub fn new(
        device: Arc<dyn Device>,
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
    ) -> Result<Self> {
        let constants = Constants::of(description)?;
        let layout = Layout::new(description, &constants);
        let (particles, wide) = (constants.particles, constants.hidden_columns());
        let numbers = |count: usize| device.allocate(4 * count);
        let parts = layout
            .packing
            .matrices()
            .iter()
            .map(|matrix| matrix.rows.div_ceil(PART) * matrix.columns);
        let parts = MOST_STREAMS * parts.max().unwrap_or_default();
        let recurrent = layout.core.iter().any(|(_, recurrent)| recurrent.is_some());
        let inference = Self {
            weights: numbers(layout.packing.size)?,
            scaling: numbers(2 * BODY)?,
            rows: numbers(MOST_STREAMS * 6)?,
            frames: numbers(MOST_STREAMS * particles * BODY)?,
            before: numbers(layout.core.len() * MOST_STREAMS * wide)?,
            sums: numbers(MOST_STREAMS * particles.div_ceil(TILE) * constants.encoder)?,
            pooled: numbers(MOST_STREAMS * constants.pooled_columns())?,
            input: numbers(MOST_STREAMS * constants.input_columns())?,
            points: constants
                .maximum()
                .then(|| Points::new(&*device, &constants, GROUP, ALIGNMENT))
                .transpose()?,
            signal: numbers(MOST_STREAMS * wide)?,
            parts: [numbers(parts)?, numbers(if recurrent { parts } else { 0 })?],
            host_rows: device.allocate_host(MOST_STREAMS * size_of::<[u64; 3]>())?,
            host_frames: device.allocate_host(MOST_STREAMS * particles * size_of::<Body>())?,
            host_next: device.allocate_host(MOST_STREAMS * particles * size_of::<Body>())?,
            idle: Memory::new(device.clone(), &constants, &layout, &vec![0; particles])?,
            threads: copy_threads(None, COPY_THREADS),
            graphs: Graphs::new(SIZES.len()),
            motion: motion(description),
            constants,
            layout,
            device,
        };
        let Self { device, weights, scaling: scales, layout, .. } = &inference;
        device.write(weights, 0, bytemuck::cast_slice(&layout.pack(tensors)))?;
        device.write(scales, 0, bytemuck::cast_slice(&scaling(description)))?;
        Ok(inference)
    }

    /// The same, with this number of threads that copy frames between the program's memory and the device's, if one is given.
    #[must_use]
    pub fn with_threads(self, threads: Option<NonZeroUsize>) -> Self {
        Self { threads: copy_threads(threads, COPY_THREADS), ..self }
    }

    /// One frame of each stream, at most [`MOST_STREAMS`].
    fn predict(&mut self, steps: &mut [Step<'_, Memory>]) -> Result<()> {
        let Some(&rows) = SIZES.iter().find(|&&rows| rows >= steps.len()) else {
            panic!("{} streams, at most {MOST_STREAMS}", steps.len());
        };
        let particles = self.constants.particles;
        let alone = steps.len() < WORTH_THREADS;
        {
            // SAFETY: the last step has finished, and nothing else uses this memory.
            let (table, frames) =
                unsafe { (self.host_rows.slice::<[u64; 3]>(), self.host_frames.slice::<Body>()) };
            let memories = steps.iter().map(|(memory, ..)| *memory);
            for (row, memory) in
                table.iter_mut().zip(memories.chain(std::iter::repeat(&self.idle))).take(rows)
            {
                *row = memory.row();
            }
            let (steps, frames) = (&*steps, DisjointSlice::new(frames));
            self.threads.run([steps.len()], alone, &|Task { item, .. }| {
                // SAFETY: each item runs once.
                let bodies = unsafe { frames.part(item * particles..(item + 1) * particles) };
                copy_bodies(&steps[item].1, 0, bodies);
            });
        }
        self.run(rows)?;
        // SAFETY: as above.
        let next = unsafe { self.host_next.slice::<Body>() };
        let (steps, next) = (DisjointSlice::new(steps), &*next);
        self.threads.run([steps.len()], alone, &|Task { item, .. }| {
            // SAFETY: each item runs once.
            let (.., frame) = &mut unsafe { steps.part(item..item + 1) }[0];
            copy_motion(&next[item * particles..], &mut frame.position, &mut frame.velocity);
        });
        Ok(())
    }

    /// A step of so many rows, from the memory of the host to the memory of the host.
    fn run(&mut self, rows: usize) -> Result<()> {
        self.graphs.run(&*self.device, rows, || self.launch_all(rows))?;
        self.device.finish()
    }

    fn launch(&self, kernel: Kernel, shape: Shape, arguments: &[Argument]) -> Result<()> {
        // SAFETY: every call of this file passes the kernel's parameters in type and order, and buffers that `new` has made
        // for these shapes.
        unsafe { self.device.launch(Queue::Main, kernel, shape, arguments) }
    }

    fn weight(&self, matrix: &Matrix) -> Address {
        self.weights.address().plus(matrix.first)
    }

    /// The parts of `left W`, and how many there are.
    fn product(
        &self,
        matrix: &Matrix,
        left: Address,
        parts: &Buffer,
        rows: usize,
    ) -> Result<usize> {
        let count = matrix.rows.div_ceil(PART);
        let (kernel, groups) = match rows {
            1 => (Kernel::ProductOfRow, 1),
            _ => (Kernel::ProductOfRows, rows.div_ceil(ROWS)),
        };
        let grid = [matrix.columns.div_ceil(128), count, groups];
        self.launch(
            kernel,
            Shape { grid, block: [256, 1], shared: 0 },
            &[
                left.into(),
                self.weight(matrix).into(),
                parts.address().into(),
                matrix.rows.into(),
                matrix.columns.into(),
                rows.into(),
            ],
        )?;
        Ok(count)
    }

    /// A linear layer; rows of its outputs are `stride` numbers apart.
    fn linear(
        &self,
        matrix: &Matrix,
        [left, outputs]: [Address; 2],
        stride: usize,
        active: bool,
        rows: usize,
    ) -> Result<()> {
        let [parts, _] = &self.parts;
        let count = self.product(matrix, left, parts, rows)?;
        self.launch(
            Kernel::LinearStreams,
            self.units(rows),
            &[
                parts.address().into(),
                outputs.into(),
                count.into(),
                usize::from(active).into(),
                stride.into(),
            ],
        )
    }

    /// The means of the particles, through the second Linear.
    fn means(&self, rows: usize) -> Result<()> {
        let Constants { encoder, particles, .. } = self.constants;
        let chunks = particles.div_ceil(TILE);
        self.launch(
            Kernel::EncodeStreams,
            Shape { grid: [chunks, rows, encoder.div_ceil(256)], block: [256, 1], shared: 0 },
            &[
                self.frames.address().into(),
                self.rows.address().into(),
                self.weight(&self.layout.points).into(),
                self.scaling.address().into(),
                self.sums.address().into(),
            ],
        )?;
        self.launch(
            Kernel::PoolStreams,
            Shape::new(rows, 1, 256),
            &[self.sums.address().into(), self.pooled.address().into(), chunks.into()],
        )?;
        let ends = [self.pooled.address(), self.input.address()];
        self.linear(&self.layout.pooled, ends, self.constants.input_columns(), false, rows)
    }

    /// The maxima over the particles of the second Linear's outputs, for groups of streams.
    fn maxima(&self, points: &Points, rows: usize) -> Result<()> {
        let particles = self.constants.particles;
        for first in (0..rows).step_by(GROUP) {
            let rows = GROUP.min(rows - first);
            self.launch(
                Kernel::EncodePointsOfStreams,
                points.shape(particles, rows),
                &[
                    self.frames.address().plus(first * particles * BODY).into(),
                    self.rows.address().plus_bytes(first * size_of::<[u64; 3]>()).into(),
                    self.weight(&self.layout.points).into(),
                    self.scaling.address().into(),
                    points.inputs.address().into(),
                    (points.strides[0] as u64).into(),
                ],
            )?;
            // A product for each stream: its bits do not depend on their number.
            for row in 0..rows {
                let product = points.product(&self.layout.pooled, row, particles, &self.weights);
                // SAFETY: buffers are those that `new` has made for these sizes.
                unsafe { self.device.multiply(Queue::Main, &product) }?;
            }
            let columns = self.constants.input_columns();
            let input = self.input.address().plus(first * columns);
            self.launch(
                Kernel::Largest,
                Points::largest(&self.constants, rows),
                &[
                    points.outputs.address().into(),
                    (points.strides[1] as u64).into(),
                    input.into(),
                    Address::NULL.into(),
                ],
            )?;
        }
        Ok(())
    }

    /// Blocks over the hidden units of rows.
    fn units(&self, rows: usize) -> Shape {
        Shape::new(self.constants.hidden_columns().div_ceil(128), rows, 128)
    }

    /// Puts a step of so many rows into the queue.
    fn launch_all(&self, rows: usize) -> Result<()> {
        let particles = self.constants.particles;
        let (wide, layers) = (self.constants.hidden_columns(), self.layout.core.len());
        let signal = self.signal.address();
        self.launch(
            Kernel::LoadStreams,
            Shape::new(particles.max(layers * wide).div_ceil(256), rows, 256),
            &[
                self.host_rows.address().into(),
                self.host_frames.address().into(),
                self.rows.address().into(),
                self.frames.address().into(),
                self.before.address().into(),
                layers.into(),
            ],
        )?;
        if self.constants.mean() {
            self.means(rows)?;
        }
        if let Some(points) = &self.points {
            self.maxima(points, rows)?;
        }
        (0..layers).try_for_each(|layer| self.core_layer(layer, rows))?;
        self.linear(&self.layout.mixer, [signal, signal], wide, true, rows)?;
        let [parts, _] = &self.parts;
        let count = self.product(&self.layout.decoder, signal, parts, rows)?;
        self.launch(
            Kernel::PredictStreams,
            Shape::new(particles.div_ceil(256), rows, 256),
            &[
                parts.address().into(),
                self.frames.address().into(),
                self.host_next.address().into(),
                count.into(),
                Argument::from_bytes(bytemuck::cast_slice(&self.motion)),
            ],
        )
    }

    fn core_layer(&self, layer: usize, rows: usize) -> Result<()> {
        let (matrix, recurrent) = &self.layout.core[layer];
        let signal = self.signal.address();
        let input = if layer == 0 { self.input.address() } else { signal };
        let wide = self.constants.hidden_columns();
        let [parts, recurrent_parts] = &self.parts;
        let before = self.before.address().plus(layer * rows * wide);
        let count = self.product(matrix, input, parts, rows)?;
        let recurrent_count = match recurrent {
            Some(recurrent) => self.product(recurrent, before, recurrent_parts, rows)?,
            None => 0,
        };
        self.launch(
            Kernel::CellsStreams,
            self.units(rows),
            &[
                parts.address().into(),
                recurrent_parts.address().into(),
                before.into(),
                self.rows.address().into(),
                signal.into(),
                count.into(),
                recurrent_count.into(),
                layer.into(),
                self.layout.core.len().into(),
            ],
        )
    }
}

impl StreamModel for Inference {
    type Memory = Memory;

    const MOST: usize = MOST_STREAMS;

    fn memory(&mut self, stream: &StreamStart<'_>) -> Result<Memory> {
        let Self { device, constants, layout, .. } = self;
        Memory::new(Arc::clone(device), constants, layout, stream.material)
    }

    fn step(&mut self, steps: &mut [Step<'_, Memory>]) -> Result<()> {
        self.predict(steps)
    }
}

/// A frame model on a device, as the streaming engine uses it.
pub type Streams = crate::streams::Streams<Inference>;

impl Streams {
    /// Takes other weights of the network.
    ///
    /// # Errors
    /// [`CudaError::Call`](crate::CudaError::Call).
    ///
    /// # Panics
    /// With tensors of another network.
    pub fn set_weights(&self, tensors: &BTreeMap<String, Weights>) -> Result<()> {
        self.alone(|inference| {
            let weights = inference.layout.pack(tensors);
            inference.device.write(&inference.weights, 0, bytemuck::cast_slice(&weights))
        })
    }

    /// Takes the weights that a training on the same device has now, averaged if it keeps an average.
    ///
    /// # Errors
    /// [`CudaError::Call`](crate::CudaError::Call).
    ///
    /// # Panics
    /// With a training of another network.
    pub fn copy_weights(&self, training: &dyn InTraining) -> Result<()> {
        self.alone(|inference| {
            inference.device.copy(&inference.weights, training.optimizer().averaged_weights())
        })
    }
}
