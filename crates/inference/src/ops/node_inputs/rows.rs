//! The inputs of the nodes of a frame of a stream, a row of nodes at a time.

use pulp::{Arch, Simd, WithSimd};

use super::Ballistic;
use crate::{
    checkpoint::layout::NODE_FEATURES,
    engine::scales::{FULL_MASS, MIN_MASS},
    kernels::{
        activation::Exponentials,
        nodes::{Nodes, Row, range},
    },
    ops::transfer::segments::Segments,
};
use eddy_frames::Domain;

/// Proximity of nodes to the effective walls.
pub(crate) struct Walls<'a> {
    pub(crate) ballistic: Ballistic,
    /// Lower corner of the domain (domain lengths).
    origin: [f32; 2],
    /// Of the finest level (domain lengths).
    pub(crate) cell_width: f32,
    /// Proximity to the left and right wall of each column of nodes from [`FIRST_COLUMN`] on.
    columns: &'a [[f32; 2]],
}

/// A column left of all nodes.
const FIRST_COLUMN: i32 = -2;

impl<'a> Walls<'a> {
    /// Fills `columns` for a domain.
    pub(crate) fn new(
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

    /// The inputs of a row of nodes, `[node, stride]`, from the sums of the segments. Behind the sums of `channels` is that of the weights.
    #[inline(always)]
    pub(crate) fn write<S: Simd>(
        &self,
        simd: S,
        nodes: &Nodes,
        row: &Row,
        (segments, sums): (&Segments, &[f32]),
        channels: usize,
        (written, stride): (&mut [f32], usize),
    ) {
        written.fill(0.0);
        segments.join(simd, nodes, row, sums, stride, written);
        let at = &nodes.level(0).at[range(row.nodes)];
        let [_, lower, _, upper] = self.negative_distances(at.first().copied().unwrap_or([0; 2]));
        let mut vertical = [lower, upper];
        Exponentials(&mut vertical).with_simd(simd);
        for (written, &[column, _]) in written.chunks_exact_mut(stride).zip(at) {
            let mass = written[channels];
            let scale = simd.splat_f32s(1.0 / (mass + MIN_MASS));
            for part in S::as_mut_simd_f32s(written).0 {
                *part = simd.mul_f32s(*part, scale);
            }
            let [left, right] = self.columns[(column - FIRST_COLUMN) as usize];
            let features = [mass / FULL_MASS, left, vertical[0], right, vertical[1]];
            written[channels + 1..][..NODE_FEATURES].copy_from_slice(&features);
        }
    }
}
