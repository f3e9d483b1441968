//! Training steps of the frame model: windows out of the store, forward, loss, backward, Adam.
//!
//! The warm-up's W frames go through the network together. Each further frame goes alone, from the prediction
//! before; the backward pass takes these frames in the reverse order. Gradients by the weights are products over the
//! rows of all frames, made once the first frames' gradients are there.
//!
//! 1. `forward`, `maximum`, `backward`, `update`: its phases.
//! 2. `launch`: launches and products that they share.

#![expect(unsafe_code, reason = "launches and products on memory of the device")]

mod backward;
mod forward;
mod launch;
mod maximum;
mod update;

use std::{collections::BTreeMap, sync::Arc};

use eddy_inference::checkpoint::{
    Description, Weights,
    plan::{FrameStage, Plan},
};

use super::{
    data::{Bodies, Store},
    layout::Layout,
};
use crate::{
    device::{Device, List, MOST_BLOCKS, Queue, count},
    error::{CudaError, Result},
    graphs::Graphs,
    kernels::{
        AXES, Constants,
        frame::{
            encoder::Scaling,
            loss::Grid,
            motion::Motion,
            windows::{Disturb, Observe},
        },
        motion, scaling,
    },
    streams::Body,
    training::{Batch, GROUP, InTraining, Optimizer, Settings, Tables},
};
use maximum::Maximum;

/// Nodes an axis of a density map that fit into shared memory.
const MOST_NODES: usize = 110;

/// A layer of the core in the memory of the device; `T` frames of `B` windows.
struct LayerMemory {
    /// Gates, later gradients by them, `[T, B, gates * HP]`.
    sums: List<f32>,
    /// States, the one before the first frame first: outputs, then the cells of LSTM, `[states, T + 1, B, HP]`.
    states: List<f32>,
    /// If the core has recurrent weights: gates from the last output, later gradients by them, `[T, B, gates * HP]`.
    recurrent: Option<List<f32>>,
    /// Outputs after dropout, `[T, B, HP]`; without dropout the states.
    dropped: Option<List<f32>>,
    /// Gradient by the outputs, `[T, B, HP]`.
    gradient: List<f32>,
    /// Gradient by the last state from later frames, `[states, B, HP]`.
    carried: List<f32>,
}

/// Windows that are fetched out of the memory of the host.
struct Staging {
    /// `sources` of the kernel.
    sources: List<u64>,
    /// Windows of two steps, in turn, `[2, B, W + K, N]`.
    bodies: List<Body>,
}

/// Training of a frame model on a device.
pub struct Training {
    device: Arc<dyn Device>,
    store: Arc<Store>,
    /// Where the store is in the memory of the host.
    staging: Option<Staging>,
    settings: Settings,
    constants: Constants,
    layout: Layout,
    stages: Vec<FrameStage>,
    motion: Motion,
    /// Left plus right wall (domain lengths).
    sides: f32,
    /// The density grid.
    grid: Grid,
    /// Blocks that share the particles of a window.
    chunks: usize,

    optimizer: Optimizer,
    tables: Tables,
    scaling: List<Scaling>,

    states: List<Body>,
    sums: List<f32>,
    pooled: List<f32>,
    maximum: Option<Maximum>,
    input: List<f32>,
    layers: Vec<LayerMemory>,
    mixed: List<f32>,
    output: List<f32>,

    squares: List<f32>,
    densities: List<f32>,
    density_gradient: Option<List<f32>>,
    scales: List<f32>,
    /// Gradient by the frame before, `[B, N]`.
    carried: List<Body>,
    d_mixed: List<f32>,
    d_input: List<f32>,
    d_pooled: List<f32>,

    graph: Graphs<()>,
}

