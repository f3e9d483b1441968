//! Streams predicted on a device: a frame of up to [`MOST_STREAMS`] streams at once, their states stay on the device.
//!
//! Frames and predictions lie in memory of the host that the device reads and writes itself, so that a step is one graph
//! without copies. There is a graph for each of a few numbers of rows; rows that no stream needs compute with an idle one.

#![expect(unsafe_code, reason = "launches, and memory that the device reads and writes")]

use std::{collections::BTreeMap, num::NonZeroUsize, sync::Arc};

use eddy_inference::{
    checkpoint::{
        Description, Weights,
        plan::{FrameStage, Plan},
    },
    engine::StreamStart,
};
use eddy_threads::{DisjointSlice, Task, ThreadPool};

use super::{layout::Layout, maximum::Points, stream::Memory};
use crate::{
    device::{Device, HostBuffer, Kernel, List, Pointer, Queue, Shape, count},
    error::Result,
    graphs::Graphs,
    kernels::{
        Constants,
        frame::{
            encoder::Scaling,
            inference::{
                CellsStreams, EncodeStreams, LinearStreams, LoadStreams, PART, PoolStreams,
                PredictStreams, ProductOfRow, ProductOfRows, Row, STREAM_TILE,
            },
            maximum::{EncodePointsOfStreams, Largest},
            motion::Motion,
        },
        motion, scaling,
    },
    streams::{Body, Step, StreamModel, copy_bodies, copy_motion, copy_threads},
    training::{InTraining, Matrix},
};

/// Streams of a step.
pub const MOST_STREAMS: usize = 64;
/// Rows that graphs are made for.
const SIZES: [usize; 5] = [1, 8, 16, 32, MOST_STREAMS];
/// Rows that `product_of_rows` takes at once.
const ROWS: usize = 8;
/// Streams whose particles' outputs are in memory at the same time, for a pooling by the maximum.
const GROUP: usize = 8;
/// Numbers in 256 bytes: products of memory that is aligned alike are computed alike.
const ALIGNMENT: usize = 64;

/// Streams from which on several threads copy frames.
const WORTH_THREADS: usize = 4;
/// Threads that copy, unless another number is given: more do not make the memory faster.
const COPY_THREADS: usize = 4;

/// A frame model that predicts streams on a device.
pub struct Inference {
    device: Arc<dyn Device>,
    constants: Constants,
    layout: Layout,
    stages: Vec<FrameStage>,
    motion: Motion,
    weights: List<f32>,
    scaling: List<Scaling>,
    rows: List<Row>,
    /// `[B, N]`.
    frames: List<Body>,
    /// States before the frame, `[layers, B, HP]`.
    before: List<f32>,
    sums: List<f32>,
    pooled: List<f32>,
    /// Of the core, `[B, IP]`.
    input: List<f32>,
    /// For a pooling by the maximum.
    points: Option<Points>,
    signal: List<f32>,
    /// Parts of a product, and of one with the states.
    parts: [List<f32>; 2],
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
        let numbers = |count: usize| List::new(&*device, count);
        let parts = layout
            .packing
            .matrices()
            .iter()
            .map(|matrix| matrix.rows.div_ceil(PART) * matrix.columns);
        let parts = MOST_STREAMS * parts.max().unwrap_or_default();
        let recurrent = layout.core.iter().any(|(_, recurrent)| recurrent.is_some());
        let inference = Self {
            weights: numbers(layout.packing.size)?,
            scaling: List::of(&*device, &[scaling(description)])?,
            rows: List::new(&*device, MOST_STREAMS)?,
            frames: List::new(&*device, MOST_STREAMS * particles)?,
            before: numbers(layout.core.len() * MOST_STREAMS * wide)?,
            sums: numbers(MOST_STREAMS * particles.div_ceil(STREAM_TILE) * constants.encoder)?,
            pooled: numbers(MOST_STREAMS * constants.pooled_columns())?,
            input: numbers(MOST_STREAMS * constants.input_columns())?,
            points: constants
                .maximum()
                .then(|| Points::new(&*device, &constants, GROUP, ALIGNMENT))
                .transpose()?,
            signal: numbers(MOST_STREAMS * wide)?,
            parts: [numbers(parts)?, numbers(if recurrent { parts } else { 0 })?],
            host_rows: device.allocate_host(MOST_STREAMS * size_of::<Row>())?,
            host_frames: device.allocate_host(MOST_STREAMS * particles * size_of::<Body>())?,
            host_next: device.allocate_host(MOST_STREAMS * particles * size_of::<Body>())?,
            idle: Memory::new(device.clone(), &constants, &layout, &vec![0; particles])?,
            threads: copy_threads(None, COPY_THREADS),
            graphs: Graphs::new(SIZES.len()),
            motion: motion(description),
            stages: Plan::new(description).frame_stages(),
            constants,
            layout,
            device,
        };
        let Self { device, weights, layout, .. } = &inference;
        device.write(weights, 0, bytemuck::cast_slice(&layout.pack(tensors)))?;
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
                unsafe { (self.host_rows.slice::<Row>(), self.host_frames.slice::<Body>()) };
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

