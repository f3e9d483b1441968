//! The sparse grid that connects a particle with its surroundings.
//!
//! Each layer is a stage whose items are blocks of nodes. It reads one list of features and writes another.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use std::{collections::BTreeMap, ops::Range};

use pulp::{Arch, Simd, WithSimd};

use super::{
    Ballistic,
    merged::MERGED_NODE_FEATURES,
    scales::{FULL_MASS, MIN_MASS},
    scatter::Segments,
};
use crate::{
    checkpoint::{
        GridOptions, Weights,
        grid::{GridLayer, MAX_LISTS, READ, Stencil, WRITTEN, grid_layers, grid_lists},
        layout,
    },
    kernels::{
        activation::Exponentials,
        math::relu,
        nodes::{Level, MISSING, Nodes, Row, range},
    },
    ops::linear::{
        packed::{SplitLinear, load, store},
        rows::{Gathered, Output, Rows, Sink, Source, apply},
    },
};
use eddy_frames::Domain;
use eddy_threads::DisjointSlice;

/// Nodes per block: a multiple of the rows that are computed at once.
const BLOCK: usize = 24;

/// A packed layer.
#[derive(Debug)]
struct Layer {
    plan: GridLayer,
    /// The list that is added, of a layer that reads parents.
    skip: Option<usize>,
    /// One matrix, or one per child.
    linears: Vec<SplitLinear>,
}

/// The packed layers.
#[derive(Debug)]
pub(super) struct Grid {
    layers: Vec<Layer>,
    /// Level of each list, and length of its rows, padded to whole panels of the layers that write it.
    lists: Vec<(usize, usize)>,
    pub(super) cell_width: f32,
    /// Number of levels.
    pub(super) levels: usize,
    /// E.
    encoded: usize,
}

/// The nodes of a frame, and the buffers between layers.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    pub(super) nodes: Nodes,
    /// The lists, `[nodes + 1, its stride]`; the last row is zero.
    pub(super) fields: [Vec<f32>; MAX_LISTS],
    /// Proximity to the left and right wall of each column of nodes from [`FIRST_COLUMN`] on.
    pub(super) columns: Vec<[f32; 2]>,
}

/// The lists of [`Scratch`], shared between threads.
pub(super) type Fields<'a> = [DisjointSlice<'a, f32>; MAX_LISTS];

impl Grid {
    /// Packs the layers of a grid from the tensors of [`merged`](super::merged).
    pub(super) fn pack(
        lanes: usize,
        grid: &GridOptions,
        tensors: &BTreeMap<String, Weights>,
    ) -> Self {
        let tensors = |layer: &GridLayer| layout::names(&layer.name).map(|name| &tensors[&name]);
        let plans = grid_layers(grid);
        let linears = |layer: &GridLayer| {
            let [weight, bias] = tensors(layer);
            match layer.stencil {
                Stencil::Neighbours | Stencil::Children => {
                    vec![SplitLinear::pack(lanes, weight, bias)]
                }
                Stencil::Parent => {
                    by_child(weight, bias).map(|own| SplitLinear::pack(lanes, &own, bias)).into()
                }
            }
        };
        let pack = |layer: &GridLayer| Layer {
            plan: layer.clone(),
            skip: layer.skip.map(|layer| plans[layer].lists[1]),
            linears: linears(layer),
        };
        let layers = plans.iter().map(pack).collect();
        // Both lists of a level are as wide as its widest layer.
        let mut widest = vec![0; grid.channels.len()];
        for plan in &plans {
            let [_, bias] = tensors(plan);
            let stride = bias.values.len().next_multiple_of(lanes);
            widest[plan.level] = stride.max(widest[plan.level]);
        }
        let mut lists: Vec<_> =
            grid_lists(grid).into_iter().map(|(level, _)| (level, widest[level])).collect();
        let [weight, _] = tensors(&plans[0]);
        let inputs = weight.shape[1] / Stencil::Neighbours.places();
        lists[WRITTEN].1 = inputs.next_multiple_of(lanes);
        Self {
            layers,
            lists,
            cell_width: grid.cell_width,
            levels: grid.channels.len(),
            encoded: inputs - MERGED_NODE_FEATURES,
        }
    }

