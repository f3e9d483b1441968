//! Particle-to-grid sums (P2G) by blocks of particles, each into sums of its own, which are added up later.
//!
//! The list of slots is cut at the ends of blocks and of rows of cells. Between two cuts lies a segment: its cells are
//! consecutive, and so are the nodes of each row of their stencils. Neither the cuts nor the order in which a node's sums
//! are added up depend on the number of threads.

use std::ops::Range;

use pulp::Simd;

use crate::{
    kernels::nodes::{Cell, Nodes, Row, range},
    ops::linear::packed::{load, store},
};

/// A part of the list of slots.
#[derive(Clone, Copy, Debug)]
struct Segment {
    /// Its slots, first and end.
    slots: [u32; 2],
    /// The cells of these slots, first and end; the outer two may have further slots.
    cells: [u32; 2],
    /// Begin of the sums of each row of the stencil, and end of the last (nodes).
    sums: [u32; 4],
}

/// The segments of a frame.
#[derive(Debug, Default)]
pub(crate) struct Segments {
    segments: Vec<Segment>,
    /// First segment of each block, and the end of the last.
    first: Vec<u32>,
}

impl Segments {
    /// Cuts the list of slots every `block` slots and at the end of each row of cells. Returns the length of all sums (nodes),
    /// and the largest it can get without allocating nodes.
    pub(crate) fn cut(&mut self, nodes: &Nodes, block: usize) -> [usize; 2] {
        let Self { segments, first } = self;
        let (particles, cells) = (nodes.order().len(), nodes.cells());
        segments.clear();
        first.clear();
        first.reserve(particles.div_ceil(block) + 1);
        // Each row of cells is the lowest row of its cells' stencils.
        let most = particles.min(nodes.max_rows() + particles.div_ceil(block));
        segments.reserve(most);
        let mut sum = 0;
        for row in nodes.rows() {
            let mut cells_left = range(row.cells[0]);
            while !cells_left.is_empty() {
                let begin = match segments.last() {
                    Some(segment) => segment.slots[1] as usize,
                    None => 0,
                };
                let end = (begin + 1).next_multiple_of(block);
                if begin.is_multiple_of(block) {
                    first.push(segments.len() as u32);
                }
                // The cells that begin before the block's end.
                let own = &cells[cells_left.clone()];
                let count = own.partition_point(|cell| cell.slots().start < end);
                let last = &own[count - 1];
                let end = end.min(last.slots().end);
                let starts = own[0].nodes;
                let mut sums = [sum; 4];
                for number in 0..3 {
                    sum += last.nodes[number] + 3 - starts[number];
                    sums[number + 1] = sum;
                }
                let here = cells_left.start;
                segments.push(Segment {
                    slots: [begin as u32, end as u32],
                    cells: [here as u32, (here + count) as u32],
                    sums,
                });
                // A cell that continues behind the cut belongs to both segments.
                let whole = if end < last.slots().end { count - 1 } else { count };
                cells_left.start += whole;
            }
        }
        first.push(segments.len() as u32);
        // Two segments of a row share at most the three nodes of a cell.
        [sum as usize, 3 * nodes.level(0).capacity() + 9 * most]
    }

    fn of_block(&self, block: usize) -> &[Segment] {
        &self.segments[range([self.first[block], self.first[block + 1]])]
    }

    /// The range of a block's sums (nodes).
    pub(crate) fn sums(&self, block: usize) -> Range<usize> {
        match self.of_block(block) {
            [first, .., last] => first.sums[0] as usize..last.sums[3] as usize,
            [only] => only.sums[0] as usize..only.sums[3] as usize,
            [] => 0..0,
        }
    }

    /// P2G for a block: sums `rows`, `[slot of the block, stride]`, on the nodes of each particle's stencil, into the block's
    /// own `sums`.
    #[inline(always)]
    pub(crate) fn add<S: Simd>(
        &self,
        simd: S,
        nodes: &Nodes,
        block: usize,
        rows: &[f32],
        stride: usize,
        sums: &mut [f32],
    ) {
        sums.fill(0.0);
        let segments = self.of_block(block);
        let Some(begin) = segments.first() else { return };
        for segment in segments {
            let cells = &nodes.cells()[range(segment.cells)];
            let starts = cells[0].nodes;
            for cell in cells {
                let own = cell.slots().start.max(segment.slots[0] as usize)
                    ..cell.slots().end.min(segment.slots[1] as usize);
                let weights = &nodes.weights()[own.clone()];
                let from = own.start - begin.slots[0] as usize;
                let rows = &rows[from * stride..(from + own.len()) * stride];
                let places = [0, 1, 2].map(|number| {
                    let node =
                        segment.sums[number] - begin.sums[0] + cell.nodes[number] - starts[number];
                    node as usize * stride
                });
                let mut part = 0;
                while part < stride {
                    // Two vectors at once if there are enough registers.
                    if const { S::REGISTER_COUNT >= 32 } && part + 2 * S::F32_LANES <= stride {
                        add_cell::<S, 2>(simd, weights, rows, stride, part, places, sums);
                        part += 2 * S::F32_LANES;
                    } else {
                        add_cell::<S, 1>(simd, weights, rows, stride, part, places, sums);
                        part += S::F32_LANES;
                    }
                }
            }
        }
    }

