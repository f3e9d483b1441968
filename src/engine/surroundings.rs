//! What surrounds a particle: `model/surroundings.rs` for one stream, on the nodes that exist.
//!
//! Each layer is a stage, its items are blocks of nodes. Two rooms a level are enough: a layer reads
//! from one and writes to the other.

use std::collections::BTreeMap;

use pulp::Simd;

use super::{
    crew::Parts,
    linear::{Linear, load, store},
    products::{Gathered, Output, Rows, Sink, pass},
};
use crate::{
    checkpoint::{Surroundings, Weights, layout},
    kernels::{
        math::{exp, relu},
        nodes::{Level, MISSING, Nodes, Row, range},
        transfer::sum_row,
    },
    model::{
        Ballistic,
        surroundings::{FULL, LEAST_MASS},
    },
};

/// Nodes of a block: a multiple of the rows that are computed at once.
const BLOCK: usize = 24;

/// Lists of numbers at nodes.
const FIELDS: usize = 7;
/// What particles write: averages, how full a node is, and how near the four walls are.
const WRITTEN: usize = 0;
/// What particles read.
pub(super) const READ: usize = 2;

/// The level of each list.
const LEVEL: [usize; FIELDS] = [0, 0, 0, 1, 1, 2, 2];

/// What a layer gathers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Reach {
    /// The 3 x 3 around a node.
    Around,
    /// A node's children.
    Down,
    /// A node's parent, added to what this list holds for the node.
    Up(usize),
}

/// Each layer's reach, and the lists it reads and writes, in the order of
/// [`layout::grid_layers`].
const LAYERS: [(Reach, usize, usize); 11] = [
    (Reach::Around, WRITTEN, 1),
    (Reach::Around, 1, 2),
    (Reach::Down, 2, 3),
    (Reach::Around, 3, 4),
    (Reach::Down, 4, 5),
    (Reach::Around, 5, 6),
    (Reach::Around, 6, 5),
    (Reach::Up(4), 5, 3),
    (Reach::Around, 3, 4),
    (Reach::Up(2), 4, 1),
    (Reach::Around, 1, READ),
];

/// Stages of the layers.
pub(super) const STAGES: usize = LAYERS.len();

/// The packed layers.
#[derive(Debug)]
pub(super) struct Grid {
    /// One matrix a layer, or one for each child.
    layers: Vec<Vec<Linear>>,
    widths: [usize; FIELDS],
    pub(super) cell_width: f32,
    /// C0.
    pub(super) channels: usize,
}

/// The nodes of a frame, and what layers hand on.
#[derive(Debug, Default)]
pub(super) struct Room {
    pub(super) nodes: Nodes,
    /// `[nodes + 1, its width]` each, the last row zero.
    pub(super) fields: [Vec<f32>; FIELDS],
}

/// Its lists, for all threads.
pub(super) type Fields<'a> = [Parts<'a, f32>; FIELDS];

impl Grid {
    pub(super) fn pack(
        lanes: usize,
        surroundings: &Surroundings,
        tensors: &BTreeMap<String, Weights>,
    ) -> Self {
        let [c0, c1, c2] = surroundings.channels;
        let pack = |(layer, ..): (&str, usize, usize, usize), reach| {
            let [weight, bias] = layout::names(layer).map(|name| &tensors[&name]);
            match reach {
                Reach::Around | Reach::Down => vec![Linear::pack(lanes, weight, bias, 0, 1)],
                // The children share the bias.
                Reach::Up(_) => {
                    let [outputs, inputs] = [bias.values.len(), weight.shape[1]];
                    let children = weight.values.chunks_exact(outputs * inputs);
                    let child = |values: &[f32]| Weights {
                        shape: vec![outputs, inputs],
                        values: values.to_vec(),
                    };
                    children.map(|own| Linear::pack(lanes, &child(own), bias, 0, 1)).collect()
                }
            }
        };
        let layers = layout::grid_layers(surroundings).into_iter().zip(LAYERS);
        Self {
            layers: layers.map(|(layer, (reach, ..))| pack(layer, reach)).collect(),
            widths: [c0 + layout::NODE_FEATURES, c0, c0, c1, c1, c2, c2],
            cell_width: surroundings.cell_width,
            channels: c0,
        }
    }

    /// Makes room for what is at the nodes, and for what may be as long as the nodes themselves need no
    /// more.
    pub(super) fn make_room(&self, room: &mut Room) {
        for (list, numbers) in room.fields.iter_mut().enumerate() {
            let (level, width) = (room.nodes.level(LEVEL[list]), self.widths[list]);
            let length = level.len() * width;
            numbers.truncate(length);
            numbers.reserve((level.capacity() + 1) * width - numbers.len());
            numbers.resize(length, 0.0);
            numbers.resize(length + width, 0.0);
        }
    }

    /// Items of a layer's stage.
    pub(super) fn items(&self, layer: usize, nodes: &Nodes) -> usize {
        let (reach, _, to) = LAYERS[layer];
        let rows = match reach {
            Reach::Around | Reach::Down => nodes.level(LEVEL[to]),
            Reach::Up(_) => nodes.level(LEVEL[to] + 1),
        };
        rows.len().div_ceil(BLOCK)
    }

