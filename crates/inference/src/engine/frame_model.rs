//! The frame model, one frame of a stream at a time.
//!
//! Reading the weights once takes nearly all of the time. An item of a stage is a panel of its outputs, or a block of
//! particles where the maximum is pooled.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use std::{collections::BTreeMap, ops::Range};

use pulp::{Arch, Simd, WithSimd};

use super::{
    core::CoreLayer,
    encoder::{BLOCK, Encoder},
    hidden_state::FrameMemory,
};
use crate::{
    checkpoint::{
        Activation, Description, Pooling, Weights,
        plan::{FrameStage, Plan},
    },
    kernels::{activation::Activate, vectors::Lanes},
    ops::{
        decoder::Decoded,
        linear::packed::{Linear, add_products, outputs},
    },
};
use eddy_frames::{Frame, FrameView};
use eddy_threads::{DisjointSlice, Task, ThreadPool};

/// Partial sums of each product over a layer's inputs: enough to hide the latency of additions.
const PARTIAL_SUMS: usize = 4;
/// The same where several gates are summed at once.
const GATE_PARTIAL_SUMS: usize = 2;

/// The stages of a frame, in order.
#[derive(Clone, Copy, Debug)]
enum Stage {
    /// First Linear, activation, mean over the particles.
    PoolMean,
    /// Second Linear of the mean.
    Encode,
    /// First Linear, activation, second Linear, maximum over each thread's particles.
    PoolMax,
    /// Maximum over the threads.
    JoinMax,
    /// A layer of the core.
    Core(usize),
    /// Linear, activation.
    Mix,
    /// Linear: the output of each particle.
    Decode,
}

/// The packed network.
#[derive(Debug)]
pub(super) struct FrameModel {
    /// The instruction set that the weights are packed for.
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
    decoded: Decoded,
}

