//! Streams of particle models predicted on a device: a frame of up to [`MOST_STREAMS`] streams of any sizes at once, their
//! states stay on the device.
//!
//! Frames and predictions lie in memory of the host that the device reads and writes itself, and so does a table of the
//! streams with the places of all their lists: a step is one graph without copies and without arguments that change. There is
//! a graph for each number of streams and size of the largest one, rounded up to a power of two.
//!
//! | stage | a block has | reads | writes |
//! |---|---|---|---|
//! | load | 256 particles | frames in the memory of the host | particles, counts of cells, marks of nodes |
//! | scan | a map | counts, marks | first slots of cells, numbers of nodes |
//! | scatter, rank | 256 particles | first slots | particles by cells, then by number |
//! | encode | a tile of slots | particles, links | features, encoded `[n, C0]` |
//! | to nodes | 32 quadruples of inputs of nodes | encoded | list 0 `[nodes, C0 + 5]` |
//! | layers on nodes | 16 nodes, 16 columns | a list | another list |
//! | decode | a tile of slots | list 2, features, states | states, predictions |
//! | rules | a body of jelly; particles, nodes, cells | lattices; particles, links, the grid | predictions |
//! | store | 256 particles | predictions | memory of the host |

#![expect(unsafe_code, reason = "launches, and memory that the device reads and writes")]

use std::{collections::BTreeMap, num::NonZeroUsize, sync::Arc};

use eddy_frames::Domain;
use eddy_inference::{
    checkpoint::{Description, Weights, plan::Stage},
    engine::{Ballistic, StreamStart, scales},
    kernels::nodes::MAX_LEVELS,
    ops::rules::{DEVICE_CONSTANTS, Most, Network},
};
use eddy_threads::{DisjointSlice, Task, ThreadPool};

use super::{
    layout::{Constants, Layout, STENCIL_ROWS},
    node_layers::tiles,
    stream::{Memory, Scales, Size},
};
use crate::{
    device::{Device, HostBuffer, Kernel, List, Queue, Shape, count},
    error::Result,
    graphs::Graphs,
    kernels::particle::{
        elastic::Elastic,
        layers::{ParticleDecode, ParticleEncode, ParticleStore, ParticleToNodes},
        node_layers::{NODE_LAYER_THREADS, ParticleLayer},
        nodes::{
            ParticleChunks, ParticleLoad, ParticleRank, ParticleScan, ParticleScatter,
            SCAN_THREADS, Stream, THREADS as TILE_THREADS, WARP,
        },
    },
    streams::{Body, Step, StreamModel, copy_bodies, copy_motion, copy_threads},
};

/// Streams of a step.
pub const MOST_STREAMS: usize = 64;
/// Scratch memory that several streams of a step take together at most (bytes); a single one takes what it needs.
const SCRATCH: usize = 4 << 30;
/// Graphs that are kept.
const GRAPHS: usize = 64;
/// Blocks of a stage, at most about so many for all streams; each goes on with further tiles.
const BLOCKS: usize = 16384;
/// The same of a layer on nodes. There can be many more tiles than there are: blocks without one also take time.
const LAYER_BLOCKS: usize = 1024;

/// Particles of an item of a copy between a frame and the memory of the device.
const COPY: usize = 1 << 14;
/// Items from which on several threads copy.
const WORTH_THREADS: usize = 4;
/// Threads that copy.
const COPY_THREADS: usize = 8;

/// What the launches of a step depend on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Extent {
    streams: usize,
    /// Particles of the largest stream, rounded up.
    particles: usize,
    /// Nodes of the largest stream by level, rounded up.
    nodes: [usize; MAX_LEVELS],
    /// Parts of its map, rounded up.
    chunks: usize,
    /// What the launches of the rules depend on, rounded up.
    rules: Most,
}

/// A particle model that predicts streams on a device.
pub struct Inference {
    device: Arc<dyn Device>,
    constants: Constants,
    layout: Layout,
    scales: Scales,
    ballistic: Ballistic,
    /// The domain in training.
    domain: Domain,
    weights: List<f32>,
    /// The constants of each rule.
    rules: List<[f32; DEVICE_CONSTANTS]>,
    /// The table of the streams of a step.
    host_rows: HostBuffer,
    rows: List<Stream>,
    /// Memory that is zero between two steps, and scratch memory.
    zeros: List<u32>,
    scratch: List<u32>,
    /// Frames and predictions.
    host: [HostBuffer; 2],
    /// Bodies that there is room for in them.
    bodies: usize,
    /// Copies frames to and from the memory of the host.
    threads: ThreadPool,
    graphs: Graphs<Extent>,
}

