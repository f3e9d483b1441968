//! The frame model, one frame at a time: `model/frame_model.rs` for one stream.
//!
//! Nearly all of the time goes into reading the weights once. The stages follow each other, the items
//! of a stage are panels of its outputs (blocks of particles where the maximum is pooled).
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use std::{collections::BTreeMap, ops::Range};

use pulp::{Arch, Simd, WithSimd};

use super::{
    core::{CoreLayer, activate},
    crew::{Crew, Parts, Task},
    encoder::{BLOCK, Encoder},
    linear::{Linear, add_products, outputs},
    memory::Memory,
};
use crate::{
    checkpoint::{Activation, Core, Description, Pooling, Weights},
    kernels::vectors::Lanes,
};
use eddy_frames::{Frame, FrameView};

/// Parts of each sum over a layer's inputs: enough for the additions not to wait for each other.
const SUM_PARTS: usize = 4;
/// The same where several gates are summed up at once.
const GATE_SUM_PARTS: usize = 2;

/// What happens to a frame, in order.
#[derive(Clone, Copy, Debug)]
enum Stage {
    /// First Linear, activation, mean over the particles.
    PoolMean,
    /// Second Linear of the mean.
    Encode,
    /// First Linear, activation, second Linear, maximum over the particles that a thread gets.
    PoolMax,
    /// Maximum over the threads.
    JoinMax,
    /// A layer of the core.
    Core(usize),
    /// Linear, activation.
    Mix,
    /// Linear: the change of each velocity.
    Decode,
}

/// The packed network.
#[derive(Debug)]
pub(super) struct FrameModel {
    /// Whose vectors the weights are packed for.
    arch: Arch,
    encoder: Encoder,
    second: Linear,
    core: Vec<CoreLayer>,
    mixer: Linear,
    decoder: Linear,
    activation: Activation,
    pooling: Pooling,
    stages: Vec<Stage>,
    /// N.
    particles: usize,
    /// H.
    hidden: usize,
    /// Time between two frames (s).
    dt: f32,
}

/// Room for what stages hand on.
#[derive(Debug)]
pub(super) struct Room {
    /// Scaled features, `[N, 4]`.
    features: Vec<[f32; 4]>,
    /// `[E]`.
    pooled: Vec<f32>,
    /// Input of the core: `[H]`, `[2 H]` with both poolings.
    encoded: Vec<f32>,
    /// New outputs of the core's layers, `[layer, H]`.
    hidden: Vec<f32>,
    /// Their new cells; empty but for LSTM.
    cell: Vec<f32>,
    /// `[H]`.
    mixed: Vec<f32>,
    /// `[2 N]` (domain lengths per second).
    change: Vec<f32>,
    /// Maximum pooling: a block of points of each thread, `[thread, BLOCK, E]`.
    points: Vec<f32>,
    /// Maximum pooling: the largest values that each thread has seen, `[thread, H]`.
    maxima: Vec<f32>,
}

impl FrameModel {
    pub(super) fn pack(
        arch: Arch,
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
    ) -> Self {
        let lanes = arch.dispatch(Lanes);
        let linear = |layer| Linear::named(lanes, tensors, layer);
        let decoder = linear("decoder");
        let layers = description.sizes.layers;
        let mut stages = match description.frame.pooling {
            Pooling::Mean => vec![Stage::PoolMean, Stage::Encode],
            Pooling::Max => vec![Stage::PoolMax, Stage::JoinMax],
            Pooling::MeanMax => {
                vec![Stage::PoolMean, Stage::Encode, Stage::PoolMax, Stage::JoinMax]
            }
        };
        stages.extend((0..layers).map(Stage::Core));
        stages.extend([Stage::Mix, Stage::Decode]);
        Self {
            arch,
            encoder: Encoder::pack(lanes, description, tensors),
            second: linear("encoder.1"),
            core: (0..layers)
                .map(|layer| CoreLayer::pack(lanes, description, tensors, layer))
                .collect(),
            mixer: linear("mixer"),
            activation: description.frame.activation,
            pooling: description.frame.pooling,
            stages,
            particles: decoder.output() / 2,
            decoder,
            hidden: description.sizes.hidden,
            dt: description.dt,
        }
    }

    /// How many stages a frame has.
    pub(super) fn stages(&self) -> usize {
        self.stages.len()
    }

