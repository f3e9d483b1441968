//! Training steps of the particle model: windows out of the store, forward, loss, backward, optimizer.
//!
//! The warm-up's W frames go through the network together, but for its core; each further frame goes alone, from the prediction
//! before. The backward pass takes these frames in the reverse order. Everything that it needs is kept, and so are the gradients
//! by all sums, from which those by the weights are made at the end: for each window on its own, since one whose prediction
//! diverges must not count, as on the CPU.
//!
//! | stage | a block has | reads | writes |
//! |---|---|---|---|
//! | cells | a frame of a window | particles | particles by cells, numbers of nodes |
//! | encode | 16 particles a warp | particles, links | features, encoded `[n, C0]` |
//! | to nodes | some nodes | encoded | field 0 `[nodes, C0 + 5]` |
//! | layers on nodes | 16 columns of 16 nodes | a field | the next field |
//! | decode | 16 particles a warp | the last field, features, states | states, outputs |
//! | advance | 256 particles | outputs, trajectories | the next frame's particles, squares of errors |
//!
//! Products run on tensor cores, with factors in two parts (`particle/products.cu`): their errors are those of FP32.
//!
//! 1. `layout`: what the kernels are compiled for, and where tensors are. `store`: trajectories on the device.
//! 2. `plan`: the memory of a step.
//! 3. `forward`, `backward`: its phases, with `nodes`: the layers on nodes. `weights`: the gradients by the weights.

#![expect(unsafe_code, reason = "launches on memory of the device")]

mod backward;
mod forward;
mod layout;
mod nodes;
mod plan;
mod store;
mod weights;

use std::{collections::BTreeMap, sync::Arc};

use eddy_inference::checkpoint::{Description, Weights, tensors_of_knot};

pub use layout::TrainingConstants;
pub use store::{Store, StoreWriter};

use layout::Layout;
use nodes::NodeLayers;
use plan::Memory;
use weights::Outers;

use crate::{
    device::{Device, Kernel, List, MOST_BLOCKS, Pointer, Queue, Shape},
    error::{CudaError, Result},
    graphs::Graphs,
    kernels::particle::{
        nodes::WARP,
        training::{grid::TrainObserve, plan::Plan, weights::Transposed},
    },
    training::{Batch, InTraining, Optimizer, Settings, Tables},
};

/// Training of a particle model on a device that has the kernels of [`TrainingConstants`].
pub struct Training {
    device: Arc<dyn Device>,
    store: Arc<Store>,
    settings: Settings,
    constants: TrainingConstants,
    layout: Layout,
    optimizer: Optimizer,
    tables: Tables,
    memory: Memory,
    /// The transposed matrices, which the forward pass reads, and the table of those to transpose.
    transposed: List<f32>,
    matrices: List<Transposed>,
    node_layers: NodeLayers,
    outers: Outers,
    graph: Graphs<()>,
}

impl Training {
    /// Memory for steps of these settings, weights all zero.
    ///
    /// # Errors
    /// [`CudaError::Unsupported`], [`CudaError::Memory`], [`CudaError::Call`].
    pub fn new(
        device: Arc<dyn Device>,
        store: Arc<Store>,
        description: &Description,
        settings: &Settings,
    ) -> Result<Self> {
        check(settings)?;
        let constants = TrainingConstants::of(description)?;
        let layout = Layout::new(&constants);
        let tables = Tables::new(&device, settings, true)?;
        let memory = Memory::new(&device, &store, &tables, description, &constants, settings)?;
        let optimizer = Optimizer::new(&device, &layout.packing, settings)?;
        let transposed = List::new(&*device, layout.packing.size)?;
        let weights = [transposed.pointer(), optimizer.weights.pointer()];
        Ok(Self {
            matrices: List::of(&*device, &layout.transposed())?,
            node_layers: NodeLayers::new(&layout, &constants, &memory.plan, weights),
            outers: Outers::new(&*device, &layout, &constants, &memory.plan, settings)?,
            graph: Graphs::new(1),
            settings: settings.clone(),
            tables,
            memory,
            constants,
            layout,
            store,
            optimizer,
            transposed,
            device,
        })
    }

    fn frames(&self) -> usize {
        self.settings.warm_up + self.settings.unroll - 1
    }

    fn launch(&self, shape: Shape, kernel: impl Kernel) -> Result<()> {
        self.launch_in(Queue::Main, shape, kernel)
    }

