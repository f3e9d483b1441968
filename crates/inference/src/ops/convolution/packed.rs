//! Convolutions of a frame of a stream, a block of nodes at a time.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use std::ops::Range;

use pulp::Simd;

use crate::{
    checkpoint::{
        Weights,
        grid::{GridLayer, MAX_LISTS, Stencil},
    },
    kernels::{
        math::relu,
        nodes::{MISSING, Nodes},
    },
    ops::linear::{
        packed::{SplitLinear, load, store},
        rows::{Gathered, Output, Rows, Sink, Source, apply},
    },
};
use eddy_threads::DisjointSlice;

/// Nodes per block: a multiple of the rows that are computed at once.
const BLOCK: usize = 24;

/// The lists of numbers at nodes, which threads share, and the length of their rows. Behind the last row of a list is one of zeros.
#[derive(Debug)]
pub(crate) struct Lists<'a> {
    pub(crate) numbers: [DisjointSlice<'a, f32>; MAX_LISTS],
    pub(crate) widths: &'a [usize],
}

/// A layer.
#[derive(Debug)]
pub(crate) struct Convolution {
    layer: GridLayer,
    /// The list that is added, of a layer that reads parents.
    added: Option<usize>,
    /// One matrix, or one per child.
    linears: Vec<SplitLinear>,
}

impl Convolution {
    /// Packs a weight, `[O, K I]` or `[4 O, I]`, and a bias. `layers` are all layers of the grid.
    pub(crate) fn pack(
        lanes: usize,
        layer: &GridLayer,
        layers: &[GridLayer],
        [weight, bias]: [&Weights; 2],
    ) -> Self {
        let linears = match layer.stencil {
            Stencil::Neighbours | Stencil::Children => {
                vec![SplitLinear::pack(lanes, weight, bias)]
            }
            Stencil::Parent => {
                by_child(weight, bias).map(|own| SplitLinear::pack(lanes, &own, bias)).into()
            }
        };
        let added = layer.skip.map(|layer| layers[layer].lists[1]);
        Self { layer: layer.clone(), added, linears }
    }

    /// Number of blocks.
    pub(crate) fn blocks(&self, nodes: &Nodes) -> usize {
        nodes.level(self.layer.node_level()).len().div_ceil(BLOCK)
    }

    /// Computes a block.
    #[inline(always)]
    pub(crate) fn run<S: Simd>(&self, simd: S, block: usize, nodes: &Nodes, lists: &Lists<'_>) {
        let [from, to] = self.layer.lists;
        let level = nodes.level(self.layer.node_level());
        let own = block * BLOCK..((block + 1) * BLOCK).min(level.len());
        // SAFETY: this stage does not write to this list.
        let numbers = unsafe { lists.numbers[from].read(0..lists.numbers[from].len()) };
        let rows = Rows { numbers, width: lists.widths[from] };
        let zero = numbers.len() / rows.width - 1;
        match self.layer.stencil {
            Stencil::Neighbours => {
                let source = Gathered { table: &level.neighbours[own.clone()], rows, zero };
                self.gather(simd, own, &source, lists);
            }
            Stencil::Children => {
                let source = Gathered { table: &level.children[own.clone()], rows, zero };
                self.gather(simd, own, &source, lists);
            }
            Stencil::Parent => {
                let numbers = &numbers[own.start * rows.width..own.end * rows.width];
                let children = &level.children[own.clone()];
                let added = self.added.expect("layers that read parents have a skip connection");
                let (added, written) = (lists.numbers[added], lists.numbers[to]);
                let (width, rectify) = (lists.widths[to], self.layer.rectified);
                for (child, linear) in self.linears.iter().enumerate() {
                    let mut sink = Children { children, child, added, to: written, width, rectify };
                    let source = Rows { numbers, width: rows.width };
                    apply(simd, linear, own.len(), &source, &mut sink);
                }
            }
        }
    }

    /// A range of nodes, whose rows are gathered.
    #[inline(always)]
    fn gather<S: Simd>(
        &self,
        simd: S,
        nodes: Range<usize>,
        source: &impl Source,
        lists: &Lists<'_>,
    ) {
        let [_, to] = self.layer.lists;
        let width = lists.widths[to];
        // SAFETY: only this block has these nodes.
        let numbers = unsafe { lists.numbers[to].part(nodes.start * width..nodes.end * width) };
        let mut sink = Output { numbers, width, rectify: self.layer.rectified };
        apply(simd, &self.linears[0], nodes.len(), source, &mut sink);
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

/// Writes to one child of each parent of a block: the sum with the list that is added, with ReLU if `rectify`.
struct Children<'a> {
    children: &'a [[u32; 4]],
    child: usize,
    added: DisjointSlice<'a, f32>,
    to: DisjointSlice<'a, f32>,
    width: usize,
    rectify: bool,
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
        // SAFETY: a node has one parent, which is in this block only; this stage does not write to `added`.
        let (added, to) = unsafe { (self.added.read(place.clone()), self.to.part(place)) };
        let sums = simd.add_f32s(load(simd, added), sums);
        store(simd, to, if self.rectify { relu(simd, sums) } else { sums });
    }
}