    /// What particles write to a row of nodes, from what they are encoded as, `[slot, C0]`.
    #[inline(always)]
    pub(super) fn write<S: Simd>(
        &self,
        simd: S,
        nodes: &Nodes,
        row: &Row,
        encoded: &[f32],
        walls: &Walls,
        fields: &Fields,
    ) {
        let width = self.widths[WRITTEN];
        let own = range(row.nodes);
        // SAFETY: these nodes are those of this item alone.
        let written = unsafe { fields[WRITTEN].part(own.start * width..own.end * width) };
        written.fill(0.0);
        sum_row(
            simd,
            nodes,
            row,
            encoded,
            self.channels,
            #[inline(always)]
            |slot| slot,
            written,
            width,
        );
        add_mass(nodes, row, written, self.channels, width);
        for (written, at) in written.chunks_exact_mut(width).zip(&nodes.level(0).at[own]) {
            let (averages, rest) = written.split_at_mut(self.channels);
            let scale = simd.splat_f32s(1.0 / (rest[0] + LEAST_MASS));
            for part in averages.chunks_mut(S::F32_LANES) {
                let average = simd.mul_f32s(load(simd, part), scale);
                store(simd, part, average);
            }
            rest[0] /= FULL;
            walls.distances(at, &mut rest[1..]);
            for part in rest[1..].chunks_mut(S::F32_LANES) {
                let nearness = exp(simd, simd.partial_load_f32s(part));
                store(simd, part, nearness);
            }
        }
    }

    /// A block of nodes through a layer.
    #[inline(always)]
    pub(super) fn layer<S: Simd>(
        &self,
        simd: S,
        layer: usize,
        item: usize,
        nodes: &Nodes,
        fields: &Fields,
    ) {
        let (reach, from, to) = LAYERS[layer];
        let linears = &self.layers[layer];
        let (width, level) = (self.widths[to], nodes.level(LEVEL[to]));
        // SAFETY: no item of this stage writes to this list.
        let numbers = unsafe { fields[from].read(0..fields[from].len()) };
        let rows = Rows { numbers, width: self.widths[from] };
        let zero = nodes.level(LEVEL[from]).len();
        let begin = item * BLOCK;
        let block = |all: &Level| begin..(begin + BLOCK).min(all.len());
        match reach {
            Reach::Around => {
                let block = block(level);
                let source = Gathered { table: &level.neighbours[block.clone()], rows, zero };
                // SAFETY: these nodes are those of this item alone.
                let numbers = unsafe { fields[to].part(block.start * width..block.end * width) };
                // The last layer alone has no ReLU.
                let mut sink = Output { numbers, width, rectify: layer + 1 < STAGES };
                pass(simd, &linears[0], block.len(), &source, &mut sink);
            }
            Reach::Down => {
                let block = block(level);
                let source = Gathered { table: &level.children[block.clone()], rows, zero };
                // SAFETY: as above.
                let numbers = unsafe { fields[to].part(block.start * width..block.end * width) };
                let mut sink = Output { numbers, width, rectify: true };
                pass(simd, &linears[0], block.len(), &source, &mut sink);
            }
            Reach::Up(held) => {
                let parents = nodes.level(LEVEL[to] + 1);
                let block = block(parents);
                let own = &numbers[block.start * rows.width..block.end * rows.width];
                for (child, linear) in linears.iter().enumerate() {
                    let children = &parents.children[block.clone()];
                    let mut sink =
                        Children { children, child, held: fields[held], to: fields[to], width };
                    let source = Rows { numbers: own, width: rows.width };
                    pass(simd, linear, block.len(), &source, &mut sink);
                }
            }
        }
    }
}

/// One child of each parent of a block: added to what it holds, after ReLU.
struct Children<'a> {
    children: &'a [[u32; 4]],
    child: usize,
    held: Parts<'a, f32>,
    to: Parts<'a, f32>,
    width: usize,
}

impl Sink for Children<'_> {
    #[inline(always)]
    fn put<S: Simd>(
        &mut self,
        simd: S,
        row: usize,
        outputs: std::ops::Range<usize>,
        sums: S::f32s,
    ) {
        let node = self.children[row][self.child];
        if node == MISSING {
            return;
        }
        let first = node as usize * self.width;
        let place = first + outputs.start..first + outputs.end;
        // SAFETY: a node has one parent, which is in the block of this item alone; nobody writes what is
        // held.
        let (held, to) = unsafe { (self.held.read(place.clone()), self.to.part(place)) };
        let sums = simd.add_f32s(load(simd, held), sums);
        store(simd, to, relu(simd, sums));
    }
}

/// Adds the mass of a row's nodes to number `column` of their rows, `width` apart.
#[inline(always)]
fn add_mass(nodes: &Nodes, row: &Row, written: &mut [f32], column: usize, width: usize) {
    for (number, &cells) in row.cells.iter().enumerate() {
        for cell in &nodes.cells()[range(cells)] {
            let first = (cell.nodes[number] - row.nodes[0]) as usize;
            let mut mass = [0.0; 3];
            for node in 0..3 {
                mass[node] = written[(first + node) * width + column];
            }
            for [columns, rows] in &nodes.weights()[cell.slots()] {
                for node in 0..3 {
                    mass[node] += columns[node] * rows[number];
                }
            }
            for node in 0..3 {
                written[(first + node) * width + column] = mass[node];
            }
        }
    }
}

/// The walls in effect, as nodes see them.
pub(super) struct Walls {
    pub(super) ballistic: Ballistic,
    /// Lower corner of the domain (domain lengths).
    pub(super) origin: [f32; 2],
    /// Of level 0 (domain lengths).
    pub(super) cell_width: f32,
}

impl Walls {
    /// A node's distances from the left, lower, right and upper wall (cells), negative.
    #[inline(always)]
    fn distances(&self, at: &[i32; 2], distances: &mut [f32]) {
        for axis in 0..2 {
            let place = self.origin[axis] + at[axis] as f32 * self.cell_width;
            let below = (place - self.ballistic.lower[axis]).max(0.0);
            let above = (self.ballistic.upper[axis] - place).max(0.0);
            distances[axis] = -below / self.cell_width;
            distances[2 + axis] = -above / self.cell_width;
        }
    }
}
