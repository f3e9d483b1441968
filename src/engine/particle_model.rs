//! The particle model, one frame at a time: `model/particle_model.rs` for one stream.
//!
//! Particles are worked on cell by cell of the grid, in blocks small enough for what their layers hand on
//! to stay in the nearest caches. Once a frame's particles are in the order of the stream's memory, the rest
//! is one job: particles are encoded and write to the nodes, the nodes' layers follow each other, particles
//! read and are decoded; at last liquids get their area back, solids their shape, and bodies their momentum or their rest.

use std::collections::BTreeMap;

use pulp::{Arch, Simd, WithSimd};

use super::{
    bodies::{Bodies, Sums},
    core::CoreLayer,
    crew::{Crew, Parts, Task},
    linear::Linear,
    memory::{Memory, stride},
    order::put_in_order,
    particle_features::{FEATURES, Features, Known, STATES, State},
    pieces::Pieces,
    scales::velocity_limits,
    shape::{self, Shape},
    surroundings::{self, Fields, Grid, Walls},
    volume::Volume,
};
use crate::{
    checkpoint::{Description, Weights, layout},
    frame::{Domain, Frame, FrameView, Material},
    kernels::{
        nodes::{Nodes, Window},
        vectors::Lanes,
    },
};

/// Particles of a block: a multiple of the rows that are computed at once.
pub(super) const BLOCK: usize = 48;

/// Numbers of a block's features.
pub(super) const COLUMNS: usize = BLOCK * FEATURES;

/// Cells of an item of the stages for free flight.
const CELLS: usize = 64;

/// Particles of an item of the stage that gives liquids their area.
const SOME: usize = 512;