/// A part of a frame: number of the stream, first particle, and its place in the memory of the host.
struct Part {
    step: usize,
    first: usize,
    count: usize,
    at: usize,
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
        let (layout, weights) = Layout::new(&constants, tensors);
        let grid = description.grid.as_ref();
        let width = grid.map_or(1.0, |grid| grid.cell_width);
        let (slowest, fastest) = scales::velocity_limits(&description.normalization);
        let scales = Scales {
            levels: constants.levels(),
            width,
            unit: scales::velocity_unit(&description.normalization),
            speeds: [slowest, fastest],
            rules: description.rules,
            spacing: grid.map_or(1.0, |grid| grid.spacing),
        };
        let (ballistic, network) = (Ballistic::new(description), Network::of(description));
        Ok(Self {
            domain: description.domain,
            weights: List::of(&*device, &weights)?,
            rules: List::of(&*device, &description.rules.device_constants(&network))?,
            scales,
            ballistic,
            host_rows: device.allocate_host(MOST_STREAMS * size_of::<Stream>())?,
            rows: List::new(&*device, MOST_STREAMS)?,
            zeros: List::new(&*device, 0)?,
            scratch: List::new(&*device, 0)?,
            host: [device.allocate_host(0)?, device.allocate_host(0)?],
            bodies: 0,
            threads: copy_threads(None, COPY_THREADS),
            graphs: Graphs::new(GRAPHS),
            constants,
            layout,
            device,
        })
    }

    /// The same, with this number of threads that copy frames between the program's memory and the device's, if one is given.
    #[must_use]
    pub fn with_threads(self, threads: Option<NonZeroUsize>) -> Self {
        Self { threads: copy_threads(threads, COPY_THREADS), ..self }
    }

    fn size(&self, memory: &Memory, domain: &Domain) -> Size {
        Size::new(memory.particles(), memory.lattices(), domain, &self.scales)
    }

    /// Makes room for a step of such streams.
    fn make_room(&mut self, sizes: &[Size]) -> Result<()> {
        let zeros: usize = sizes.iter().map(Size::zeros).sum();
        let scratch: usize = sizes.iter().map(|size| size.scratch(&self.constants)).sum();
        let bodies: usize = sizes.iter().map(|size| size.particles).sum();
        for (list, numbers) in [(&mut self.zeros, zeros), (&mut self.scratch, scratch)] {
            if list.bytes() < 4 * numbers {
                // Nothing runs, and what is there is not needed any more.
                *list = List::new(&*self.device, 0)?;
                *list = List::new(&*self.device, numbers)?;
            }
        }
        if self.bodies < bodies {
            self.bodies = 0;
            for buffer in &mut self.host {
                *buffer = self.device.allocate_host(size_of::<Body>() * bodies)?;
            }
            self.bodies = bodies;
        }
        Ok(())
    }

    /// One frame of each stream, at most [`MOST_STREAMS`].
    fn predict(&mut self, steps: &mut [Step<'_, Memory>]) -> Result<()> {
        assert!(steps.len() <= MOST_STREAMS, "{} streams, at most {MOST_STREAMS}", steps.len());
        let sizes: Vec<_> =
            steps.iter().map(|(memory, frame, _)| self.size(memory, &frame.domain)).collect();
        self.make_room(&sizes)?;
        let mut parts = Vec::new();
        let mut at = 0;
        for (step, size) in sizes.iter().enumerate() {
            for first in (0..size.particles).step_by(COPY) {
                let count = COPY.min(size.particles - first);
                parts.push(Part { step, first, count, at: at + first });
            }
            at += size.particles;
        }
        self.write_rows(steps);
        let alone = parts.len() < WORTH_THREADS;
        {
            // SAFETY: the last step has finished, and nothing else uses this memory.
            let bodies = DisjointSlice::new(unsafe { self.host[0].slice::<Body>() });
            let (steps, parts) = (&*steps, &parts);
            self.threads.run([parts.len()], alone, &|Task { item, .. }| {
                let Part { step, first, count, at } = parts[item];
                // SAFETY: each item runs once.
                copy_bodies(&steps[step].1, first, unsafe { bodies.part(at..at + count) });
            });
        }
        self.run(&sizes)?;
        for (memory, ..) in &*steps {
            memory.begin();
        }
        // SAFETY: as above.
        let next = &*unsafe { self.host[1].slice::<Body>() };
        let [mut positions, mut velocities] = [Vec::new(), Vec::new()];
        for (.., frame) in steps {
            positions.push(DisjointSlice::new(&mut frame.position));
            velocities.push(DisjointSlice::new(&mut frame.velocity));
        }
        self.threads.run([parts.len()], alone, &|Task { item, .. }| {
            let Part { step, first, count, at } = parts[item];
            let own = first..first + count;
            // SAFETY: each item runs once.
            let (position, velocity) =
                unsafe { (positions[step].part(own.clone()), velocities[step].part(own)) };
            copy_motion(&next[at..], position, velocity);
        });
        Ok(())
    }

    /// Writes the table of the streams.
    fn write_rows(&mut self, steps: &[Step<'_, Memory>]) {
        let (mut zeros, mut scratch) = (self.zeros.pointer(), self.scratch.pointer());
        let mut host = self.host.each_ref().map(HostBuffer::pointer::<Body>);
        // SAFETY: the last step has finished, and nothing else uses this memory.
        let table = unsafe { self.host_rows.slice::<Stream>() };
        for (row, (memory, frame, _)) in table.iter_mut().zip(steps) {
            let ballistic = self.ballistic.for_domain(&self.domain, &frame.domain);
            let places = [&mut zeros, &mut scratch];
            *row =
                memory.row(&self.constants, &self.scales, &frame.domain, &ballistic, host, places);
            host = host.map(|at| at.plus(memory.particles()));
        }
    }

    /// A step of such streams, from the memory of the host to the memory of the host.
    fn run(&mut self, sizes: &[Size]) -> Result<()> {
        let most = |count: &dyn Fn(&Size) -> usize| {
            sizes.iter().map(count).max().unwrap_or_default().next_power_of_two()
        };
        let extent = Extent {
            streams: sizes.len(),
            particles: most(&|size| size.particles),
            nodes: std::array::from_fn(|level| most(&|size| size.nodes(level))),
            chunks: most(&Size::chunks),
            rules: Most {
                particles: most(&|size| size.particles),
                nodes: most(&|size| size.nodes(0)),
                cells: most(&Size::cells),
                area_nodes: most(&Size::area_nodes),
                lattices: most(&|size| size.lattices.bodies),
            },
        };
        self.graphs.run(&*self.device, extent, || self.launch_all(extent))?;
        self.device.finish()
    }

    fn launch(&self, shape: Shape, kernel: impl Kernel) -> Result<()> {
        // SAFETY: every call of this file passes a table of streams with the memory that `Size` has found for them.
        unsafe { self.device.launch(Queue::Main, shape, &kernel) }
    }

    /// Puts a step into the queue.
    fn launch_all(&self, extent: Extent) -> Result<()> {
        let Extent { streams: number, particles, nodes, chunks, .. } = extent;
        let Constants { tile, .. } = self.constants;
        let at_most = |blocks: usize| {
            move |count: usize, each: usize| {
                count.div_ceil(each).min((blocks / number).max(64)).max(1)
            }
        };
        let blocks = at_most(BLOCKS);
        let streams = self.rows.pointer();
        let weights = |first: usize| self.weights.pointer().plus(first);
        let by_particle = Shape::new(blocks(particles, 256), number, 256);
        let by_tile =
            |shared| Shape { shared, ..Shape::new(blocks(particles, tile), number, TILE_THREADS) };
        let host_streams = self.host_rows.pointer();
        self.launch(by_particle, ParticleLoad { host_streams, streams })?;
        let scan = Shape {
            grid: [blocks(chunks, 1), 1 + self.constants.levels(), number],
            ..Shape::new(1, 1, SCAN_THREADS)
        };
        if chunks > 1 {
            self.launch(scan, ParticleChunks { streams })?;
        }
        self.launch(scan, ParticleScan { streams })?;
        self.launch(by_particle, ParticleScatter { streams })?;
        self.launch(by_particle, ParticleRank { streams })?;
        for stage in &self.constants.stages {
            match *stage {
                Stage::Encode => {
                    let [first, second] = self.layout.encoder.map(weights);
                    let encode = by_tile(self.constants.encode_bytes());
                    self.launch(encode, ParticleEncode { streams, first, second })?;
                }
                Stage::ToNodes => {
                    let quads = nodes[0] * (self.constants.encoded_columns() / 4 + 1);
                    let by_quad = Shape::new(blocks(quads, WARP), number, STENCIL_ROWS * WARP);
                    self.launch(by_quad, ParticleToNodes { streams })?;
                }
                Stage::Convolution(layer) => {
                    let layer = self.layout.grid[layer];
                    let most = tiles(layer.stencil, layer.outputs, nodes[layer.level as usize]);
                    let blocks = at_most(LAYER_BLOCKS)(most, 1);
                    let by_nodes = Shape::new(blocks, number, NODE_LAYER_THREADS);
                    let w = self.weights.pointer();
                    self.launch(by_nodes, ParticleLayer { streams, w, layer })?;
                }
                Stage::Decode => {
                    let decode = by_tile(self.constants.decode_bytes());
                    let w = weights(self.layout.context);
                    self.launch(decode, ParticleDecode { streams, w })?;
                }
            }
        }
        self.launch_rules(extent, &blocks)?;
        self.launch(by_particle, ParticleStore { streams })
    }

    /// Puts the rules of a step into the queue.
    fn launch_rules(&self, extent: Extent, blocks: &dyn Fn(usize, usize) -> usize) -> Result<()> {
        for (rule, launch) in self.scales.rules.launches(&extent.rules) {
            let blocks =
                Shape::new(blocks(launch.threads, launch.block), extent.streams, launch.block);
            let shape = Shape { shared: launch.shared, ..blocks };
            // The kernels of all rules have the same arguments.
            let elastic = Elastic {
                streams: self.rows.pointer(),
                constants: self.rules.pointer().plus(rule).cast(),
                rule: count(rule),
                step: count(launch.step),
            };
            let mut arguments = elastic.arguments();
            // SAFETY: `kernels_of_rules_have_the_same_parameters` in `layout.rs`; as in `launch`.
            unsafe { self.device.launch_named(Queue::Main, launch.kernel, shape, &mut arguments) }?;
        }
        Ok(())
    }
}

impl StreamModel for Inference {
    type Memory = Memory;

    const MOST: usize = MOST_STREAMS;

    fn memory(&mut self, stream: &StreamStart<'_>) -> Result<Memory> {
        let memory = Memory::new(Arc::clone(&self.device), &self.constants, stream)?;
        self.make_room(&[self.size(&memory, &stream.domain)])?;
        Ok(memory)
    }

    /// As many as have scratch memory that is not too large together.
    fn batch(&self, steps: &[Step<'_, Memory>]) -> usize {
        let mut bytes = 0usize;
        let fits = |(memory, frame, _): &Step<'_, Memory>| {
            let size = self.size(memory, &frame.domain);
            let own = size.zeros().saturating_add(size.scratch(&self.constants));
            bytes = bytes.saturating_add(own.saturating_mul(4));
            bytes <= SCRATCH
        };
        steps.iter().map(fits).take_while(|&fits| fits).count().max(1)
    }

    fn step(&mut self, steps: &mut [Step<'_, Memory>]) -> Result<()> {
        self.predict(steps)
    }
}

/// A particle model on a device, as the streaming engine uses it.
pub type Streams = crate::streams::Streams<Inference>;

impl Streams {
    /// Takes other weights of the network: those of a training after some steps.
    ///
    /// # Errors
    /// [`CudaError::Call`](crate::CudaError::Call).
    ///
    /// # Panics
    /// With tensors of another network.
    pub fn set_weights(&self, tensors: &BTreeMap<String, Weights>) -> Result<()> {
        self.alone(|inference| {
            let (_, weights) = Layout::new(&inference.constants, tensors);
            inference.device.write(&inference.weights, 0, bytemuck::cast_slice(&weights))
        })
    }
}
