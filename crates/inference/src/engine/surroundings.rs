//! What surrounds a particle: `model/surroundings.rs` for one stream, on the nodes that exist.
//!
//! Each layer is a stage, its items are blocks of nodes. Two rooms a level are enough: a layer reads
//! from one and writes to the other.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use std::collections::BTreeMap;

use pulp::{Arch, Simd, WithSimd};

use super::{
    Ballistic,
    crew::Parts,
    linear::{Linear, load, store},
    pieces::Pieces,
    products::{Gathered, Output, Rows, Sink, pass},
    scales::{FULL, LEAST_MASS},
};
use crate::{
    checkpoint::{Surroundings, Weights, layout},
    kernels::{
        activation::Exponentials,
        math::relu,
        nodes::{Level, MISSING, Nodes, Row, range},
    },
};
use eddy_frames::Domain;

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
    /// Length of the rows of each list: with a place for each lane of the layer that writes it.
    strides: [usize; FIELDS],
    pub(super) cell_width: f32,
    /// C0.
    channels: usize,
}

/// The nodes of a frame, and what layers hand on.
#[derive(Debug, Default)]
pub(super) struct Room {
    pub(super) nodes: Nodes,
    /// `[nodes + 1, its stride]` each, the last row zero.
    pub(super) fields: [Vec<f32>; FIELDS],
    /// How near the left and the right wall are, for each column of nodes from number [`FIRST`] on.
    pub(super) columns: Vec<[f32; 2]>,
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
        let widths = [c0 + layout::NODE_FEATURES, c0, c0, c1, c1, c2, c2];
        Self {
            layers: layers.map(|(layer, (reach, ..))| pack(layer, reach)).collect(),
            strides: widths.map(|width| width.next_multiple_of(lanes)),
            cell_width: surroundings.cell_width,
            channels: c0,
        }
    }

    /// Length of the rows that particles write to nodes.
    pub(super) fn written(&self) -> usize {
        self.strides[WRITTEN]
    }

    /// Length of the rows that particles read from nodes.
    pub(super) fn read(&self) -> usize {
        self.strides[READ]
    }

    /// Makes room for what is at the nodes, and for what may be as long as the nodes themselves need no
    /// more.
    pub(super) fn make_room(&self, room: &mut Room) {
        for (list, numbers) in room.fields.iter_mut().enumerate() {
            let (level, width) = (room.nodes.level(LEVEL[list]), self.strides[list]);
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

    /// What particles write to a row of nodes, from the sums over pieces of the particles.
    #[inline(always)]
    pub(super) fn write<S: Simd>(
        &self,
        simd: S,
        nodes: &Nodes,
        row: &Row,
        (pieces, sums): (&Pieces, &[f32]),
        walls: &Walls,
        fields: &Fields,
    ) {
        let (channels, width) = (self.channels, self.strides[WRITTEN]);
        let own = range(row.nodes);
        // SAFETY: these nodes are those of this item alone.
        let written = unsafe { fields[WRITTEN].part(own.start * width..own.end * width) };
        written.fill(0.0);
        pieces.join(simd, nodes, row, sums, width, written);
        let at = &nodes.level(0).at[own];
        let mut distances = [0.0; 4];
        walls.distances(at.first().unwrap_or(&[0; 2]), &mut distances);
        let mut beside = [distances[1], distances[3]];
        Exponentials(&mut beside).with_simd(simd);
        for (written, &[column, _]) in written.chunks_exact_mut(width).zip(at) {
            let mass = written[channels];
            let scale = simd.splat_f32s(1.0 / (mass + LEAST_MASS));
            for part in S::as_mut_simd_f32s(written).0 {
                *part = simd.mul_f32s(*part, scale);
            }
            let [left, right] = walls.columns[(column - FIRST) as usize];
            written[channels] = mass / FULL;
            written[channels + 1..channels + 5]
                .copy_from_slice(&[left, beside[0], right, beside[1]]);
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
        let (width, level) = (self.strides[to], nodes.level(LEVEL[to]));
        // SAFETY: no item of this stage writes to this list.
        let numbers = unsafe { fields[from].read(0..fields[from].len()) };
        let rows = Rows { numbers, width: self.strides[from] };
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

/// The walls in effect, as nodes see them.
pub(super) struct Walls<'a> {
    pub(super) ballistic: Ballistic,
    /// Lower corner of the domain (domain lengths).
    origin: [f32; 2],
    /// Of level 0 (domain lengths).
    pub(super) cell_width: f32,
    columns: &'a [[f32; 2]],
}

/// Number of a column left of all nodes.
const FIRST: i32 = -2;

impl<'a> Walls<'a> {
    pub(super) fn new(
        arch: Arch,
        ballistic: Ballistic,
        domain: &Domain,
        cell_width: f32,
        columns: &'a mut Vec<[f32; 2]>,
    ) -> Self {
        let origin = domain.lower;
        columns.clear();
        let count = ((domain.upper[0] - origin[0]) / cell_width).ceil() as i32 + 5;
        let mut walls = Self { ballistic, origin, cell_width, columns: &[] };
        columns.extend((FIRST..FIRST + count).map(|column| {
            let mut distances = [0.0; 4];
            walls.distances(&[column, 0], &mut distances);
            [distances[0], distances[2]]
        }));
        arch.dispatch(Exponentials(columns.as_flattened_mut()));
        walls.columns = columns;
        walls
    }

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