    /// Multiplications of a frame, about.
    pub(super) fn work(&self) -> usize {
        let core = self.core.iter().flat_map(CoreLayer::linears).map(Linear::numbers);
        let linears = core.sum::<usize>() + self.mixer.numbers() + self.decoder.numbers();
        let points = self.particles * self.encoder.width();
        match self.pooling {
            Pooling::Mean => linears + 16 * points,
            Pooling::Max | Pooling::MeanMax => linears + points * self.hidden,
        }
    }

    pub(super) fn room(&self, threads: usize, core: Core) -> Room {
        let states = self.core.len() * self.hidden;
        let (poolings, maxima) = match self.pooling {
            Pooling::Mean => (1, 0),
            Pooling::Max => (1, threads),
            Pooling::MeanMax => (2, threads),
        };
        Room {
            features: vec![[0.0; 4]; self.particles],
            pooled: vec![0.0; self.encoder.width()],
            encoded: vec![0.0; poolings * self.hidden],
            hidden: vec![0.0; states],
            cell: vec![0.0; if core == Core::Lstm { states } else { 0 }],
            mixed: vec![0.0; self.hidden],
            change: vec![0.0; 2 * self.particles],
            points: vec![0.0; maxima * BLOCK * self.encoder.width()],
            maxima: vec![0.0; maxima * self.hidden],
        }
    }

    /// Observes `frame` and writes the next positions and velocities.
    pub(super) fn step(
        &self,
        crew: &mut Crew,
        alone: bool,
        room: &mut Room,
        memory: &mut Memory,
        frame: FrameView<'_>,
        next: &mut Frame,
    ) {
        self.encoder.scale(frame.particles, &mut room.features);
        room.maxima.fill(f32::NEG_INFINITY);
        let pass = Pass {
            model: self,
            memory,
            features: &room.features,
            pooled: Parts::new(&mut room.pooled),
            encoded: Parts::new(&mut room.encoded),
            hidden: Parts::new(&mut room.hidden),
            cell: Parts::new(&mut room.cell),
            mixed: Parts::new(&mut room.mixed),
            change: Parts::new(&mut room.change),
            points: Parts::new(&mut room.points),
            maxima: Parts::new(&mut room.maxima),
        };
        let items = self.stages.iter().map(|&stage| self.items(stage));
        crew.run(items, alone, &|task| self.arch.dispatch(Item { pass: &pass, task }));
        memory.hidden.copy_from_slice(&room.hidden);
        memory.cell.copy_from_slice(&room.cell);

        let changes = room.change.as_chunks::<2>().0;
        let after = next.position.iter_mut().zip(&mut next.velocity);
        for (particle, ((position, velocity), change)) in after.zip(changes).enumerate() {
            let (x, v) = frame.particles.motion(particle);
            for axis in 0..2 {
                velocity[axis] = v[axis] + change[axis];
                position[axis] = x[axis] + velocity[axis] * self.dt;
            }
        }
    }

    fn items(&self, stage: Stage) -> usize {
        match stage {
            Stage::PoolMean => self.encoder.panels(),
            Stage::Encode => self.second.panels(),
            Stage::PoolMax => self.particles.div_ceil(BLOCK),
            Stage::JoinMax => 1,
            Stage::Core(layer) => self.core[layer].panels(),
            Stage::Mix => self.mixer.panels(),
            Stage::Decode => self.decoder.panels(),
        }
    }

    /// Where the state of a layer is in `[layer, H]`.
    fn state(&self, layer: usize) -> Range<usize> {
        layer * self.hidden..(layer + 1) * self.hidden
    }
}

/// One frame under way. Each array is written in one stage, panel by panel, and read in later ones.
struct Pass<'a> {
    model: &'a FrameModel,
    memory: &'a Memory,
    features: &'a [[f32; 4]],
    pooled: Parts<'a, f32>,
    encoded: Parts<'a, f32>,
    hidden: Parts<'a, f32>,
    cell: Parts<'a, f32>,
    mixed: Parts<'a, f32>,
    change: Parts<'a, f32>,
    points: Parts<'a, f32>,
    maxima: Parts<'a, f32>,
}

/// An item of a stage.
struct Item<'a> {
    pass: &'a Pass<'a>,
    task: Task,
}

