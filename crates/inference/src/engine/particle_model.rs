//! The particle model, one frame at a time: `model/particle_model.rs` for one stream.
//!
//! Particles are worked on cell by cell of the grid, in blocks small enough for what their layers hand on
//! to stay in the nearest caches. Once a frame's particles are in the order of the stream's memory, the rest
//! is one job: particles are encoded and write to the nodes, the nodes' layers follow each other, particles
//! read and are decoded; at last liquids get their area back, solids their shape, and bodies their momentum or their rest.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use std::collections::BTreeMap;

use pulp::{Arch, Simd, WithSimd};

use super::{
    core::CoreLayer,
    crew::{Crew, Parts, Task},
    linear::Linear,
    memory::{Memory, stride},
    order::put_in_order,
    particle_features::{FEATURES, Features, Known, STATES, State},
    pieces::Pieces,
    rules::{self, Correction, Observed, Predicted, RuleSet},
    scales::velocity_limits,
    surroundings::{self, Fields, Grid, Walls},
};
use crate::{
    checkpoint::{Description, Weights, layout},
    kernels::{
        nodes::{Nodes, Window},
        vectors::Lanes,
    },
};
use eddy_frames::{Frame, FrameView};

/// Particles of a block: a multiple of the rows that are computed at once.
pub(super) const BLOCK: usize = 48;

/// Numbers of a block's features.
pub(super) const COLUMNS: usize = BLOCK * FEATURES;

/// The packed network.
#[derive(Debug)]
pub(super) struct ParticleModel {
    /// Whose vectors the weights are packed for.
    arch: Arch,
    pub(super) features: Features,
    pub(super) encoder: [Linear; 2],
    pub(super) grid: Grid,
    pub(super) context: Linear,
    pub(super) core: Vec<CoreLayer>,
    pub(super) mixer: Linear,
    pub(super) decoder: Linear,
    /// H.
    pub(super) hidden: usize,
    /// Bounds of the network's velocities (domain lengths per second).
    pub(super) slowest: [f32; 2],
    pub(super) fastest: [f32; 2],
    rules: RuleSet,
    /// The stages of a frame, in order.
    pub(super) stages: Vec<Stage>,
}

/// Room for what stages hand on.
#[derive(Debug)]
pub(super) struct Room {
    grid: surroundings::Room,
    /// Positions and velocities in the order of the stream's memory.
    state: [Vec<[f32; 2]>; 2],
    /// Input of the network, `[block, F, BLOCK]`.
    features: Vec<f32>,
    pieces: Pieces,
    /// What each piece adds to the nodes.
    written: Vec<f32>,
    /// The ballistic step of each slot.
    fallen: Vec<State>,
    rules: rules::Scratch,
    /// For each thread.
    benches: Vec<Bench>,
}

/// Room for what layers hand on within a block.
#[derive(Debug)]
pub(super) struct Bench {
    /// Input of a layer, `[BLOCK, its width]`.
    pub(super) input: Vec<f32>,
    /// Its output, `[BLOCK, its width]`.
    pub(super) output: Vec<f32>,
    /// States that come before, of particles or of the core's units, `[BLOCK, their width]`.
    pub(super) states: Vec<f32>,
}

impl ParticleModel {
    pub(super) fn pack(
        arch: Arch,
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
    ) -> Self {
        let lanes = arch.dispatch(Lanes);
        let linear = |layer| Linear::named(lanes, tensors, layer);
        let (slowest, fastest) = velocity_limits(&description.normalization);
        let surroundings = description.surroundings.as_ref();
        let surroundings = surroundings.expect("a description that was checked has them");
        let rules = RuleSet::new(description);
        Self {
            arch,
            features: Features::new(description),
            encoder: [linear("encoder.0"), with_one(lanes, tensors, "encoder.1")],
            grid: Grid::pack(lanes, surroundings, tensors),
            context: linear("context"),
            core: (0..description.sizes.layers)
                .map(|layer| CoreLayer::pack(lanes, description, tensors, layer))
                .collect(),
            mixer: linear("mixer"),
            decoder: linear("decoder"),
            hidden: description.sizes.hidden,
            slowest,
            fastest,
            stages: stages(&rules),
            rules,
        }
    }

