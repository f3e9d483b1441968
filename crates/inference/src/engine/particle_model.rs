//! The particle model, one frame of a stream at a time.
//!
//! Particles are processed cell by cell of the grid, in blocks small enough for the data between their layers to stay in
//! the nearest caches. Once a frame's particles are in the order of the hidden state, the rest is one job of the thread
//! pool: particles are encoded and summed on the nodes, the layers on nodes run one after the other, particles gather from
//! the nodes and are decoded; at last the rules correct the prediction.
use std::collections::BTreeMap;

use pulp::{Arch, Simd, WithSimd};

use super::{
    core::CoreLayer,
    grid::{self, Grid},
    hidden_state::{ParticleMemory, StreamParticles, stride},
    merged::merged,
    order::reorder,
};
use crate::{
    checkpoint::{
        Description, Rules, Weights,
        plan::{
            self, Plan,
            Stage::{Convolution, Decode, Encode, ToNodes},
        },
    },
    kernels::{
        nodes::{Nodes, Window},
        vectors::Lanes,
    },
    ops::{
        ballistic::Motion,
        convolution::packed::Lists,
        decoder::ResidualStep,
        features::{ParticleFeatures, ParticleInputs, STATE_COLUMNS},
        linear::packed::{Linear, SplitLinear},
        node_inputs::rows::Walls,
        rules::{self, Correction, Observed, Predicted, elastic::ExpectedNodes},
        transfer::segments::Segments,
    },
};
use eddy_frames::{Frame, FrameView};
use eddy_threads::{DisjointSlice, Task, ThreadPool};

/// Particles per block: a multiple of the rows that are computed at once.
pub(super) const BLOCK: usize = 48;

/// The packed network.
#[derive(Debug)]
pub(super) struct ParticleModel {
    /// The instruction set that the weights are packed for.
    arch: Arch,
    pub(super) features: ParticleFeatures,
    /// With a constant output of one, whose sum is the mass of a node, and padding for the nodes' own features.
    pub(super) encoder: SplitLinear,
    pub(super) grid: Grid,
    pub(super) context: SplitLinear,
    pub(super) core: Vec<CoreLayer>,
    pub(super) mixer: SplitLinear,
    pub(super) decoder: SplitLinear,
    /// H.
    pub(super) hidden: usize,
    /// From the decoder's outputs to the next state, in the domain of training.
    pub(super) step: ResidualStep,
    rules: Rules,
    /// Distance between particles at rest (domain lengths).
    spacing: f32,
    /// The stages of a frame, in order.
    pub(super) stages: Vec<Stage>,
}

/// Buffers between the stages of a frame.
#[derive(Debug)]
pub(super) struct Scratch {
    grid: grid::Scratch,
    /// Positions and velocities in the order of the hidden state.
    state: [Vec<[f32; 2]>; 2],
    /// Input of the network, `[block, F, BLOCK]`.
    features: Vec<f32>,
    segments: Segments,
    /// The sums of each segment on the nodes.
    segment_sums: Vec<f32>,
    /// The motion of each slot's particle after the ballistic step.
    ballistic_motion: Vec<Motion>,
    rules: rules::Scratch,
    /// One per thread.
    buffers: Vec<LayerBuffers>,
}

/// Buffers between the layers of a block.
#[derive(Debug)]
pub(super) struct LayerBuffers {
    /// Input of a layer, `[BLOCK, its width]`.
    pub(super) input: Vec<f32>,
    /// Its output, `[BLOCK, its width]`.
    pub(super) output: Vec<f32>,
    /// What the features are computed from, `[STATE_COLUMNS, BLOCK]`, or the new cells of a layer of the core, `[BLOCK, its width]`.
    pub(super) states: Vec<f32>,
}