    fn launch(&self, shape: Shape, kernel: impl Kernel) -> Result<()> {
        // SAFETY: every call of this file passes buffers that `new` has made for these shapes.
        unsafe { self.device.launch(Queue::Main, shape, &kernel) }
    }

    fn weight(&self, matrix: &Matrix) -> Pointer<f32> {
        self.weights.pointer().plus(matrix.first)
    }

    /// The parts of `left W`, and how many there are.
    fn product(
        &self,
        matrix: &Matrix,
        left: Pointer<f32>,
        parts: &List<f32>,
        rows: usize,
    ) -> Result<usize> {
        let number = matrix.rows.div_ceil(PART);
        let (w, parts) = (self.weight(matrix), parts.pointer());
        let [inner, columns, batch] = [matrix.rows, matrix.columns, rows].map(count);
        let shape = |groups| {
            let grid = [matrix.columns.div_ceil(128), number, groups];
            Shape { grid, block: [256, 1], shared: 0 }
        };
        match rows {
            1 => self.launch(shape(1), ProductOfRow { left, w, parts, inner, columns, batch })?,
            _ => self.launch(
                shape(rows.div_ceil(ROWS)),
                ProductOfRows { left, w, parts, inner, columns, batch },
            )?,
        }
        Ok(number)
    }

    /// A linear layer; rows of its outputs are `stride` numbers apart.
    fn linear(
        &self,
        matrix: &Matrix,
        [left, signal]: [Pointer<f32>; 2],
        stride: usize,
        active: bool,
        rows: usize,
    ) -> Result<()> {
        let [parts, _] = &self.parts;
        let number = self.product(matrix, left, parts, rows)?;
        self.launch(
            self.units(rows),
            LinearStreams {
                parts: parts.pointer(),
                signal,
                count: count(number),
                active: active.into(),
                stride: count(stride),
            },
        )
    }

    /// The means of the particles, through the second Linear.
    fn means(&self, rows: usize) -> Result<()> {
        let Constants { encoder, particles, .. } = self.constants;
        let chunks = particles.div_ceil(STREAM_TILE);
        self.launch(
            Shape { grid: [chunks, rows, encoder.div_ceil(256)], block: [256, 1], shared: 0 },
            EncodeStreams {
                frames: self.frames.pointer(),
                rows: self.rows.pointer(),
                w: self.weight(&self.layout.points),
                scaling: self.scaling.pointer(),
                sums: self.sums.pointer(),
            },
        )?;
        let (sums, pooled) = (self.sums.pointer(), self.pooled.pointer());
        let pool = PoolStreams { sums, pooled, chunks: count(chunks) };
        self.launch(Shape::new(rows, 1, 256), pool)?;
        let ends = [pooled, self.input.pointer()];
        self.linear(&self.layout.pooled, ends, self.constants.input_columns(), false, rows)
    }