    /// Multiplications of a frame for one particle, without the grid's.
    pub(super) fn work(&self) -> usize {
        let core = self.core.iter().flat_map(CoreLayer::linears);
        let ends = [&self.context, &self.mixer, &self.decoder];
        self.encoder.iter().chain(core).chain(ends).map(Linear::numbers).sum()
    }

    pub(super) fn room(&self, threads: usize) -> Room {
        let widths = [&self.encoder[0], &self.encoder[1], &self.mixer, &self.decoder];
        let widths = widths.map(Linear::stride).into_iter();
        let states = stride(self.hidden);
        let widest = widths.max().unwrap_or(0).max(states).max(self.grid.read());
        let zeros = |width| vec![0.0; BLOCK * width];
        let bench = || Bench {
            input: zeros(widest),
            output: zeros(widest),
            states: zeros(states.max(STATES)),
        };
        Room {
            grid: surroundings::Room::default(),
            state: Default::default(),
            features: Vec::new(),
            pieces: Pieces::default(),
            written: Vec::new(),
            fallen: Vec::new(),
            rules: self.rules.scratch(),
            benches: (0..threads).map(|_| bench()).collect(),
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
        let ballistic = self.features.ballistic(&frame.domain);
        let (lower, upper) = (frame.domain.lower, frame.domain.upper);
        let particles = memory.order.len();
        let window = Window { particles: 0..particles, lower, upper };
        put_in_order(crew, alone, &memory.order, frame.particles, &mut room.state);
        room.grid.nodes.rebuild(&room.state[0], &[window], self.grid.cell_width);
        self.make_room(room, particles);

        let Room { grid, features, pieces, written, fallen, rules, benches, .. } = room;
        let Room { state: [position, velocity], .. } = room;
        let surroundings::Room { nodes, fields, columns } = grid;
        let walls = Walls::new(self.arch, ballistic, &frame.domain, self.grid.cell_width, columns);
        let observed = Observed {
            position,
            velocity,
            nodes,
            ballistic,
            domain: frame.domain,
            rest: &memory.rest,
            order: &memory.order,
        };
        let predicted = Predicted {
            position: Parts::new(&mut next.position),
            velocity: Parts::new(&mut next.velocity),
            material: &next.material,
        };
        let pass = Pass {
            model: self,
            width: stride(self.hidden),
            known: Known {
                position,
                velocity,
                ballistic,
                material: &memory.material,
                rest: &memory.rest,
            },
            place: &memory.order,
            walls,
            nodes,
            pieces,
            begun: memory.begun,
            features: Parts::new(features),
            sums: Parts::new(written),
            fallen: Parts::new(fallen),
            fields: fields.each_mut().map(|numbers| Parts::new(numbers)),
            benches: Parts::new(benches),
            hidden: Parts::new(&mut memory.hidden),
            cell: Parts::new(&mut memory.cell),
            foretold: Parts::new(&mut memory.foretold),
            predicted,
            correction: self.rules.begin(rules, observed, predicted),
        };
        let stages = self.stages.iter().map(|&stage| pass.items(stage));
        crew.run(stages, alone, &|task| self.arch.dispatch(Item { pass: &pass, task }));
        memory.begun = true;
    }

    /// Makes room for what is at particles, cells and nodes.
    fn make_room(&self, room: &mut Room, particles: usize) {
        let Room { grid, features, pieces, written, fallen, .. } = room;
        self.grid.make_room(grid);
        features.resize(particles.div_ceil(BLOCK) * COLUMNS, 0.0);
        let [sums, most] = pieces.cut(&grid.nodes, BLOCK).map(|nodes| nodes * self.grid.written());
        written.reserve(most.saturating_sub(written.len()));
        written.resize(sums.max(written.len()), 0.0);
        fallen.resize(particles, State::default());
    }
}

/// The second layer of the encoder, with a one behind its outputs, for the mass of the nodes, and room for
/// the nodes' own features.
fn with_one(lanes: usize, tensors: &BTreeMap<String, Weights>, layer: &str) -> Linear {
    let [mut weight, mut bias] = layout::names(layer).map(|name| tensors[&name].clone());
    let (outputs, inputs) = (weight.shape[0] + layout::NODE_FEATURES, weight.shape[1]);
    weight.shape[0] = outputs;
    weight.values.resize(outputs * inputs, 0.0);
    bias.shape[0] = outputs;
    bias.values.push(1.0);
    bias.values.resize(outputs, 0.0);
    Linear::pack(lanes, &weight, &bias, 0, 1)
}

/// A stage of a frame.
#[derive(Clone, Copy, Debug)]
pub(super) enum Stage {
    /// Features, encoder, sums on nodes; an item is a block of slots.
    Encode,
    /// The blocks' sums are joined; an item is a row of nodes.
    Write,
    /// A layer on the nodes; an item is a block of them.
    Layer(usize),
    /// Particles read, core, decoder; an item is a block of slots.
    Decode,
    /// A step of a rule.
    Rule(rules::Stage),
}

/// The stages of a frame, in order: the network's, then the rules'.
fn stages(rules: &RuleSet) -> Vec<Stage> {
    let layers = (0..surroundings::STAGES).map(Stage::Layer);
    let network = [Stage::Encode, Stage::Write].into_iter().chain(layers).chain([Stage::Decode]);
    network.chain(rules.stages().into_iter().map(Stage::Rule)).collect()
}

/// One frame under way.
pub(super) struct Pass<'a> {
    pub(super) model: &'a ParticleModel,
    /// Length of the rows of hidden states.
    pub(super) width: usize,
    pub(super) known: Known<'a>,
    /// The particle of the frame in each row of the memory.
    pub(super) place: &'a [u32],
    pub(super) walls: Walls<'a>,
    pub(super) nodes: &'a Nodes,
    pub(super) pieces: &'a Pieces,
    pub(super) begun: bool,
    pub(super) features: Parts<'a, f32>,
    /// What each piece adds to the nodes.
    pub(super) sums: Parts<'a, f32>,
    pub(super) fallen: Parts<'a, State>,
    pub(super) fields: Fields<'a>,
    pub(super) benches: Parts<'a, Bench>,
    pub(super) hidden: Parts<'a, f32>,
    pub(super) cell: Parts<'a, f32>,
    pub(super) foretold: Parts<'a, [f32; 2]>,
    pub(super) predicted: Predicted<'a>,
    correction: Correction<'a>,
}

impl Pass<'_> {
    /// How many items a stage has.
    fn items(&self, stage: Stage) -> usize {
        match stage {
            Stage::Encode | Stage::Decode => self.nodes.order().len().div_ceil(BLOCK),
            Stage::Write => self.nodes.rows().len(),
            Stage::Layer(layer) => self.model.grid.items(layer, self.nodes),
            Stage::Rule(stage) => self.correction.items(stage),
        }
    }
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
        let Self { pass, task: Task { stage, item, thread } } = self;
        let Pass { model: ParticleModel { grid, stages, .. }, nodes, fields, .. } = pass;
        match stages[stage] {
            Stage::Encode => pass.encode(simd, item, thread),
            Stage::Decode => pass.decode(simd, item, thread),
            Stage::Write => {
                // SAFETY: this stage only reads what the pieces add.
                let sums = unsafe { pass.sums.read(0..pass.sums.len()) };
                let row = &nodes.rows()[item];
                grid.write(simd, nodes, row, (pass.pieces, sums), &pass.walls, fields);
            }
            Stage::Layer(layer) => grid.layer(simd, layer, item, nodes, fields),
            Stage::Rule(stage) => pass.correction.run(stage, item),
        }
    }
}