impl Training {
    /// Memory for steps of these settings, weights all zero.
    ///
    /// # Errors
    /// [`CudaError::Unsupported`], [`CudaError::Memory`], [`CudaError::Call`].
    #[expect(clippy::too_many_lines, reason = "the buffers of a step, one after another")]
    pub fn new(
        device: Arc<dyn Device>,
        store: Arc<Store>,
        description: &Description,
        settings: &Settings,
    ) -> Result<Self> {
        let constants = Constants::of(description)?;
        let density = settings.density_weight > 0.0;
        if density && settings.density_nodes > MOST_NODES {
            let setting = format!("loss.density_grid = {}", settings.density_nodes);
            return Err(CudaError::Unsupported { setting, expected: "at most 110" });
        }
        let Settings { batch, warm_up, unroll, truncation, .. } = *settings;
        if truncation > 0 {
            let setting = format!("truncation = {truncation} for the frame model");
            return Err(CudaError::Unsupported { setting, expected: "0" });
        }
        if settings.muon {
            let setting = "optimizer.kind = muon for the frame model".to_owned();
            return Err(CudaError::Unsupported { setting, expected: "adam" });
        }
        // Blocks of grids along y, and of the encoder's along z.
        let along_z = warm_up * constants.encoder.div_ceil(256);
        for (setting, found) in [
            ("windows.batch", batch),
            ("windows.warm_up x (network.encoder / 256, rounded up)", along_z),
        ] {
            if found > MOST_BLOCKS {
                let setting = format!("{setting} = {found}");
                return Err(CudaError::Unsupported { setting, expected: "at most 65535" });
            }
        }
        assert_eq!(store.particles(), constants.particles, "particles of the store");
        let layout = Layout::new(description, &constants);
        let frames = warm_up + unroll - 1;
        let decoded = settings.first_decoded();
        let (rows, decoded_rows) = (frames * batch, (frames - decoded) * batch);
        let (wide, particles) = (constants.hidden_columns(), constants.particles);
        let chunks = (512usize.div_ceil(batch)).clamp(1, particles.div_ceil(128));
        let core = description.core;

        let numbers = |count: usize| List::new(&*device, count);
        let optional = |is: bool, count: usize| is.then(|| numbers(count)).transpose();
        let recurrent = core.recurrent_part().is_some();
        let layer = || -> Result<LayerMemory> {
            let memory = LayerMemory {
                sums: numbers(rows * core.gates() * wide)?,
                states: numbers(core.states() * (frames + 1) * batch * wide)?,
                recurrent: optional(recurrent, rows * core.gates() * wide)?,
                dropped: optional(settings.dropout > 0.0, rows * wide)?,
                gradient: numbers(rows * wide)?,
                carried: numbers(core.states() * batch * wide)?,
            };
            if recurrent {
                // The ones that the bias of W_hh is multiplied by.
                let mut before = vec![0f32; batch * wide];
                before.iter_mut().skip(constants.hidden).step_by(wide).for_each(|one| *one = 1.0);
                device.write(&memory.states, 0, bytemuck::cast_slice(&before))?;
            }
            Ok(memory)
        };
        let layers = (0..description.sizes.layers).map(|_| layer()).collect::<Result<Vec<_>>>()?;
        let cell = |axis: usize| {
            let width = description.domain.upper[axis] - description.domain.lower[axis];
            (settings.density_nodes as f32 - 1.0) / width
        };
        let staging = match &store.bodies {
            Bodies::Device(_) => None,
            Bodies::Host(_) => Some(Staging {
                sources: List::new(&*device, 1 + GROUP * batch)?,
                bodies: List::new(&*device, 2 * batch * (warm_up + unroll) * particles)?,
            }),
        };
        Ok(Self {
            staging,
            optimizer: Optimizer::new(&device, &layout.packing, settings)?,
            tables: Tables::new(&device, settings, settings.relative)?,
            scaling: List::of(&*device, &[scaling(description)])?,
            states: List::new(&*device, rows * particles)?,
            sums: numbers(if constants.mean() {
                rows * chunks * constants.encoder_sums() * constants.encoder
            } else {
                0
            })?,
            pooled: numbers(rows * constants.pooled_columns())?,
            maximum: constants
                .maximum()
                .then(|| Maximum::new(&*device, &constants, settings, rows))
                .transpose()?,
            input: numbers(rows * constants.input_columns())?,
            layers,
            mixed: numbers(decoded_rows * wide)?,
            output: numbers(decoded_rows * constants.output_columns())?,
            squares: numbers(rows * particles.div_ceil(256))?,
            densities: numbers(unroll * batch)?,
            density_gradient: optional(density, unroll * batch * particles * AXES)?,
            scales: numbers(2 * batch)?,
            carried: List::new(&*device, batch * particles)?,
            d_mixed: numbers(decoded_rows * wide)?,
            d_input: numbers(rows * constants.input_columns())?,
            d_pooled: numbers(rows * constants.pooled_columns())?,
            graph: Graphs::new(1),
            motion: motion(description),
            sides: description.domain.lower[0] + description.domain.upper[0],
            grid: Grid {
                least: description.domain.lower,
                inverse_cell: [cell(0), cell(1)],
                nodes: count(settings.density_nodes),
            },
            chunks,
            settings: settings.clone(),
            stages: Plan::new(description).frame_stages(),
            layout,
            constants,
            store,
            device,
        })
    }