    /// The maxima over the particles of the second Linear's outputs, for groups of streams.
    fn maxima(&self, points: &Points, rows: usize) -> Result<()> {
        let particles = self.constants.particles;
        for first in (0..rows).step_by(GROUP) {
            let rows = GROUP.min(rows - first);
            self.launch(
                points.shape(particles, rows),
                EncodePointsOfStreams {
                    frames: self.frames.pointer().plus(first * particles),
                    rows: self.rows.pointer().plus(first),
                    w: self.weight(&self.layout.points),
                    scaling: self.scaling.pointer(),
                    points: points.inputs.pointer(),
                    stride: count(points.strides[0]),
                },
            )?;
            // A product for each stream: its bits do not depend on their number.
            for row in 0..rows {
                let product = points.product(&self.layout.pooled, row, particles, &self.weights);
                // SAFETY: buffers are those that `new` has made for these sizes.
                unsafe { self.device.multiply(Queue::Main, &product) }?;
            }
            let columns = self.constants.input_columns();
            self.launch(
                Points::largest(&self.constants, rows),
                Largest {
                    outputs: points.outputs.pointer(),
                    stride: count(points.strides[1]),
                    input: self.input.pointer().plus(first * columns),
                    which: Pointer::NULL,
                },
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
        self.launch(
            Shape::new(particles.max(layers * wide).div_ceil(256), rows, 256),
            LoadStreams {
                host_rows: self.host_rows.pointer(),
                host_frames: self.host_frames.pointer(),
                rows: self.rows.pointer(),
                frames: self.frames.pointer(),
                before: self.before.pointer(),
                layers: count(layers),
            },
        )?;
        self.stages.iter().try_for_each(|&stage| self.stage(stage, rows))
    }

    fn stage(&self, stage: FrameStage, rows: usize) -> Result<()> {
        let signal = self.signal.pointer();
        match stage {
            FrameStage::Means => self.means(rows),
            FrameStage::Maxima => {
                self.points.as_ref().map_or(Ok(()), |points| self.maxima(points, rows))
            }
            FrameStage::Core(layer) => self.core_layer(layer, rows),
            FrameStage::Mix => {
                let wide = self.constants.hidden_columns();
                self.linear(&self.layout.mixer, [signal, signal], wide, true, rows)
            }
            FrameStage::Decode => self.decode(signal, rows),
        }
    }

    /// The predicted frames.
    fn decode(&self, signal: Pointer<f32>, rows: usize) -> Result<()> {
        let [parts, _] = &self.parts;
        let number = self.product(&self.layout.decoder, signal, parts, rows)?;
        self.launch(
            Shape::new(self.constants.particles.div_ceil(256), rows, 256),
            PredictStreams {
                parts: parts.pointer(),
                frames: self.frames.pointer(),
                host_frames: self.host_next.pointer(),
                count: count(number),
                motion: self.motion,
            },
        )
    }

    fn core_layer(&self, layer: usize, rows: usize) -> Result<()> {
        let (matrix, recurrent) = &self.layout.core[layer];
        let signal = self.signal.pointer();
        let input = if layer == 0 { self.input.pointer() } else { signal };
        let wide = self.constants.hidden_columns();
        let [parts, recurrent_parts] = &self.parts;
        let before = self.before.pointer().plus(layer * rows * wide);
        let number = self.product(matrix, input, parts, rows)?;
        let recurrent_number = match recurrent {
            Some(recurrent) => self.product(recurrent, before, recurrent_parts, rows)?,
            None => 0,
        };
        self.launch(
            self.units(rows),
            CellsStreams {
                parts: parts.pointer(),
                recurrent: recurrent_parts.pointer(),
                before,
                rows: self.rows.pointer(),
                signal,
                count: count(number),
                recurrent_count: count(recurrent_number),
                layer: count(layer),
                layers: count(self.layout.core.len()),
            },
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