impl WithSimd for Item<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { pass, task } = self;
        let model = pass.model;
        let (hidden, layers) = (model.hidden, model.core.len());
        match model.stages[task.stage] {
            Stage::PoolMean => {
                let mean =
                    model.encoder.mean(simd, task.item, pass.features, &pass.memory.material);
                let lanes = S::F32_LANES;
                let units = outputs(task.item, lanes, model.encoder.width());
                // SAFETY: these units are this item's alone.
                simd.partial_store_f32s(unsafe { pass.pooled.part(units) }, mean);
            }
            Stage::Encode => {
                // SAFETY: written in an earlier stage.
                let pooled = unsafe { pass.pooled.read(0..model.encoder.width()) };
                let sums = product(simd, &model.second, task.item, pooled);
                // SAFETY: these units are this item's alone.
                let units = unsafe { pass.encoded.part(model.second.outputs(task.item)) };
                simd.partial_store_f32s(units, sums);
            }
            Stage::PoolMax => {
                let particles = task.item * BLOCK..((task.item + 1) * BLOCK).min(model.particles);
                let room = BLOCK * model.encoder.width();
                // SAFETY: no other item has this thread's number while this one is under way.
                let (points, maxima) = unsafe {
                    let points = pass.points.part(task.thread * room..(task.thread + 1) * room);
                    (points, pass.maxima.part(model.state(task.thread)))
                };
                let features = &pass.features[particles.clone()];
                let material = &pass.memory.material[particles];
                model.encoder.raise(simd, &model.second, features, material, points, maxima);
            }
            Stage::JoinMax => {
                // SAFETY: written in an earlier stage.
                let maxima = unsafe { pass.maxima.read(0..pass.maxima.len()) };
                // Behind the mean, if that is pooled too.
                let end = pass.encoded.len();
                // SAFETY: the stage has one item.
                let largest = unsafe { pass.encoded.part(end - hidden..end) };
                largest.fill(f32::NEG_INFINITY);
                for thread in maxima.chunks_exact(hidden) {
                    for (largest, &value) in largest.iter_mut().zip(thread) {
                        *largest = if value > *largest { value } else { *largest };
                    }
                }
            }
            Stage::Core(layer) => {
                let state = model.state(layer);
                // SAFETY: written in an earlier stage.
                let input = unsafe {
                    match layer.checked_sub(1) {
                        None => pass.encoded.read(0..pass.encoded.len()),
                        Some(below) => pass.hidden.read(model.state(below)),
                    }
                };
                let last = &pass.memory.hidden[state.clone()];
                let cell = pass.memory.cell.get(state.clone()).unwrap_or_default();
                let layer = &model.core[layer];
                let next =
                    layer.step::<S, 1, GATE_SUM_PARTS>(simd, task.item, [input], [last], [cell]);
                let units = layer.units(task.item);
                let units = state.start + units.start..state.start + units.end;
                // SAFETY: these units are this item's alone.
                simd.partial_store_f32s(unsafe { pass.hidden.part(units.clone()) }, next.hidden[0]);
                if let Some([cell]) = next.cell {
                    // SAFETY: as above.
                    simd.partial_store_f32s(unsafe { pass.cell.part(units) }, cell);
                }
            }
            Stage::Mix => {
                // SAFETY: written in an earlier stage.
                let signal = unsafe { pass.hidden.read(model.state(layers - 1)) };
                let sums = product(simd, &model.mixer, task.item, signal);
                let mixed = activate(simd, model.activation, sums);
                // SAFETY: these units are this item's alone.
                let units = unsafe { pass.mixed.part(model.mixer.outputs(task.item)) };
                simd.partial_store_f32s(units, mixed);
            }
            Stage::Decode => {
                // SAFETY: written in an earlier stage.
                let mixed = unsafe { pass.mixed.read(0..hidden) };
                let sums = product(simd, &model.decoder, task.item, mixed);
                // SAFETY: these units are this item's alone.
                let units = unsafe { pass.change.part(model.decoder.outputs(task.item)) };
                simd.partial_store_f32s(units, sums);
            }
        }
    }
}

/// A panel of a linear layer's outputs for one row.
#[inline(always)]
fn product<S: Simd>(simd: S, linear: &Linear, panel: usize, row: &[f32]) -> S::f32s {
    let sums = [linear.bias(simd, panel)];
    let [[sum]] = add_products::<S, 1, 1, SUM_PARTS>(simd, [linear.panel(panel)], [row], sums);
    sum
}