    /// Length of the rows of a list.
    fn stride(&self, list: usize) -> usize {
        self.lists[list].1
    }

    /// Length of the rows that particles are summed in.
    pub(super) fn written_width(&self) -> usize {
        self.stride(WRITTEN)
    }

    /// Length of the rows that particles gather.
    pub(super) fn read_width(&self) -> usize {
        self.stride(READ)
    }

    /// Resizes the lists to the nodes.
    pub(super) fn resize(&self, scratch: &mut Scratch) {
        let Scratch { nodes, fields, .. } = scratch;
        for (field, &(level, width)) in fields.iter_mut().zip(&self.lists) {
            resize(field, nodes.level(level), width);
        }
    }

    /// Number of items of a layer's stage.
    pub(super) fn items(&self, layer: usize, nodes: &Nodes) -> usize {
        nodes.level(self.layers[layer].plan.node_level()).len().div_ceil(BLOCK)
    }

    /// Computes the inputs of a row of nodes from the segments' sums.
    #[inline(always)]
    pub(super) fn write<S: Simd>(
        &self,
        simd: S,
        nodes: &Nodes,
        row: &Row,
        (segments, sums): (&Segments, &[f32]),
        walls: &Walls,
        fields: &Fields,
    ) {
        let (encoded, width) = (self.encoded, self.stride(WRITTEN));
        let own = range(row.nodes);
        // SAFETY: only this item uses these nodes.
        let written = unsafe { fields[WRITTEN].part(own.start * width..own.end * width) };
        written.fill(0.0);
        segments.join(simd, nodes, row, sums, width, written);
        let at = &nodes.level(0).at[own.clone()];
        let [_, lower, _, upper] = walls.negative_distances(at.first().copied().unwrap_or([0; 2]));
        let mut vertical = [lower, upper];
        Exponentials(&mut vertical).with_simd(simd);
        for (written, &[column, _]) in written.chunks_exact_mut(width).zip(at) {
            let mass = written[encoded];
            let scale = simd.splat_f32s(1.0 / (mass + MIN_MASS));
            for part in S::as_mut_simd_f32s(written).0 {
                *part = simd.mul_f32s(*part, scale);
            }
            let [left, right] = walls.columns[(column - FIRST_COLUMN) as usize];
            let features = [mass / FULL_MASS, left, vertical[0], right, vertical[1]];
            written[encoded + 1..encoded + MERGED_NODE_FEATURES].copy_from_slice(&features);
        }
    }

    /// A layer on a block of nodes.
    #[inline(always)]
    pub(super) fn layer<S: Simd>(
        &self,
        simd: S,
        number: usize,
        item: usize,
        nodes: &Nodes,
        fields: &Fields,
    ) {
        let Layer { plan, skip, linears } = &self.layers[number];
        let ([from, to], skip) = (plan.lists, *skip);
        let (width, level) = (self.stride(to), nodes.level(plan.node_level()));
        let (source_level, source_width) = self.lists[from];
        let zero = nodes.level(source_level).len();
        let own = item * BLOCK..((item + 1) * BLOCK).min(level.len());
        // SAFETY: this stage does not write to this list.
        let numbers = unsafe { fields[from].read(0..fields[from].len()) };
        let rows = Rows { numbers, width: source_width };
        match plan.stencil {
            Stencil::Neighbours => {
                let source = Gathered { table: &level.neighbours[own.clone()], rows, zero };
                self.gather(simd, number, own, &source, &fields[to]);
            }
            Stencil::Children => {
                let source = Gathered { table: &level.children[own.clone()], rows, zero };
                self.gather(simd, number, own, &source, &fields[to]);
            }
            Stencil::Parent => {
                let numbers = &numbers[own.start * rows.width..own.end * rows.width];
                let children = &level.children[own.clone()];
                let skip = fields[skip.expect("layers that read parents have a skip connection")];
                for (child, linear) in linears.iter().enumerate() {
                    let mut sink = Children { children, child, skip, to: fields[to], width };
                    let source = Rows { numbers, width: rows.width };
                    apply(simd, linear, own.len(), &source, &mut sink);
                }
            }
        }
    }