impl ParticleModel {
    pub(super) fn pack(
        arch: Arch,
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
    ) -> Self {
        let lanes = arch.dispatch(Lanes);
        let grid = description.grid.as_ref();
        let grid = grid.expect("checked descriptions of particle models have one");
        let tensors = &merged(grid, tensors);
        let linear = |layer| SplitLinear::named(lanes, tensors, layer);
        let spacing = grid.spacing;
        let grid = Grid::pack(lanes, grid, tensors);
        let rules = description.rules;
        Self {
            arch,
            features: ParticleFeatures::new(description),
            encoder: linear("encoder.0"),
            context: linear("context"),
            core: (0..description.sizes.layers)
                .map(|layer| CoreLayer::pack(lanes, description, tensors, layer))
                .collect(),
            mixer: linear("mixer"),
            decoder: linear("decoder"),
            hidden: description.sizes.hidden,
            step: ResidualStep::new(description),
            stages: Plan::new(description)
                .stages()
                .into_iter()
                .map(Stage::Network)
                .chain(rules.stages().into_iter().map(Stage::Rule))
                .collect(),
            grid,
            rules,
            spacing,
        }
    }

    /// Length of a block's features.
    pub(super) fn columns(&self) -> usize {
        BLOCK * self.features.count
    }

    /// Approximate number of multiplications per particle and frame, without the layers on nodes.
    pub(super) fn work(&self) -> usize {
        let core = self.core.iter().flat_map(CoreLayer::linears).map(Linear::weight_count);
        let ends = [&self.encoder, &self.context, &self.mixer, &self.decoder];
        core.chain(ends.map(SplitLinear::weight_count)).sum()
    }

    pub(super) fn scratch(&self, threads: usize) -> Scratch {
        let widths = [&self.encoder, &self.mixer, &self.decoder];
        let widths = widths.map(SplitLinear::stride).into_iter();
        let states = stride(self.hidden);
        let widest = widths.max().unwrap_or(0).max(states).max(self.grid.read_width());
        let zeros = |width| vec![0.0; BLOCK * width];
        let buffers = || LayerBuffers {
            input: zeros(widest),
            output: zeros(widest),
            states: zeros(states.max(STATE_COLUMNS)),
        };
        Scratch {
            grid: grid::Scratch::default(),
            state: Default::default(),
            features: Vec::new(),
            segments: Segments::default(),
            segment_sums: Vec::new(),
            ballistic_motion: Vec::new(),
            rules: rules::Scratch::default(),
            buffers: (0..threads).map(|_| buffers()).collect(),
        }
    }

    /// Observes `frame` and writes the predicted positions and velocities to `next`.
    #[expect(clippy::too_many_lines, reason = "the borrows of one frame, gathered for its stages")]
    pub(super) fn step(
        &self,
        pool: &mut ThreadPool,
        alone: bool,
        scratch: &mut Scratch,
        memory: &mut ParticleMemory,
        frame: FrameView<'_>,
        next: &mut Frame,
    ) {
        let ballistic = self.features.ballistic(&frame.domain);
        let (lower, upper) = (frame.domain.lower, frame.domain.upper);
        let StreamParticles { order, material, rest, lattices, stiffness } = &*memory.stream;
        let particles = order.len();
        let window = Window { particles: 0..particles, lower, upper };
        reorder(pool, alone, order, frame.particles, &mut scratch.state);
        let Grid { cell_width, levels, .. } = self.grid;
        scratch.grid.nodes.rebuild(&scratch.state[0], &[window], cell_width, levels);
        self.resize(scratch, particles);

        let Scratch {
            grid,
            state: [position, velocity],
            features,
            segments,
            segment_sums,
            ballistic_motion,
            rules,
            buffers,
        } = scratch;
        let grid::Scratch { nodes, lists, columns } = grid;
        let walls = Walls::new(self.arch, ballistic, &frame.domain, self.grid.cell_width, columns);
        let observed = Observed {
            position,
            velocity,
            nodes,
            ballistic,
            domain: frame.domain,
            spacing: self.spacing,
            rest,
            lattices,
            expected: ExpectedNodes::new(&mut memory.expected_nodes),
            order,
        };
        let predicted = Predicted {
            position: DisjointSlice::new(&mut next.position),
            velocity: DisjointSlice::new(&mut next.velocity),
            material: &next.material,
        };
        let context = StepContext {
            model: self,
            width: stride(self.hidden),
            inputs: ParticleInputs {
                position,
                velocity,
                ballistic,
                material,
                rest,
                stiffness: *stiffness,
            },
            place: order,
            walls,
            nodes,
            segments,
            begun: memory.begun,
            features: DisjointSlice::new(features),
            sums: DisjointSlice::new(segment_sums),
            ballistic_motion: DisjointSlice::new(ballistic_motion),
            lists: Lists {
                numbers: lists.each_mut().map(|list| DisjointSlice::new(list)),
                widths: &self.grid.widths,
            },
            buffers: DisjointSlice::new(buffers),
            hidden: DisjointSlice::new(&mut memory.hidden),
            cell: DisjointSlice::new(&mut memory.cell),
            expected_velocity: DisjointSlice::new(&mut memory.expected_velocity),
            predicted,
            correction: self.rules.begin(rules, observed, predicted),
        };
        let stages = self.stages.iter().map(|&stage| context.items(stage));
        pool.run(stages, alone, &|task| self.arch.dispatch(Item { context: &context, task }));
        memory.begun = true;
    }