/// Buffers between the stages of a frame.
#[derive(Debug)]
pub(super) struct Scratch {
    /// Scaled features, `[N, 4]`.
    features: Vec<[f32; 4]>,
    /// `[E]`.
    pooled: Vec<f32>,
    /// Input of the core: `[H]`, or `[2 H]` with both poolings.
    encoded: Vec<f32>,
    /// New outputs of the core's layers, `[layer, H]`.
    hidden: Vec<f32>,
    /// Their new cells; empty except for LSTM.
    cell: Vec<f32>,
    /// `[H]`.
    mixed: Vec<f32>,
    /// `[2 N]`.
    output: Vec<f32>,
    /// Maximum pooling: a block of points for each thread, `[thread, BLOCK, E]`.
    points: Vec<f32>,
    /// Maximum pooling: the maxima over each thread's particles, `[thread, H]`.
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
        Self {
            arch,
            encoder: Encoder::pack(lanes, description, tensors),
            second: linear("encoder.1"),
            core: (0..description.sizes.layers)
                .map(|layer| CoreLayer::pack(lanes, description, tensors, layer))
                .collect(),
            mixer: linear("mixer"),
            activation: description.frame.activation,
            pooling: description.frame.pooling,
            stages: stages(&Plan::new(description)),
            particles: decoder.output() / 2,
            decoder,
            hidden: description.sizes.hidden,
            decoded: Decoded::new(description),
        }
    }

    /// Number of stages of a frame.
    pub(super) fn stages(&self) -> usize {
        self.stages.len()
    }

    /// Approximate number of multiplications per frame.
    pub(super) fn work(&self) -> usize {
        let core = self.core.iter().flat_map(CoreLayer::linears).map(Linear::weight_count);
        let linears = core.sum::<usize>() + self.mixer.weight_count() + self.decoder.weight_count();
        let points = self.particles * self.encoder.width();
        match self.pooling {
            Pooling::Mean => linears + 16 * points,
            Pooling::Max | Pooling::MeanMax => linears + points * self.hidden,
        }
    }

    pub(super) fn scratch(&self, threads: usize) -> Scratch {
        let states = self.core.len() * self.hidden;
        let (poolings, maxima) = match self.pooling {
            Pooling::Mean => (1, 0),
            Pooling::Max => (1, threads),
            Pooling::MeanMax => (2, threads),
        };
        Scratch {
            features: vec![[0.0; 4]; self.particles],
            pooled: vec![0.0; self.encoder.width()],
            encoded: vec![0.0; poolings * self.hidden],
            hidden: vec![0.0; states],
            cell: vec![0.0; if self.core[0].has_cell() { states } else { 0 }],
            mixed: vec![0.0; self.hidden],
            output: vec![0.0; 2 * self.particles],
            points: vec![0.0; maxima * BLOCK * self.encoder.width()],
            maxima: vec![0.0; maxima * self.hidden],
        }
    }

    /// Observes `frame` and writes the predicted positions and velocities to `next`.
    pub(super) fn step(
        &self,
        pool: &mut ThreadPool,
        alone: bool,
        scratch: &mut Scratch,
        memory: &mut FrameMemory,
        frame: FrameView<'_>,
        next: &mut Frame,
    ) {
        self.encoder.scale(frame.particles, &mut scratch.features);
        scratch.maxima.fill(f32::NEG_INFINITY);
        let context = StepContext {
            model: self,
            memory,
            features: &scratch.features,
            pooled: DisjointSlice::new(&mut scratch.pooled),
            encoded: DisjointSlice::new(&mut scratch.encoded),
            hidden: DisjointSlice::new(&mut scratch.hidden),
            cell: DisjointSlice::new(&mut scratch.cell),
            mixed: DisjointSlice::new(&mut scratch.mixed),
            output: DisjointSlice::new(&mut scratch.output),
            points: DisjointSlice::new(&mut scratch.points),
            maxima: DisjointSlice::new(&mut scratch.maxima),
        };
        let items = self.stages.iter().map(|&stage| self.items(stage));
        pool.run(items, alone, &|task| self.arch.dispatch(Item { context: &context, task }));
        memory.hidden.copy_from_slice(&scratch.hidden);
        memory.cell.copy_from_slice(&scratch.cell);

        let outputs = scratch.output.as_chunks::<2>().0;
        let after = next.position.iter_mut().zip(&mut next.velocity);
        for (particle, ((position, velocity), &output)) in after.zip(outputs).enumerate() {
            let (x, v) = frame.particles.motion(particle);
            (*position, *velocity) = self.decoded.next(x, v, output);
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

    /// The range of a layer's units in `[layer, H]`.
    fn state(&self, layer: usize) -> Range<usize> {
        layer * self.hidden..(layer + 1) * self.hidden
    }
}

/// The parts of the plan's stages that threads share.
fn stages(plan: &Plan) -> Vec<Stage> {
    let parts = |stage| match stage {
        FrameStage::Means => vec![Stage::PoolMean, Stage::Encode],
        FrameStage::Maxima => vec![Stage::PoolMax, Stage::JoinMax],
        FrameStage::Core(number) => vec![Stage::Core(number)],
        FrameStage::Mix => vec![Stage::Mix],
        FrameStage::Decode => vec![Stage::Decode],
    };
    plan.frame_stages().into_iter().flat_map(parts).collect()
}

/// One frame in progress. Each array is written panel by panel in one stage and read in later ones.
struct StepContext<'a> {
    model: &'a FrameModel,
    memory: &'a FrameMemory,
    features: &'a [[f32; 4]],
    pooled: DisjointSlice<'a, f32>,
    encoded: DisjointSlice<'a, f32>,
    hidden: DisjointSlice<'a, f32>,
    cell: DisjointSlice<'a, f32>,
    mixed: DisjointSlice<'a, f32>,
    output: DisjointSlice<'a, f32>,
    points: DisjointSlice<'a, f32>,
    maxima: DisjointSlice<'a, f32>,
}

/// An item of a stage.
struct Item<'a> {
    context: &'a StepContext<'a>,
    task: Task,
}

impl WithSimd for Item<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { context, task: Task { stage, item, thread } } = self;
        let StepContext { model, pooled, encoded, hidden, mixed, output, .. } = context;
        match model.stages[stage] {
            Stage::PoolMean => context.pool_mean(simd, item),
            Stage::Encode => {
                let input = (pooled, 0..model.encoder.width());
                context.linear(simd, &model.second, item, input, None, encoded);
            }
            Stage::PoolMax => context.pool_max(simd, item, thread),
            Stage::JoinMax => context.join_max(),
            Stage::Core(layer) => context.core(simd, layer, item),
            Stage::Mix => {
                let input = (hidden, model.state(model.core.len() - 1));
                context.linear(simd, &model.mixer, item, input, Some(model.activation), mixed);
            }
            Stage::Decode => {
                let input = (mixed, 0..model.hidden);
                context.linear(simd, &model.decoder, item, input, None, output);
            }
        }
    }
}

