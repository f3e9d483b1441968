//! Quadratic B-spline weights between a particle and the 3x3 grid nodes around it.

/// The 3x3 nodes around a particle and their weights.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stencil {
    /// Lowest node on each axis: `floor(x/dx - 0.5)`.
    pub(super) base: [usize; 2],
    /// Distance of the particle from the lowest node on each axis (cells), in [0.5, 1.5).
    pub(super) offset: [f32; 2],
    /// Weights `[axis][node]`; the weight of node (i, j) is `weight[0][i] * weight[1][j]`.
    pub(super) weight: [[f32; 3]; 2],
}

impl Stencil {
    /// The stencil at a position (domain lengths) on a grid with `inverse_dx` cells per length.
    /// Positions below the lowest node layer map to base 0; the solver rejects them beforehand.
    #[inline]
    pub(super) fn at(position: [f32; 2], inverse_dx: f32) -> Self {
        let cell = position.map(|x| x * inverse_dx);
        // `as` truncates, which is the floor of non-negative numbers.
        let base = cell.map(|x| (x - 0.5) as usize);
        let offset = [cell[0] - base[0] as f32, cell[1] - base[1] as f32];
        Self { base, offset, weight: offset.map(weights) }
    }
}

impl Stencil {
    /// The nine nodes (i, j), each with its weight and its distance from the particle (cells).
    pub(super) fn nodes(self) -> impl Iterator<Item = ([usize; 2], f32, [f32; 2])> {
        (0..9).map(move |k| {
            let [i, j] = [k / 3, k % 3];
            let distance = [i as f32 - self.offset[0], j as f32 - self.offset[1]];
            ([i, j], self.weight[0][i] * self.weight[1][j], distance)
        })
    }
}

/// Weights of three neighbouring nodes at a distance `x` in [0.5, 1.5) from the first (cells).
#[inline]
fn weights(x: f32) -> [f32; 3] {
    [0.5 * (1.5 - x) * (1.5 - x), 0.75 - (x - 1.0) * (x - 1.0), 0.5 * (x - 0.5) * (x - 0.5)]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn weights_sum_to_one_and_their_mean_is_the_particle(x in 0.02f32..0.98, y in 0.02f32..0.98) {
            let cells = 64.0;
            let stencil = Stencil::at([x, y], cells);
            for (axis, position) in [x, y].into_iter().enumerate() {
                let [a, b, c] = stencil.weight[axis];
                prop_assert!((a + b + c - 1.0).abs() <= 4.0 * f32::EPSILON);
                let mean = stencil.base[axis] as f32 + b + 2.0 * c;
                // The tolerance is the rounding of the position itself, in cells.
                prop_assert!((mean - position * cells).abs() <= 1e-6 + cells * f32::EPSILON);
                prop_assert!((0.5..=1.5).contains(&stencil.offset[axis]));
            }
        }
    }
}
