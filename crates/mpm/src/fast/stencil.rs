//! Stencils of a pack, as [`spline`](super::super::spline).

use super::simd::{LANES, Simd};

/// Stencils of sixteen particles.
pub(super) struct Stencils<S: Simd> {
    /// Lowest node of each on x and y.
    pub(super) base: [[i32; LANES]; 2],
    /// The same.
    pub(super) lowest: [S::Lanes; 2],
    /// Distance from the lowest node on x and y (cells), in [0.5, 1.5).
    pub(super) offset: [S::Lanes; 2],
    /// Weights of the three rows along x.
    pub(super) weight: [S::Lanes; 3],
}

impl<S: Simd> Stencils<S> {
    /// The stencils at positions (cells) inside the patch, see [`Chunk::takes`](super::chunk::Chunk::takes).
    #[inline(always)]
    pub(super) fn of(simd: S, cell: [S::Lanes; 2]) -> Self {
        let half = simd.splat(0.5);
        // Truncation is the floor of non-negative numbers.
        let (x, base_x) = simd.truncate(cell[0] - half);
        let (y, base_y) = simd.truncate(cell[1] - half);
        let offset = [cell[0] - x, cell[1] - y];
        let weight = weights(simd, offset[0]);
        Self { base: [base_x, base_y], lowest: [x, y], offset, weight }
    }
}

/// Weights of the three nodes along an axis at these distances from the first (cells).
#[inline(always)]
pub(super) fn weights<S: Simd>(simd: S, x: S::Lanes) -> [S::Lanes; 3] {
    let (half, one) = (simd.splat(0.5), simd.splat(1.0));
    let (before, after) = (simd.splat(1.5) - x, x - half);
    [half * before * before, simd.splat(0.75) - (x - one) * (x - one), half * after * after]
}

/// Coefficients of the weights of the four nodes of a row at a distance `y` from the first: `c0 + y (c1 + y c2)`.
const WEIGHTS: [[f32; 4]; 3] =
    [[1.125, -0.25, 0.125, 0.0], [-1.5, 2.0, -0.5, 0.0], [0.5, -1.0, 0.5, 0.0]];

/// Duplicates the numbers of four nodes for two components.
const fn twice(row: [f32; 4]) -> [[f32; 2]; 4] {
    [[row[0]; 2], [row[1]; 2], [row[2]; 2], [row[3]; 2]]
}

const PAIR_WEIGHTS: [[[f32; 2]; 4]; 3] = [twice(WEIGHTS[0]), twice(WEIGHTS[1]), twice(WEIGHTS[2])];
/// Index of the node in its row.
const PAIR_PLACES: [[f32; 2]; 4] = twice([0.0, 1.0, 2.0, 3.0]);

/// Weights of a row along y.
pub(super) struct Weights<S: Simd> {
    pairs: [S::Pairs; 3],
    ones: [S::Ones; 3],
    /// Indices of the nodes in their row.
    pub(super) places: S::Pairs,
}

impl<S: Simd> Weights<S> {
    #[inline(always)]
    pub(super) fn new(simd: S) -> Self {
        let [a, b, c] = &PAIR_WEIGHTS;
        let [d, e, f] = &WEIGHTS;
        Self {
            pairs: [simd.load_pairs(a), simd.load_pairs(b), simd.load_pairs(c)],
            ones: [simd.load_ones(d), simd.load_ones(e), simd.load_ones(f)],
            places: simd.load_pairs(&PAIR_PLACES),
        }
    }

    /// The weights at a distance `y` from the first node, for both components.
    #[inline(always)]
    pub(super) fn pairs(&self, y: S::Pairs) -> S::Pairs {
        self.pairs[0] + y * (self.pairs[1] + y * self.pairs[2])
    }

    /// The weights at a distance `y` from the first node.
    #[inline(always)]
    pub(super) fn ones(&self, y: S::Ones) -> S::Ones {
        self.ones[0] + y * (self.ones[1] + y * self.ones[2])
    }
}