impl StepContext<'_> {
    /// A panel of a linear layer's outputs, from an array that an earlier stage has written.
    #[inline(always)]
    fn linear<S: Simd>(
        &self,
        simd: S,
        linear: &Linear,
        panel: usize,
        (input, range): (&DisjointSlice<'_, f32>, Range<usize>),
        activation: Option<Activation>,
        output: &DisjointSlice<'_, f32>,
    ) {
        // SAFETY: an earlier stage has written the input; only this item uses these outputs.
        let (row, units) = unsafe { (input.read(range), output.part(linear.outputs(panel))) };
        let biases = [linear.bias(simd, panel)];
        let [[mut sum]] =
            add_products::<S, 1, 1, PARTIAL_SUMS>(simd, [linear.panel(panel)], [row], biases);
        if let Some(activation) = activation {
            sum = activation.value(simd, sum);
        }
        simd.partial_store_f32s(units, sum);
    }

    #[inline(always)]
    fn pool_mean<S: Simd>(&self, simd: S, panel: usize) {
        let Self { model: FrameModel { encoder, .. }, memory, features, .. } = self;
        let mean = encoder.mean(simd, panel, features, &memory.material);
        let units = outputs(panel, S::F32_LANES, encoder.width());
        // SAFETY: only this item uses these units.
        simd.partial_store_f32s(unsafe { self.pooled.part(units) }, mean);
    }

    #[inline(always)]
    fn pool_max<S: Simd>(&self, simd: S, block: usize, thread: usize) {
        let model = self.model;
        let particles = block * BLOCK..((block + 1) * BLOCK).min(model.particles);
        let length = BLOCK * model.encoder.width();
        // SAFETY: no other running item has this thread number.
        let (points, maxima) = unsafe {
            let points = self.points.part(thread * length..(thread + 1) * length);
            (points, self.maxima.part(model.state(thread)))
        };
        let features = &self.features[particles.clone()];
        let material = &self.memory.material[particles];
        model.encoder.update_maxima(simd, &model.second, features, material, points, maxima);
    }

    /// Writes the maxima behind the mean, if that is pooled too.
    #[inline(always)]
    fn join_max(&self) {
        let (hidden, end) = (self.model.hidden, self.encoded.len());
        // SAFETY: an earlier stage has written the maxima, and this stage has one item.
        let (maxima, largest) = unsafe {
            (self.maxima.read(0..self.maxima.len()), self.encoded.part(end - hidden..end))
        };
        largest.fill(f32::NEG_INFINITY);
        for thread in maxima.chunks_exact(hidden) {
            for (largest, &value) in largest.iter_mut().zip(thread) {
                *largest = if value > *largest { value } else { *largest };
            }
        }
    }

    #[inline(always)]
    fn core<S: Simd>(&self, simd: S, layer: usize, panel: usize) {
        let Self { model, memory, .. } = self;
        let state = model.state(layer);
        // SAFETY: an earlier stage has written the input.
        let input = unsafe {
            match layer.checked_sub(1) {
                None => self.encoded.read(0..self.encoded.len()),
                Some(below) => self.hidden.read(model.state(below)),
            }
        };
        let last = &memory.hidden[state.clone()];
        let cell = memory.cell.get(state.clone()).unwrap_or_default();
        let layer = &model.core[layer];
        let next = layer.step::<S, 1, GATE_PARTIAL_SUMS>(simd, panel, [input], [last], [cell]);
        let units = layer.units(panel);
        let units = state.start + units.start..state.start + units.end;
        // SAFETY: only this item uses these units.
        simd.partial_store_f32s(unsafe { self.hidden.part(units.clone()) }, next.hidden[0]);
        if let Some([cell]) = next.cell {
            // SAFETY: as above.
            simd.partial_store_f32s(unsafe { self.cell.part(units) }, cell);
        }
    }
}
