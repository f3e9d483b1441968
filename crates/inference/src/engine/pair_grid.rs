//! The layers on nodes in bfloat16 ([`Grid`](super::grid::Grid) has them in single precision).
//!
//! A layer reads the rounded outputs of the one before, and writes its own both rounded and in single precision, which skip
//! connections and particles read.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use pulp::{Simd as _, f32x16};

use super::{
    bf16::{Bf16, LANES, PairLinear, PairRows, PairSink},
    grid::{Block, Fields, by_child},
    linear::{load, store},
};
use crate::{
    checkpoint::{
        Weights,
        grid::{GridLayer, Stencil},
    },
    kernels::{math::relu, nodes::MISSING},
};
use eddy_threads::DisjointSlice;

/// Pairs in as many numbers as a vector has.
const PAIRS: usize = LANES / 2;

/// The packed layers.
#[derive(Debug)]
pub(super) struct PairGrid {
    simd: Bf16,
    layers: Vec<Layer>,
}

#[derive(Debug)]
enum Layer {
    Neighbours(PairLinear<9>),
    Children(PairLinear<4>),
    /// One matrix per child.
    Parent(Box<[PairLinear<1>; 4]>),
}

impl PairGrid {
    /// Packs layers and their weights and biases; `None` if the processor, or an instruction set with vectors of so many lanes, lacks
    /// products of pairs.
    pub(super) fn pack<'a>(
        lanes: usize,
        layers: impl Iterator<Item = (&'a GridLayer, [&'a Weights; 2])>,
    ) -> Option<Self> {
        let pack = |(layer, [weight, bias]): (&GridLayer, [&Weights; 2])| match layer.stencil {
            Stencil::Neighbours => Layer::Neighbours(PairLinear::pack(weight, bias)),
            Stencil::Children => Layer::Children(PairLinear::pack(weight, bias)),
            Stencil::Parent => {
                let linears = by_child(weight, bias).map(|own| PairLinear::pack(&own, bias));
                Layer::Parent(Box::new(linears))
            }
        };
        let simd = Bf16::new().filter(|_| lanes == LANES);
        simd.map(|simd| Self { simd, layers: layers.map(pack).collect() })
    }

    /// Rounds rows.
    #[inline(always)]
    pub(super) fn round(&self, rows: &[f32], pairs: &mut [u32]) {
        self.simd.round_all(rows.as_chunks().0, pairs.as_chunks_mut().0);
    }

    /// A layer on a block of nodes.
    #[inline(always)]
    pub(super) fn layer(&self, number: usize, block: Block<'_>, fields: &Fields<'_>) {
        let Block { plan, level, nodes, source_width, zero, width, skip } = block;
        let [from, to] = plan.lists;
        // SAFETY: this stage does not write to this list.
        let pairs = unsafe { fields.pairs[from].read(0..fields.pairs[from].len()) };
        let rows = PairRows { pairs, width: source_width / 2, zero };
        let own_rows = || {
            let numbers = nodes.start * width..nodes.end * width;
            let pairs = numbers.start / 2..numbers.end / 2;
            // SAFETY: only this item uses these nodes.
            let (numbers, pairs) =
                unsafe { (fields.numbers[to].part(numbers), fields.pairs[to].part(pairs)) };
            Output { numbers, pairs, width, rectify: plan.rectified }
        };
        match &self.layers[number] {
            Layer::Neighbours(linear) => {
                self.gather(linear, rows, &level.neighbours[nodes.clone()], own_rows());
            }
            Layer::Children(linear) => {
                self.gather(linear, rows, &level.children[nodes.clone()], own_rows());
            }
            Layer::Parent(linears) => {
                let children = &level.children[nodes.clone()];
                let skip =
                    fields.numbers[skip.expect("layers that read parents have a skip connection")];
                for (child, linear) in linears.iter().enumerate() {
                    let (to, pairs) = (fields.numbers[to], fields.pairs[to]);
                    let mut sink = Children { children, child, skip, to, pairs, width };
                    let index = |row: usize, _: usize| nodes.start + row;
                    self.simd.apply(linear, rows, nodes.len(), index, &mut sink);
                }
            }
        }
    }

    /// A layer of rows that a table selects.
    #[inline(always)]
    fn gather<const K: usize>(
        &self,
        linear: &PairLinear<K>,
        rows: PairRows<'_>,
        table: &[[u32; K]],
        mut sink: Output<'_>,
    ) {
        let index = |row: usize, place: usize| table[row][place] as usize;
        self.simd.apply(linear, rows, table.len(), index, &mut sink);
    }
}

/// Contiguous rows, with ReLU if `rectify`.
struct Output<'a> {
    /// `[.., width]`.
    numbers: &'a mut [f32],
    pairs: &'a mut [u32],
    width: usize,
    rectify: bool,
}

impl PairSink for Output<'_> {
    #[inline(always)]
    fn put(&mut self, simd: Bf16, row: usize, first: usize, outputs: f32x16) {
        let wide = simd.without_pairs();
        let outputs = if self.rectify { relu(wide, outputs) } else { outputs };
        let place = row * self.width + first;
        store(wide, &mut self.numbers[place..place + LANES], outputs);
        simd.round(outputs, &mut self.pairs.as_chunks_mut().0[place / LANES]);
    }
}

/// Writes to one child of each parent of a block: ReLU of the sum with the skip connection.
struct Children<'a> {
    children: &'a [[u32; 4]],
    child: usize,
    skip: DisjointSlice<'a, f32>,
    to: DisjointSlice<'a, f32>,
    pairs: DisjointSlice<'a, u32>,
    width: usize,
}

impl PairSink for Children<'_> {
    #[inline(always)]
    fn put(&mut self, simd: Bf16, row: usize, first: usize, outputs: f32x16) {
        let node = self.children[row][self.child];
        if node == MISSING {
            return;
        }
        let wide = simd.without_pairs();
        let place = node as usize * self.width + first;
        let (numbers, pairs) = (place..place + LANES, place / 2..place / 2 + PAIRS);
        // SAFETY: a node has one parent, which is in this item's block only; this stage does not write to `skip`.
        let (skip, to, pairs) = unsafe {
            (self.skip.read(numbers.clone()), self.to.part(numbers), self.pairs.part(pairs))
        };
        let outputs = relu(wide, wide.add_f32s(load(wide, skip), outputs));
        store(wide, to, outputs);
        simd.round(outputs, &mut pairs.as_chunks_mut().0[0]);
    }
}