    fn launch_in(&self, queue: Queue, shape: Shape, kernel: impl Kernel) -> Result<()> {
        // SAFETY: every call passes buffers that `new` has made for these shapes.
        unsafe { self.device.launch(queue, shape, &kernel) }
    }

    /// The plan, as the first argument of kernels.
    fn plan(&self) -> Pointer<Plan> {
        self.memory.device_plan.pointer()
    }

    /// Blocks over so many items each of so many windows' frames.
    fn over(items: usize, each: usize, sheets: usize) -> Shape {
        Shape::new(items.div_ceil(each), sheets, each)
    }

    /// Blocks over tiles of particles.
    fn tiles(&self, sheets: usize, shared: usize) -> Shape {
        let blocks = self.store.most().div_ceil(self.constants.tile());
        Shape { shared, ..Shape::new(blocks, sheets, self.constants.warps * WARP) }
    }

    /// No gradient goes on to the frame before.
    fn cut(&self) -> Result<()> {
        self.memory.carried.clear(&*self.device)
    }

    /// Puts a whole step into the queue.
    fn step(&self) -> Result<()> {
        let Settings { batch, warm_up, truncation, noise: [positions, velocities], .. } =
            self.settings;
        self.optimizer.mix(&self.tables)?;
        self.transpose()?;
        let shape = Self::over(self.store.most(), plan::PARTICLE_THREADS, warm_up * batch);
        self.launch(shape, TrainObserve { plan: self.plan(), positions, velocities })?;
        let segments: Vec<(usize, usize)> =
            std::iter::once((0, warm_up)).chain((warm_up..self.frames()).map(|t| (t, 1))).collect();
        segments.iter().try_for_each(|&(first, frames)| self.forward(first, frames))?;
        self.loss()?;
        self.cut()?;
        // The gradients by weights run beside the backward pass, which leaves multiprocessors idle.
        let mut end = self.outers.splits;
        for &(first, frames) in segments.iter().rev() {
            self.backward(first, frames)?;
            // A predicted frame follows free frame `first + 1 - warm_up`, where `loss::unroll` cuts on the CPU.
            if first >= warm_up && (first + 1 - warm_up).is_multiple_of(truncation) {
                self.cut()?;
            }
            let begun = self.outers.shares_from(first, self.frames());
            if begun < end {
                self.device.wait(Queue::Side, Queue::Main)?;
                self.add_gradients(begun, end - begun)?;
                end = begun;
            }
        }
        self.device.wait(Queue::Main, Queue::Side)?;
        self.learn()?;
        self.optimizer.finish(&self.tables)
    }
}

/// What steps of the particle model on a GPU cannot do, and the largest numbers of blocks.
fn check(settings: &Settings) -> Result<()> {
    let Settings { batch, warm_up, density_weight, dropout, .. } = *settings;
    let unsupported = |setting: String, expected| Err(CudaError::Unsupported { setting, expected });
    if density_weight > 0.0 {
        let setting = format!("loss.density_weight = {density_weight} for the particle model");
        return unsupported(setting, "0");
    }
    if dropout > 0.0 {
        let setting = format!("network.dropout = {dropout} for the particle model");
        return unsupported(setting, "0");
    }
    if batch * warm_up > MOST_BLOCKS {
        let setting = format!("windows.batch x windows.warm_up = {}", batch * warm_up);
        return unsupported(setting, "at most 65535");
    }
    Ok(())
}

impl InTraining for Training {
    fn optimizer(&self) -> &Optimizer {
        &self.optimizer
    }

    fn tables(&self) -> &Tables {
        &self.tables
    }

    fn set_weights(&self, tensors: &BTreeMap<String, Weights>) -> Result<()> {
        let packing = &self.layout.packing;
        let all = match self.settings.knots {
            1 => packing.pack(tensors),
            knots => {
                (0..knots).flat_map(|knot| packing.pack(&tensors_of_knot(tensors, knot))).collect()
            }
        };
        self.optimizer.write_weights(&all)
    }

    fn start(&mut self, batches: &[Batch]) -> Result<()> {
        let frames = self.settings.warm_up + self.settings.unroll;
        let mut windows = batches.iter().flat_map(|batch| &batch.windows);
        assert!(
            windows.all(|window| self.store.contains(window, frames)),
            "windows within their streams"
        );
        self.tables.write(batches, |_, _, window| self.store.first(window))?;
        for _ in batches {
            self.graph.run(&*self.device, (), || self.step())?;
        }
        Ok(())
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
