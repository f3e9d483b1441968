//! Streams predicted on a device: a frame of up to [`MOST_STREAMS`] streams at once, their states stay on the device.
//!
//! Frames and predictions lie in memory of the host that the device reads and writes itself, so that a step is one graph
//! without copies. There is a graph for each of a few numbers of rows; rows that no stream needs compute with an idle one.

#![expect(unsafe_code, reason = "launches, and memory that the device reads and writes")]

use std::{
    any::Any,
    collections::{BTreeMap, HashMap},
    num::NonZeroUsize,
    sync::{Arc, Mutex, MutexGuard},
};

use eddy_frames::{Frame, FrameView, Particles};
use eddy_inference::{
    checkpoint::{Core, Description, Weights},
    engine::{Accelerator, DeviceState, DeviceStep, ModelError, StreamStart},
};

use eddy_threads::{DisjointSlice, Task, ThreadPool};

use super::{
    Training,
    layout::{Layout, Matrix},
    maximum::Points,
};
use crate::{
    device::{Address, Argument, Buffer, Device, HostBuffer, Queue, Recording, Shape},
    error::{CudaError, Result},
    kernels::{AXES, Constants, Kernel, scaling},
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
const BODY: usize = 2 * AXES;

/// Streams from which on several threads copy frames.
const WORTH_THREADS: usize = 4;
/// Threads that copy, unless another number is given: more do not make the memory faster.
const COPY_THREADS: usize = 4;

fn copy_threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from).min(COPY_THREADS)
}

fn pool(threads: usize) -> ThreadPool {
    ThreadPool::new("copies", threads, 1)
}

/// x, y, vx, vy of a particle.
type Body = [f32; BODY];

/// A frame model that predicts streams on a device.
pub struct Inference {
    device: Arc<dyn Device>,
    constants: Constants,
    core: Core,
    layout: Layout,
    dt: f32,
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
    /// By the number of rows; none before the second step of so many.
    graphs: HashMap<usize, Option<Box<dyn Recording + Send>>>,
}

/// What is remembered of a stream: states and cells, then the particles in the order of their materials, and where each
/// material starts in it.
struct Memory {
    device: Arc<dyn Device>,
    buffer: Buffer,
    /// Layers of states, with those of cells, and their padded and their actual width.
    layers: usize,
    widths: [usize; 2],
    particles: usize,
}

impl Memory {
    fn new(
        device: Arc<dyn Device>,
        constants: &Constants,
        layout: &Layout,
        core: Core,
        material: &[u8],
    ) -> Result<Self> {
        let layers = layout.core.len() * if core == Core::Lstm { 2 } else { 1 };
        let widths = [constants.hidden_columns(), constants.hidden];
        let particles = material.len();
        let [order, segments] = super::data::by_material(material);
        let bytes = 4 * (layers * widths[0] + order.len() + segments.len());
        let buffer = device.allocate(bytes)?;
        let memory = Self { device, buffer, layers, widths, particles };
        memory.clear()?;
        let tables = [order, segments].concat();
        let offset = 4 * layers * widths[0];
        memory.device.write(&memory.buffer, offset, bytemuck::cast_slice(&tables))?;
        Ok(memory)
    }

    fn order(&self) -> Address {
        self.buffer.address().plus(self.layers * self.widths[0])
    }

    /// `struct Row` of the kernels.
    fn row(&self) -> [u64; 3] {
        [self.buffer.address(), self.order(), self.order().plus(self.particles)].map(|at| at.0)
    }

    /// States as they are before the first frame: zero, with the ones that the bias of W_hh is multiplied by.
    fn clear(&self) -> Result<()> {
        let [wide, hidden] = self.widths;
        let mut states = vec![0f32; self.layers * wide];
        states.iter_mut().skip(hidden).step_by(wide).for_each(|one| *one = 1.0);
        self.device.write(&self.buffer, 0, bytemuck::cast_slice(&states))
    }

    fn states(&self) -> Result<Vec<f32>> {
        let mut states = vec![0f32; self.layers * self.widths[0]];
        self.device.read(&self.buffer, 0, bytemuck::cast_slice_mut(&mut states))?;
        Ok(states)
    }

    fn copy_from(&self, other: &Self) -> Result<()> {
        self.device.copy(&self.buffer, &other.buffer)
    }

    fn duplicate(&self) -> Result<Self> {
        let buffer = self.device.allocate(self.buffer.bytes())?;
        let Self { device, layers, widths, particles, .. } = self;
        let copy = Self {
            device: device.clone(),
            buffer,
            layers: *layers,
            widths: *widths,
            particles: *particles,
        };
        copy.copy_from(self)?;
        Ok(copy)
    }
}

/// Positions and velocities side by side.
fn copy_frame(frame: &FrameView<'_>, bodies: &mut [Body]) {
    if let Particles::Lists { position, velocity, .. } = frame.particles {
        for (body, (&[x, y], &[vx, vy])) in bodies.iter_mut().zip(position.iter().zip(velocity)) {
            *body = [x, y, vx, vy];
        }
        return;
    }
    for (particle, body) in bodies.iter_mut().enumerate() {
        let ([x, y], [vx, vy]) = frame.particles.motion(particle);
        *body = [x, y, vx, vy];
    }
}