    /// A convolution for a range of nodes.
    #[inline(always)]
    fn gather<S: Simd>(
        &self,
        simd: S,
        number: usize,
        nodes: Range<usize>,
        source: &impl Source,
        field: &DisjointSlice<'_, f32>,
    ) {
        let Layer { plan, linears, .. } = &self.layers[number];
        let width = self.stride(plan.lists[1]);
        // SAFETY: only this item uses these nodes.
        let numbers = unsafe { field.part(nodes.start * width..nodes.end * width) };
        let mut sink = Output { numbers, width, rectify: plan.rectified };
        apply(simd, &linears[0], nodes.len(), source, &mut sink);
    }
}

/// The matrix of each child, of a layer that reads parents; all share the bias.
fn by_child(weight: &Weights, bias: &Weights) -> [Weights; 4] {
    let shape = [bias.values.len(), weight.shape[1]];
    let length = shape[0] * shape[1];
    [0, 1, 2, 3].map(|child| Weights {
        shape: shape.into(),
        values: weight.values[child * length..(child + 1) * length].to_vec(),
    })
}

/// Resizes a list to the nodes of a level, with a row of zeros behind them, and reserves as much as they can grow without allocating.
fn resize(list: &mut Vec<f32>, level: &Level, width: usize) {
    let length = level.len() * width;
    list.truncate(length);
    list.reserve((level.capacity() + 1) * width - list.len());
    list.resize(length, 0.0);
    list.resize(length + width, 0.0);
}

/// Writes to one child of each parent of a block: ReLU of the sum with the skip connection.
struct Children<'a> {
    children: &'a [[u32; 4]],
    child: usize,
    skip: DisjointSlice<'a, f32>,
    to: DisjointSlice<'a, f32>,
    width: usize,
}

impl Sink for Children<'_> {
    #[inline(always)]
    fn put<S: Simd>(&mut self, simd: S, row: usize, outputs: Range<usize>, sums: S::f32s) {
        let node = self.children[row][self.child];
        if node == MISSING {
            return;
        }
        let first = node as usize * self.width;
        let place = first + outputs.start..first + outputs.end;
        // SAFETY: a node has one parent, which is in this item's block only; this stage does not write to `skip`.
        let (skip, to) = unsafe { (self.skip.read(place.clone()), self.to.part(place)) };
        let sums = simd.add_f32s(load(simd, skip), sums);
        store(simd, to, relu(simd, sums));
    }
}

/// Proximity of nodes to the effective walls.
pub(super) struct Walls<'a> {
    pub(super) ballistic: Ballistic,
    /// Lower corner of the domain (domain lengths).
    origin: [f32; 2],
    /// Of the finest level (domain lengths).
    pub(super) cell_width: f32,
    columns: &'a [[f32; 2]],
}

/// A column left of all nodes.
const FIRST_COLUMN: i32 = -2;

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
        columns.extend((FIRST_COLUMN..FIRST_COLUMN + count).map(|column| {
            let [left, _, right, _] = walls.negative_distances([column, 0]);
            [left, right]
        }));
        arch.dispatch(Exponentials(columns.as_flattened_mut()));
        walls.columns = columns;
        walls
    }

    /// The negative distances of a node from the left, lower, right and upper wall (cells).
    #[inline(always)]
    fn negative_distances(&self, at: [i32; 2]) -> [f32; 4] {
        let mut distances = [0.0; 4];
        for axis in 0..2 {
            let place = self.origin[axis] + at[axis] as f32 * self.cell_width;
            let below = (place - self.ballistic.lower[axis]).max(0.0);
            let above = (self.ballistic.upper[axis] - place).max(0.0);
            distances[axis] = -below / self.cell_width;
            distances[2 + axis] = -above / self.cell_width;
        }
        distances
    }
}