/// Stages of a frame, those of the grid's layers between the third and the rest.
const BEFORE: usize = 3;
pub(super) const STAGES: usize =
    BEFORE + surroundings::STAGES + MIDDLE.len() + shape::STEPS + LAST.len();

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
    /// Between particles at rest (domain lengths).
    spacing: f32,
    /// Whether liquids keep their area, solids their shape, and bodies their momentum and their rest.
    conserve: bool,
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
    volume: Volume,
    shape: shape::Room,
    bodies: Bodies,
    /// Of the predictions for each cell.
    motions: Vec<Sums>,
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
        conserve: bool,
    ) -> Self {
        let lanes = arch.dispatch(Lanes);
        let linear = |layer| Linear::named(lanes, tensors, layer);
        let (slowest, fastest) = velocity_limits(&description.normalization);
        let surroundings = description.surroundings.as_ref();
        let surroundings = surroundings.expect("a description that was checked has them");
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
            spacing: surroundings.spacing,
            conserve,
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
            volume: Volume::new(self.spacing),
            shape: shape::Room::default(),
            bodies: Bodies::default(),
            motions: Vec::new(),
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

        let Room { grid, features, pieces, written, fallen, volume, shape, bodies, .. } = room;
        let Room { state: [position, velocity], motions, benches, .. } = room;
        let surroundings::Room { nodes, fields, columns } = grid;
        let walls = Walls::new(self.arch, ballistic, &frame.domain, self.grid.cell_width, columns);
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
            material: &next.material,
            domain: &next.domain,
            volume: Parts::new(std::slice::from_mut(volume)),
            fields: fields.each_mut().map(|numbers| Parts::new(numbers)),
            shape: shape.shape(&memory.rest, &memory.order),
            bodies: Parts::new(std::slice::from_mut(bodies)),
            motions: Parts::new(motions),
            benches: Parts::new(benches),
            hidden: Parts::new(&mut memory.hidden),
            cell: Parts::new(&mut memory.cell),
            foretold: Parts::new(&mut memory.foretold),
            position: Parts::new(&mut next.position),
            velocity: Parts::new(&mut next.velocity),
        };
        let stages = (0..STAGES).map(|stage| pass.items(Stage::number(stage)));
        crew.run(stages, alone, &|task| self.arch.dispatch(Item { pass: &pass, task }));
        memory.begun = true;
    }

    /// Makes room for what is at particles, cells and nodes.
    fn make_room(&self, room: &mut Room, particles: usize) {
        let Room { grid, features, pieces, written, fallen, bodies, motions, .. } = room;
        self.grid.make_room(grid);
        features.resize(particles.div_ceil(BLOCK) * COLUMNS, 0.0);
        let [sums, most] = pieces.cut(&grid.nodes, BLOCK).map(|nodes| nodes * self.grid.written());
        written.reserve(most.saturating_sub(written.len()));
        written.resize(sums.max(written.len()), 0.0);
        fallen.resize(particles, State::default());
        bodies.make_room(&grid.nodes);
        motions.clear();
        motions.reserve(particles);
        motions.resize(grid.nodes.cells().len(), Sums::default());
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

/// What happens to a frame, in order.
#[derive(Clone, Copy, Debug)]
enum Stage {
    /// Features, encoder, sums on nodes; an item is a block of slots.
    Encode,
    /// Which bodies there are, and which fly; one item.
    Find,
    /// The blocks' sums are joined; an item is a row of nodes.
    Write,
    /// A layer on the nodes; an item is a block of them.
    Layer(usize),
    /// Particles read, core, decoder; an item is a block of slots.
    Decode,
    /// The pressure among liquids; one item.
    Press,
    /// Liquids give way to it; an item is some particles.
    Yield,
    /// Jelly and rope get their shape back; an item is some particles.
    Shape(shape::Step),
    /// Sums over the predictions; an item is a block of cells.
    Sum,
    /// The bodies' rigid motions; one item.
    Join,
    /// What bodies that fly or rest have instead; an item is a block of cells.
    Correct,
}

/// Those after the layers and before those of the shape.
const MIDDLE: [Stage; 3] = [Stage::Decode, Stage::Press, Stage::Yield];
/// Those after these.
const LAST: [Stage; 3] = [Stage::Sum, Stage::Join, Stage::Correct];

impl Stage {
    fn number(stage: usize) -> Self {
        match stage {
            0 => Self::Encode,
            1 => Self::Find,
            2 => Self::Write,
            _ => Self::later(stage - BEFORE),
        }
    }

    /// Those from the layers on.
    fn later(stage: usize) -> Self {
        if stage < surroundings::STAGES {
            return Self::Layer(stage);
        }
        let stage = stage - surroundings::STAGES;
        if stage < MIDDLE.len() {
            return MIDDLE[stage];
        }
        let stage = stage - MIDDLE.len();
        if stage < shape::STEPS {
            return Self::Shape(shape::Step::number(stage));
        }
        LAST[stage - shape::STEPS]
    }
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
    /// Of the particles in the frame's order.
    material: &'a [Material],
    domain: &'a Domain,
    volume: Parts<'a, Volume>,
    pub(super) fields: Fields<'a>,
    shape: Shape<'a>,
    bodies: Parts<'a, Bodies>,
    motions: Parts<'a, Sums>,
    pub(super) benches: Parts<'a, Bench>,
    pub(super) hidden: Parts<'a, f32>,
    pub(super) cell: Parts<'a, f32>,
    pub(super) foretold: Parts<'a, [f32; 2]>,
    pub(super) position: Parts<'a, [f32; 2]>,
    pub(super) velocity: Parts<'a, [f32; 2]>,
}

impl Pass<'_> {
    /// How many items a stage has.
    fn items(&self, stage: Stage) -> usize {
        let conserve = usize::from(self.model.conserve);
        match stage {
            Stage::Encode | Stage::Decode => self.nodes.order().len().div_ceil(BLOCK),
            Stage::Find | Stage::Press | Stage::Join => conserve,
            Stage::Yield => conserve * self.position.len().div_ceil(SOME),
            Stage::Shape(_) => conserve * self.shape.items(),
            Stage::Write => self.nodes.rows().len(),
            Stage::Layer(layer) => self.model.grid.items(layer, self.nodes),
            Stage::Sum | Stage::Correct => conserve * self.nodes.cells().len().div_ceil(CELLS),
        }
    }

    /// The cells of an item.
    fn cells(&self, item: usize) -> std::ops::Range<usize> {
        item * CELLS..((item + 1) * CELLS).min(self.nodes.cells().len())
    }

    /// Moves the item's liquid particles to where they have room.
    #[inline(always)]
    fn give_way(&self, item: usize) {
        let particles = item * SOME..((item + 1) * SOME).min(self.position.len());
        // SAFETY: this stage only reads the pressure, and these particles are those of this item alone.
        let (volume, position, velocity) = unsafe {
            (
                &self.volume.read(0..1)[0],
                self.position.part(particles.clone()),
                self.velocity.part(particles.clone()),
            )
        };
        let material = &self.material[particles];
        volume.give_way(position, velocity, material, &self.walls.ballistic);
    }

    /// Where free fall takes a row's particle.
    #[inline(always)]
    fn free(&self, row: usize) -> State {
        self.walls.ballistic.free(self.known.position[row], self.known.velocity[row])
    }

    /// Sums over the predictions for the item's cells.
    #[inline(always)]
    fn sum(&self, item: usize) {
        let (order, cells) = (self.nodes.order(), self.cells(item));
        // SAFETY: this stage only reads these lists, and these cells are those of this item alone.
        let (bodies, position, velocity, sums) = unsafe {
            (
                &self.bodies.read(0..1)[0],
                self.position.read(0..order.len()),
                self.velocity.read(0..order.len()),
                self.motions.part(cells.clone()),
            )
        };
        for (cell, sums) in self.nodes.cells()[cells].iter().zip(sums) {
            *sums = Sums::default();
            let flies = bodies.flies(cell);
            for &row in &order[cell.slots()] {
                let (row, particle) = (row as usize, self.place[row as usize] as usize);
                if flies {
                    sums.take(&self.free(row), &(position[particle], velocity[particle]));
                } else {
                    sums.weigh(self.known.velocity[row], velocity[particle]);
                }
            }
        }
    }

    /// Gives the item's cells that fly their momentum and their spin, and lets those rest that hardly move.
    #[inline(always)]
    fn correct(&self, item: usize) {
        let order = self.nodes.order();
        // SAFETY: this stage only reads them.
        let bodies = unsafe { &self.bodies.read(0..1)[0] };
        for cell in &self.nodes.cells()[self.cells(item)] {
            let (flies, awake) = (bodies.flies(cell), bodies.awake(cell));
            if !flies && awake == 1.0 {
                continue;
            }
            for &row in &order[cell.slots()] {
                let (row, particle) = (row as usize, self.place[row as usize] as usize);
                // SAFETY: a particle has one slot, which is in a cell of this item alone.
                let (position, velocity) = unsafe {
                    let position = self.position.part(particle..particle + 1);
                    (&mut position[0], &mut self.velocity.part(particle..particle + 1)[0])
                };
                if flies {
                    let next = (*position, *velocity);
                    (*position, *velocity) =
                        bodies.correct(cell, &self.free(row), next, &self.walls.ballistic);
                } else {
                    let from = self.known.position[row];
                    for axis in 0..2 {
                        position[axis] = from[axis] + awake * (position[axis] - from[axis]);
                        velocity[axis] *= awake;
                    }
                }
            }
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
        let Pass { model: ParticleModel { grid, .. }, nodes, fields, .. } = pass;
        let particles = nodes.order().len();
        match Stage::number(stage) {
            Stage::Encode => pass.encode(simd, item, thread),
            Stage::Decode => pass.decode(simd, item, thread),
            Stage::Write => {
                // SAFETY: this stage only reads what the pieces add.
                let sums = unsafe { pass.sums.read(0..pass.sums.len()) };
                let row = &nodes.rows()[item];
                grid.write(simd, nodes, row, (pass.pieces, sums), &pass.walls, fields);
            }
            Stage::Layer(layer) => grid.layer(simd, layer, item, nodes, fields),
            // SAFETY: these stages have one item each.
            Stage::Find => unsafe {
                let Known { position, velocity, ballistic, .. } = &pass.known;
                pass.bodies.part(0..1)[0].find(nodes, position, velocity, ballistic);
            },
            // SAFETY: as above.
            Stage::Press => unsafe {
                let Pass { material, domain, .. } = pass;
                let position = pass.position.read(0..particles);
                pass.volume.part(0..1)[0].find(position, material, domain, &pass.walls.ballistic);
            },
            Stage::Yield => pass.give_way(item),
            Stage::Shape(step) => {
                let (position, velocity) = (&pass.position, &pass.velocity);
                pass.shape.run(step, item, position, velocity, &pass.walls.ballistic);
            }
            // SAFETY: as above.
            Stage::Join => unsafe {
                let sums = pass.motions.read(0..nodes.cells().len());
                pass.bodies.part(0..1)[0].join(nodes, sums, &pass.walls.ballistic);
            },
            Stage::Sum => pass.sum(item),
            Stage::Correct => pass.correct(item),
        }
    }
}