impl Inference {
    /// The network of a checkpoint on a device that has its kernels.
    ///
    /// # Errors
    /// [`CudaError::Unsupported`], [`CudaError::Memory`], [`CudaError::Call`].
    pub fn new(
        device: Arc<dyn Device>,
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
    ) -> Result<Self> {
        let constants = Constants::of(description)?;
        let layout = Layout::new(description, &constants);
        let (core, particles, wide) =
            (description.core, constants.particles, constants.hidden_columns());
        let numbers = |count: usize| device.allocate(4 * count);
        let parts = layout.matrices().map(|matrix| matrix.rows.div_ceil(PART) * matrix.columns);
        let parts = MOST_STREAMS * parts.max().unwrap_or_default();
        let recurrent = layout.core.iter().any(|(_, recurrent)| recurrent.is_some());
        let inference = Self {
            weights: numbers(layout.size)?,
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
            idle: Memory::new(device.clone(), &constants, &layout, core, &vec![0; particles])?,
            threads: pool(copy_threads()),
            graphs: HashMap::new(),
            dt: description.dt,
            constants,
            core,
            layout,
            device,
        };
        let Self { device, weights, scaling: scales, layout, .. } = &inference;
        device.write(weights, 0, bytemuck::cast_slice(&layout.pack(tensors)))?;
        device.write(scales, 0, bytemuck::cast_slice(&scaling(description)))?;
        Ok(inference)
    }

    /// The same, with so many threads that copy frames between the program's memory and the device's.
    #[must_use]
    pub fn with_threads(self, threads: NonZeroUsize) -> Self {
        Self { threads: pool(threads.get()), ..self }
    }

    fn memory(&self, material: &[u8]) -> Result<Memory> {
        Memory::new(self.device.clone(), &self.constants, &self.layout, self.core, material)
    }

    /// One frame of each stream, at most [`MOST_STREAMS`].
    fn step(&mut self, steps: &mut [(&Memory, FrameView<'_>, &mut Frame)]) -> Result<()> {
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
                copy_frame(&steps[item].1, bodies);
            });
        }
        self.run(rows)?;
        // SAFETY: as above.
        let next = unsafe { self.host_next.slice::<Body>() };
        let (steps, next) = (DisjointSlice::new(steps), &*next);
        self.threads.run([steps.len()], alone, &|Task { item, .. }| {
            // SAFETY: each item runs once.
            let (.., frame) = &mut unsafe { steps.part(item..item + 1) }[0];
            let after = frame.position.iter_mut().zip(&mut frame.velocity);
            let bodies = &next[item * particles..];
            for ((position, velocity), &[x, y, vx, vy]) in after.zip(bodies) {
                (*position, *velocity) = ([x, y], [vx, vy]);
            }
        });
        Ok(())
    }

    /// A step of so many rows, from the memory of the host to the memory of the host.
    fn run(&mut self, rows: usize) -> Result<()> {
        match self.graphs.get(&rows) {
            None => {
                self.launch_all(rows)?;
                self.graphs.insert(rows, None);
            }
            Some(Some(graph)) => graph.repeat()?,
            Some(None) => {
                let graph = self.device.record(&mut || self.launch_all(rows))?;
                match &graph {
                    Some(graph) => graph.repeat()?,
                    None => self.launch_all(rows)?,
                }
                self.graphs.insert(rows, graph);
            }
        }
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
                self.dt.into(),
            ],
        )
    }

    fn core_layer(&self, layer: usize, rows: usize) -> Result<()> {
        let (matrix, recurrent) = &self.layout.core[layer];
        let signal = self.signal.address();
        let input = if layer == 0 { self.input.address() } else { signal };
        let wide = self.constants.hidden_columns();
        if self.core == Core::Mlp {
            return self.linear(matrix, [input, signal], wide, true, rows);
        }
        let [parts, recurrent_parts] = &self.parts;
        let states = self.before.address().plus(layer * rows * wide);
        let count = self.product(matrix, input, parts, rows)?;
        if let Some(recurrent) = recurrent {
            self.product(recurrent, states, recurrent_parts, rows)?;
        }
        let kernel = match self.core {
            Core::Mlp | Core::MinGru => Kernel::MinGruStreams,
            Core::MinLstm => Kernel::MinLstmStreams,
            Core::Gru => Kernel::GruStreams,
            Core::Lstm => Kernel::LstmStreams,
        };
        let mut arguments: Vec<Argument> = vec![parts.address().into()];
        if recurrent.is_some() {
            arguments.push(recurrent_parts.address().into());
        }
        if self.core != Core::Lstm {
            arguments.push(states.into());
        }
        let rest: [Argument; 4] =
            [self.rows.address().into(), signal.into(), count.into(), layer.into()];
        arguments.extend(rest);
        if self.core == Core::Lstm {
            arguments.push(self.layout.core.len().into());
        }
        self.launch(kernel, self.units(rows), &arguments)
    }
}