    /// Sets weights of squared errors of x, y, vx, vy that hold for all batches, the same for every frame, window and
    /// material.
    ///
    /// # Errors
    /// [`CudaError::Call`].
    pub fn set_error_weights(&self, weights: [f32; 4]) -> Result<()> {
        self.tables.set_error_weights(weights)
    }
}

impl InTraining for Training {
    fn optimizer(&self) -> &Optimizer {
        &self.optimizer
    }

    fn tables(&self) -> &Tables {
        &self.tables
    }

    fn set_weights(&self, tensors: &BTreeMap<String, Weights>) -> Result<()> {
        self.optimizer.write_weights(&self.layout.pack(tensors))
    }

    fn start(&mut self, batches: &[Batch]) -> Result<()> {
        let frames = self.settings.warm_up + self.settings.unroll;
        let mut sources = vec![batches.len() as u64];
        for window in batches.iter().flat_map(|batch| &batch.windows) {
            assert!(self.store.contains(window, frames), "windows within their streams");
            sources.push(self.store.first(window));
        }
        self.tables.write(batches, |step, number, window| match &self.staging {
            None => self.store.first(window),
            Some(_) => {
                let place = step % 2 * self.settings.batch + number;
                (place * frames * self.constants.particles) as u64
            }
        })?;
        if let Some(staging) = &self.staging {
            self.device.write(&staging.sources, 0, bytemuck::cast_slice(&sources))?;
            self.fetch(Queue::Main, 0)?;
        }
        for _ in batches {
            self.graph.run(&*self.device, (), || self.step())?;
        }
        Ok(())
    }
}

/// The step itself.
impl Training {
    /// Puts a whole step into the queues.
    fn step(&self) -> Result<()> {
        let Settings { batch, warm_up, .. } = self.settings;
        if self.staging.is_some() {
            self.device.wait(Queue::Fetch, Queue::Main)?;
            self.fetch(Queue::Fetch, 1)?;
        }
        self.launch(
            self.particles(warm_up),
            Observe {
                store: self.bodies(),
                windows: self.tables.windows.pointer(),
                progress: self.tables.progress.pointer(),
                states: self.states.pointer(),
                batch: count(batch),
                sides: self.sides,
            },
        )?;
        let [positions, velocities] = self.settings.noise;
        if positions > 0.0 || velocities > 0.0 {
            self.launch(
                self.particles(1),
                Disturb {
                    windows: self.tables.windows.pointer(),
                    progress: self.tables.progress.pointer(),
                    states: self.at(&self.states, warm_up - 1, self.constants.particles),
                    positions,
                    velocities,
                },
            )?;
        }
        let segments: Vec<(usize, usize)> =
            std::iter::once((0, warm_up)).chain((warm_up..self.frames()).map(|t| (t, 1))).collect();
        segments.iter().try_for_each(|&(first, frames)| self.forward(first, frames))?;
        self.loss()?;
        for layer in &self.layers {
            self.device.clear(Queue::Main, &layer.carried)?;
        }
        segments.iter().rev().try_for_each(|&(first, frames)| self.backward(first, frames))?;
        self.device.wait(Queue::Main, Queue::Side)?;
        if self.updates() != Queue::Side {
            self.device.wait(Queue::Main, self.updates())?;
        }
        if self.staging.is_some() {
            self.device.wait(Queue::Main, Queue::Fetch)?;
        }
        self.optimizer.finish(&self.tables)
    }
}

impl Drop for Training {
    /// Waits for all work, before memory that it uses is given back, and before the device leaves its group, which recorded
    /// steps know.
    fn drop(&mut self) {
        if let Err(reason) = self.device.finish() {
            tracing::debug!("a GPU was lost: {reason}");
        }
        self.graph.clear();
    }
}