    /// Adds the segments' `sums` of a row of nodes to `joined`, `[node, stride]`.
    #[inline(always)]
    pub(crate) fn join<S: Simd>(
        &self,
        simd: S,
        nodes: &Nodes,
        row: &Row,
        sums: &[f32],
        stride: usize,
        joined: &mut [f32],
    ) {
        for (number, &cells) in row.cells.iter().enumerate() {
            let first = self.segments.partition_point(
                #[inline(always)]
                |segment| segment.cells[1] <= cells[0],
            );
            for segment in &self.segments[first..] {
                if segment.cells[0] >= cells[1] {
                    break;
                }
                let cell: &Cell = &nodes.cells()[segment.cells[0] as usize];
                let place = (cell.nodes[number] - row.nodes[0]) as usize * stride;
                let own = range([segment.sums[number], segment.sums[number + 1]]);
                let own = S::as_simd_f32s(&sums[own.start * stride..own.end * stride]).0;
                let joined = S::as_mut_simd_f32s(&mut joined[place..]).0;
                for (joined, own) in joined.iter_mut().zip(own) {
                    *joined = simd.add_f32s(*joined, *own);
                }
            }
        }
    }
}

/// Adds the contribution of particles of one cell, from their weights and `rows`: V vectors from column `part` on, to the
/// three nodes of each stencil row, whose sums begin at `places`.
#[inline(always)]
fn add_cell<S: Simd, const V: usize>(
    simd: S,
    weights: &[[[f32; 3]; 2]],
    rows: &[f32],
    stride: usize,
    part: usize,
    places: [usize; 3],
    sums: &mut [f32],
) {
    let place = |number: usize, node: usize, v: usize| {
        let begin = places[number] + node * stride + part + v * S::F32_LANES;
        begin..begin + S::F32_LANES
    };
    let mut sum = [[[simd.splat_f32s(0.0); V]; 3]; 3];
    for number in 0..3 {
        for node in 0..3 {
            for v in 0..V {
                sum[number][node][v] = load(simd, &sums[place(number, node, v)]);
            }
        }
    }
    for ([columns, lines], row) in weights.iter().zip(rows.chunks_exact(stride)) {
        let mut values = [simd.splat_f32s(0.0); V];
        for (v, values) in values.iter_mut().enumerate() {
            let begin = part + v * S::F32_LANES;
            *values = load(simd, &row[begin..begin + S::F32_LANES]);
        }
        for number in 0..3 {
            for node in 0..3 {
                let weight = simd.splat_f32s(columns[node] * lines[number]);
                for v in 0..V {
                    sum[number][node][v] =
                        simd.mul_add_e_f32s(weight, values[v], sum[number][node][v]);
                }
            }
        }
    }
    for number in 0..3 {
        for node in 0..3 {
            for v in 0..V {
                store(simd, &mut sums[place(number, node, v)], sum[number][node][v]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use pulp::{Arch, WithSimd};

    use super::*;
    use crate::{kernels::nodes::Window, ops::transfer::to_nodes};

    /// The sums on all nodes, from rows in the order of particles.
    struct Sum<'a>(&'a Nodes, usize, &'a [f32], usize);

    impl WithSimd for Sum<'_> {
        type Output = Vec<f32>;

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> Vec<f32> {
            let Self(nodes, block, rows, stride) = self;
            let mut segments = Segments::default();
            let [count, most] = segments.cut(nodes, block);
            assert!(count <= most, "{count} sums, room for {most}");
            // Previous contents must not matter.
            let mut sums = vec![7.0; count * stride];
            for (number, slots) in nodes.order().chunks(block).enumerate() {
                let row = |&particle: &u32| &rows[particle as usize * stride..][..stride];
                let rows: Vec<f32> = slots.iter().flat_map(row).copied().collect();
                let own = segments.sums(number);
                let own = &mut sums[own.start * stride..own.end * stride];
                segments.add(simd, nodes, number, &rows, stride, own);
            }
            let mut joined = vec![0.0; nodes.level(0).len() * stride];
            for row in nodes.rows() {
                let own = range(row.nodes);
                let own = &mut joined[own.start * stride..own.end * stride];
                segments.join(simd, nodes, row, &sums, stride, own);
            }
            joined
        }
    }

    proptest! {
        #[test]
        fn sums_of_segments_are_the_sums_over_all_particles(
            position in proptest::collection::vec([-0.1f32..1.1, 0f32..0.6], 0..300),
            block in 1usize..60,
            width in 1usize..4,
            scale in 0.05f32..1.0,
        ) {
            let stride = width * 16;
            let position: Vec<_> = position.iter().map(|x| x.map(|x| scale * x)).collect();
            let window = Window { particles: 0..position.len(), lower: [0.0; 2], upper: [1.0, 0.5] };
            let mut nodes = Nodes::default();
            nodes.rebuild(&position, &[window], 0.05, 3);
            let number = |n: usize| (n % 37) as f32 * 0.05 - 0.7;
            let rows: Vec<_> = (0..position.len() * stride).map(number).collect();
            let found = Arch::new().dispatch(Sum(&nodes, block, &rows, stride));
            let expected = to_nodes(&nodes, &rows, stride);
            prop_assert_eq!(found.len(), expected.len());
            for (found, expected) in found.iter().zip(&expected) {
                prop_assert!((found - expected).abs() <= 1e-4, "{} {}", found, expected);
            }
        }
    }
}