/// A frame model on a device, as the streaming engine uses it. Steps from several threads follow each other. After a
/// failure of the device every step fails with it.
#[derive(Clone)]
pub struct Streams(Arc<Mutex<Shared>>);

struct Shared {
    inference: Inference,
    failure: Option<String>,
}

impl Streams {
    /// Of a network on a device.
    pub fn new(inference: Inference) -> Self {
        Self(Arc::new(Mutex::new(Shared { inference, failure: None })))
    }

    /// Takes the weights that a training on the same device has now, averaged if it keeps an average.
    ///
    /// # Errors
    /// [`CudaError::Call`].
    ///
    /// # Panics
    /// With a training of another network.
    pub fn copy_weights(&self, training: &Training) -> Result<()> {
        let Shared { inference, .. } = &*self.shared();
        inference.device.copy(&inference.weights, training.averaged_weights())
    }

    fn shared(&self) -> MutexGuard<'_, Shared> {
        self.0.lock().unwrap_or_else(|broken| broken.into_inner())
    }

    /// Runs `work`, unless the device has failed; keeps its failure.
    fn attempt<T>(
        &self,
        work: impl FnOnce(&mut Inference) -> Result<T>,
    ) -> std::result::Result<T, ModelError> {
        let Shared { inference, failure } = &mut *self.shared();
        if failure.is_none() {
            match work(inference) {
                Ok(value) => return Ok(value),
                // Nothing is lost but this state: other streams go on.
                Err(reason @ CudaError::Memory { .. }) => {
                    return Err(ModelError::Device(reason.to_string()));
                }
                Err(reason) => *failure = Some(reason.to_string()),
            }
        }
        Err(ModelError::Device(failure.clone().unwrap_or_default()))
    }
}

impl Accelerator for Streams {
    fn streams(&self) -> usize {
        MOST_STREAMS
    }

    fn start(
        &self,
        stream: &StreamStart<'_>,
    ) -> std::result::Result<Box<dyn DeviceState>, ModelError> {
        let memory = self.attempt(|inference| inference.memory(stream.material))?;
        Ok(Box::new(State { owner: self.clone(), memory: Ok(memory) }))
    }

    fn step(&self, steps: &mut [DeviceStep<'_>]) -> std::result::Result<(), ModelError> {
        for batch in steps.chunks_mut(MOST_STREAMS) {
            let mut rows = Vec::with_capacity(batch.len());
            for DeviceStep { state, frame, next } in batch {
                let memory = memory_of(&**state);
                let memory = memory.map_err(|reason| ModelError::Device(reason.to_owned()))?;
                rows.push((memory, *frame, &mut **next));
            }
            self.attempt(|inference| inference.step(&mut rows))?;
        }
        Ok(())
    }
}

/// The state of a stream on a device, or why it could not be copied.
struct State {
    owner: Streams,
    memory: std::result::Result<Memory, String>,
}

impl Drop for State {
    /// Gives the memory back between steps: a step may be about to be recorded.
    fn drop(&mut self) {
        let memory = std::mem::replace(&mut self.memory, Err(String::new()));
        let _alone = self.owner.shared();
        drop(memory);
    }
}

fn memory_of(state: &dyn DeviceState) -> std::result::Result<&Memory, &str> {
    let state: &dyn Any = state;
    let state = state.downcast_ref::<State>();
    let memory = state.map(|state| state.memory.as_ref().map_err(String::as_str));
    memory.unwrap_or(Err("the state of another device"))
}

impl State {
    /// A copy of a state's memory.
    fn copy_of(&self, other: &dyn DeviceState) -> std::result::Result<Memory, String> {
        let memory = memory_of(other)?;
        self.owner.attempt(|_| memory.duplicate()).map_err(|reason| reason.to_string())
    }
}

impl DeviceState for State {
    fn duplicate(&self) -> Box<dyn DeviceState> {
        Box::new(Self { owner: self.owner.clone(), memory: self.copy_of(self) })
    }

    fn copy_from(&mut self, other: &dyn DeviceState) {
        let copied = match (&self.memory, memory_of(other)) {
            (Ok(to), Ok(from)) => self.owner.attempt(|_| to.copy_from(from)),
            _ => {
                let copy = self.copy_of(other);
                self.memory = copy;
                return;
            }
        };
        if let Err(reason) = copied {
            self.memory = Err(reason.to_string());
        }
    }

    fn forget(&mut self) {
        if let Ok(memory) = &self.memory
            && let Err(reason) = self.owner.attempt(|_| memory.clear())
        {
            self.memory = Err(reason.to_string());
        }
    }

    fn numbers(&self) -> Vec<f32> {
        let memory = self.memory.as_ref().ok();
        memory.and_then(|memory| self.owner.attempt(|_| memory.states()).ok()).unwrap_or_default()
    }
}