    /// Resizes the buffers for a frame's particles, cells and nodes.
    fn resize(&self, scratch: &mut Scratch, particles: usize) {
        let Scratch { grid, features, segments, segment_sums, ballistic_motion, .. } = scratch;
        self.grid.resize(grid);
        features.resize(particles.div_ceil(BLOCK) * self.columns(), 0.0);
        let [sums, most] =
            segments.cut(&grid.nodes, BLOCK).map(|nodes| nodes * self.grid.written_width());
        segment_sums.reserve(most.saturating_sub(segment_sums.len()));
        segment_sums.resize(sums.max(segment_sums.len()), 0.0);
        ballistic_motion.resize(particles, Motion::default());
    }
}

/// A part of the job of a frame: after one, all threads wait for each other.
#[derive(Clone, Copy, Debug)]
pub(super) enum Stage {
    /// Of the network. A fused form of the plan's operations: all those of a block stay in the nearest cache.
    Network(plan::Stage),
    /// Of the rules.
    Rule(rules::Stage),
}

/// One frame in progress.
pub(super) struct StepContext<'a> {
    pub(super) model: &'a ParticleModel,
    /// Length of the rows of hidden states.
    pub(super) width: usize,
    pub(super) inputs: ParticleInputs<'a>,
    /// The frame's particle in each row of the hidden state.
    pub(super) place: &'a [u32],
    pub(super) walls: Walls<'a>,
    pub(super) nodes: &'a Nodes,
    pub(super) segments: &'a Segments,
    pub(super) begun: bool,
    pub(super) features: DisjointSlice<'a, f32>,
    /// The sums of each segment on the nodes.
    pub(super) sums: DisjointSlice<'a, f32>,
    pub(super) ballistic_motion: DisjointSlice<'a, Motion>,
    pub(super) lists: Lists<'a>,
    pub(super) buffers: DisjointSlice<'a, LayerBuffers>,
    pub(super) hidden: DisjointSlice<'a, f32>,
    pub(super) cell: DisjointSlice<'a, f32>,
    pub(super) expected_velocity: DisjointSlice<'a, [f32; 2]>,
    pub(super) predicted: Predicted<'a>,
    correction: Correction<'a>,
}

impl StepContext<'_> {
    /// Number of items of a stage.
    fn items(&self, stage: Stage) -> usize {
        match stage {
            Stage::Network(Encode | Decode) => self.nodes.order().len().div_ceil(BLOCK),
            Stage::Network(ToNodes) => self.nodes.rows().len(),
            Stage::Network(Convolution(layer)) => self.model.grid.layers[layer].blocks(self.nodes),
            Stage::Rule(stage) => self.correction.items(stage),
        }
    }
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
        let StepContext { model: ParticleModel { grid, stages, .. }, nodes, lists, .. } = context;
        match stages[stage] {
            Stage::Network(Encode) => context.encode(simd, item, thread),
            Stage::Network(Decode) => context.decode(simd, item, thread),
            Stage::Network(ToNodes) => context.to_nodes(simd, item),
            Stage::Network(Convolution(layer)) => grid.layers[layer].run(simd, item, nodes, lists),
            Stage::Rule(stage) => context.correction.run(stage, item),
        }
    }
}
