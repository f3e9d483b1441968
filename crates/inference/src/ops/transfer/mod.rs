//! Transfers between particles and the finest nodes of their [grid](crate::kernels::nodes): sums over the particles around each node
//! (P2G) and over the nodes around each particle (G2P), with the weights of the quadratic spline.
//!
//! P2G and G2P are each other's transposes, which gives their gradients:
//!
//! | | P2G, s = [`to_nodes`]`(q)` | G2P, c = [`to_particles`]`(v)` |
//! |---|---|---|
//! | by the summed values | `to_particles(by_s)` | `to_nodes(by_c)` |
//! | by the positions | [`by_position`]`(by_s, q)` | `by_position(v, by_c)` |
//!
//! The mass of a node, the sum of its weights, is P2G of a channel of ones.
//!
//! The gradient by a position outside of the domain is that at the nearest position inside. Sums are in the order of slots:
//! any number of threads gives the same bits.
//!
//! 1. This file: whole lists, for training; predictions gather with it, too.
//! 2. `segments`: P2G of predictions, by blocks of particles.
//! 3. `device.cu`: both on GPUs.

pub(crate) mod segments;

use std::ops::Range;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use crate::kernels::{
    nodes::{Cell, Nodes, Row, WindowRanges, range},
    vectors::{load, store},
};

/// The sums on GPUs.
pub const DEVICE: &str = include_str!("device.cu");

/// P2G: the sums over particles of their weights times their `channels`, `[R, C]` to `[M, C]`.
///
/// # Panics
/// If the numbers of rows and particles differ.
pub fn to_nodes(nodes: &Nodes, channels: &[f32], width: usize) -> Vec<f32> {
    assert_eq!(channels.len(), nodes.order().len() * width);
    let mut sums = vec![0.0; nodes.level(0).len() * width];
    let parts = parts(&mut sums, nodes, |place| place.nodes[0].len() * width);
    parts.into_par_iter().zip(nodes.windows()).for_each(|(mut sums, place)| {
        for row in &nodes.rows()[place.rows.clone()] {
            let (this, rest) = sums.split_at_mut(range(row.nodes).len() * width);
            Arch::new().dispatch(SumRow { nodes, row, channels, width, sums: this });
            sums = rest;
        }
    });
    sums
}

/// The mass of each node, `[M]`: the sum of its particles' weights.
pub fn mass(nodes: &Nodes) -> Vec<f32> {
    to_nodes(nodes, &vec![1.0; nodes.order().len()], 1)
}

/// G2P: the sums over nodes of their weights times their `field`, `[M, C]` to `[R, C]`.
///
/// # Panics
/// If the numbers of rows and nodes differ.
pub fn to_particles(nodes: &Nodes, field: &[f32], width: usize) -> Vec<f32> {
    assert_eq!(field.len(), nodes.level(0).len() * width);
    let mut sums = vec![0.0; nodes.order().len() * width];
    let parts = parts(&mut sums, nodes, |place| place.particles.len() * width);
    parts.into_par_iter().zip(nodes.windows()).for_each(|(sums, place)| {
        Arch::new().dispatch(Gather { nodes, place, field, width, sums });
    });
    sums
}

/// The gradient by the positions, `[R, 2]` (1 / domain lengths), of the sum over particles and channels of
/// [`to_particles`]`(field)` times `channels`, `[R, C]`, which equals the sum over nodes and channels of `field`, `[M, C]`,
/// times [`to_nodes`]`(channels)`.
///
/// # Panics
/// If the numbers of rows do not match nodes and particles.
pub fn by_position(nodes: &Nodes, field: &[f32], channels: &[f32], width: usize) -> Vec<f32> {
    assert_eq!(field.len(), nodes.level(0).len() * width);
    assert_eq!(channels.len(), nodes.order().len() * width);
    let mut gradient = vec![0.0; nodes.order().len() * 2];
    let parts = parts(&mut gradient, nodes, |place| place.particles.len() * 2);
    parts.into_par_iter().zip(nodes.windows()).for_each(|(gradient, place)| {
        Arch::new().dispatch(PositionGradient { nodes, place, field, channels, width, gradient });
    });
    gradient
}

/// Splits a list into the parts of the windows.
fn parts<'a>(
    mut list: &'a mut [f32],
    nodes: &Nodes,
    length: impl Fn(&WindowRanges) -> usize,
) -> Vec<&'a mut [f32]> {
    let cut = |place| {
        let (part, rest) = std::mem::take(&mut list).split_at_mut(length(place));
        list = rest;
        part
    };
    nodes.windows().iter().map(cut).collect()
}

/// The range of some channels of a row.
#[inline(always)]
fn of_row(row: usize, width: usize, part: &Range<usize>) -> Range<usize> {
    row * width + part.start..row * width + part.end
}

/// Loads at most a vector of numbers, padded with zeros.
#[inline(always)]
fn load_alone<S: Simd>(simd: S, numbers: &[f32]) -> S::f32s {
    match S::as_simd_f32s(numbers) {
        ([vector, ..], _) => *vector,
        (_, rest) => simd.partial_load_f32s(rest),
    }
}

/// The channels in ranges of a vector each.
#[inline(always)]
fn vectors<S: Simd>(width: usize) -> impl Iterator<Item = Range<usize>> {
    (0..width).step_by(S::F32_LANES).map(move |first| first..(first + S::F32_LANES).min(width))
}

/// P2G for one row of nodes of a window.
struct SumRow<'a> {
    nodes: &'a Nodes,
    row: &'a Row,
    channels: &'a [f32],
    width: usize,
    /// Sums on the row's nodes, `[nodes, C]`, initially zero.
    sums: &'a mut [f32],
}

impl WithSimd for SumRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { nodes, row, channels, width, sums } = self;
        for (number, &cells) in row.cells.iter().enumerate() {
            for cell in &nodes.cells()[range(cells)] {
                let first = (cell.nodes[number] - row.nodes[0]) as usize * width;
                let sums = &mut sums[first..first + 3 * width];
                // Two vectors at once, to hide the latency of additions.
                for first in (0..width).step_by(2 * S::F32_LANES) {
                    let rows = (channels, width);
                    if width - first > S::F32_LANES {
                        sum_cell::<S, 2>(simd, nodes, (cell, number), rows, first, sums);
                    } else {
                        sum_cell::<S, 1>(simd, nodes, (cell, number), rows, first, sums);
                    }
                }
            }
        }
    }
}

/// Adds the contribution of a cell to row `number` of its stencil: V vectors of channels from `first` on.
#[inline(always)]
fn sum_cell<S: Simd, const V: usize>(
    simd: S,
    nodes: &Nodes,
    (cell, number): (&Cell, usize),
    (channels, width): (&[f32], usize),
    first: usize,
    sums: &mut [f32],
) {
    let mut parts = [const { 0..0 }; V];
    for (v, part) in parts.iter_mut().enumerate() {
        let first = first + v * S::F32_LANES;
        *part = first..(first + S::F32_LANES).min(width);
    }
    let mut sum = [[simd.splat_f32s(0.0); 3]; V];
    for (sum, part) in sum.iter_mut().zip(&parts) {
        for (node, sum) in sum.iter_mut().enumerate() {
            *sum = load(simd, sums, of_row(node, width, part));
        }
    }
    for slot in cell.slots() {
        let row = nodes.order()[slot] as usize;
        let [columns, rows] = &nodes.weights()[slot];
        let mut weight = [simd.splat_f32s(0.0); 3];
        for (weight, column) in weight.iter_mut().zip(columns) {
            *weight = simd.splat_f32s(column * rows[number]);
        }
        for (sum, part) in sum.iter_mut().zip(&parts) {
            let values = load(simd, channels, of_row(row, width, part));
            for (sum, &weight) in sum.iter_mut().zip(&weight) {
                *sum = simd.mul_add_e_f32s(weight, values, *sum);
            }
        }
    }
    for (sum, part) in sum.iter().zip(&parts) {
        for (node, &sum) in sum.iter().enumerate() {
            store(simd, sums, of_row(node, width, part), sum);
        }
    }
}

/// Some channels of the nine nodes of a cell's stencil.
#[inline(always)]
fn stencil<S: Simd>(
    simd: S,
    cell: &Cell,
    field: &[f32],
    width: usize,
    part: &Range<usize>,
) -> [[S::f32s; 3]; 3] {
    let mut values = [[simd.splat_f32s(0.0); 3]; 3];
    for (values, &first) in values.iter_mut().zip(&cell.nodes) {
        for (column, values) in values.iter_mut().enumerate() {
            *values = load(simd, field, of_row(first as usize + column, width, part));
        }
    }
    values
}

/// The sum over a stencil's nodes weighted by the products of `columns` and `rows`.
#[inline(always)]
fn weigh<S: Simd>(
    simd: S,
    values: &[[S::f32s; 3]; 3],
    columns: &[f32; 3],
    rows: &[f32; 3],
) -> S::f32s {
    let columns =
        [simd.splat_f32s(columns[0]), simd.splat_f32s(columns[1]), simd.splat_f32s(columns[2])];
    let mut sum = simd.splat_f32s(0.0);
    for row in 0..3 {
        let mut across = simd.mul_f32s(columns[0], values[row][0]);
        across = simd.mul_add_e_f32s(columns[1], values[row][1], across);
        across = simd.mul_add_e_f32s(columns[2], values[row][2], across);
        sum = simd.mul_add_e_f32s(simd.splat_f32s(rows[row]), across, sum);
    }
    sum
}

/// G2P for a window.
struct Gather<'a> {
    nodes: &'a Nodes,
    place: &'a WindowRanges,
    field: &'a [f32],
    width: usize,
    /// Sums of the window's particles.
    sums: &'a mut [f32],
}

impl WithSimd for Gather<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { nodes, place, field, width, sums } = self;
        let (order, first) = (nodes.order(), place.particles.start);
        gather(
            simd,
            nodes,
            place.particles.clone(),
            field,
            width,
            #[inline(always)]
            |slot| order[slot] as usize - first,
            sums,
        );
    }
}

/// G2P for a range of slots, whose sums go to the rows that `place` returns.
#[inline(always)]
pub fn gather<S: Simd>(
    simd: S,
    nodes: &Nodes,
    slots: Range<usize>,
    field: &[f32],
    width: usize,
    place: impl Fn(usize) -> usize,
    sums: &mut [f32],
) {
    let first = nodes.cells().partition_point(
        #[inline(always)]
        |cell| cell.slots().end <= slots.start,
    );
    for cell in &nodes.cells()[first..] {
        let own = cell.slots().start.max(slots.start)..cell.slots().end.min(slots.end);
        if own.is_empty() {
            return;
        }
        for part in vectors::<S>(width) {
            let values = stencil(simd, cell, field, width, &part);
            for slot in own.clone() {
                let [columns, rows] = &nodes.weights()[slot];
                let sum = weigh(simd, &values, columns, rows);
                store(simd, sums, of_row(place(slot), width, &part), sum);
            }
        }
    }
}

/// Gradients by the positions of a window's particles.
struct PositionGradient<'a> {
    nodes: &'a Nodes,
    place: &'a WindowRanges,
    field: &'a [f32],
    channels: &'a [f32],
    width: usize,
    gradient: &'a mut [f32],
}

impl WithSimd for PositionGradient<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { nodes, place, field, channels, width, gradient } = self;
        let per_length = 1.0 / nodes.width();
        for cell in &nodes.cells()[place.cells.clone()] {
            for part in vectors::<S>(width) {
                let values = stencil(simd, cell, field, width, &part);
                for slot in cell.slots() {
                    let [columns, rows] = &nodes.weights()[slot];
                    let particle = nodes.order()[slot] as usize;
                    let own = load_alone(simd, &channels[of_row(particle, width, &part)]);
                    let across = weigh(simd, &values, &weight_gradients(columns), rows);
                    let up = weigh(simd, &values, columns, &weight_gradients(rows));
                    let gradient = &mut gradient[2 * (particle - place.particles.start)..][..2];
                    gradient[0] += per_length * simd.reduce_sum_f32s(simd.mul_f32s(own, across));
                    gradient[1] += per_length * simd.reduce_sum_f32s(simd.mul_f32s(own, up));
                }
            }
        }
    }
}

/// Derivatives of the weights of three nodes by the particle's distance from the first (1 / cells). The distance follows from
/// the weights: it is their mean.
#[inline(always)]
fn weight_gradients([_, middle, last]: &[f32; 3]) -> [f32; 3] {
    let x = middle + 2.0 * last;
    [x - 1.5, 2.0 - 2.0 * x, x - 0.5]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::kernels::nodes::Window;

    const WIDTH: f32 = 0.125;

    fn grid(position: &[[f32; 2]], cut: usize) -> Nodes {
        let window = |particles| Window { particles, lower: [0.0; 2], upper: [1.0, 1.2] };
        let mut nodes = Nodes::default();
        nodes.rebuild(position, &[window(0..cut), window(cut..position.len())], WIDTH, 3);
        nodes
    }

    /// The spline's weight at a distance (cells).
    fn spline(distance: f64) -> f64 {
        match distance.abs() {
            d if d < 0.5 => 0.75 - d * d,
            d if d < 1.5 => 0.5 * (1.5 - d) * (1.5 - d),
            _ => 0.0,
        }
    }

    /// Every pair of particle and node of the same window with its weight.
    fn pairs(nodes: &Nodes, position: &[[f64; 2]]) -> Vec<(usize, usize, f64)> {
        let mut pairs = Vec::new();
        for place in nodes.windows() {
            for particle in place.particles.clone() {
                for node in place.nodes[0].clone() {
                    let at = nodes.level(0).at[node];
                    let axis = |axis: usize| {
                        spline(position[particle][axis] / f64::from(WIDTH) - f64::from(at[axis]))
                    };
                    pairs.push((particle, node, axis(0) * axis(1)));
                }
            }
        }
        pairs
    }

    proptest! {
        #[test]
        fn sums_and_gradients_equal_those_over_all_pairs(
            position in proptest::collection::vec([0.01f32..0.99, 0.01f32..1.19], 1..40),
            cut in 0usize..40,
            width in 1usize..40,
            seed: u64,
        ) {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            let mut numbers = |rows: usize| -> Vec<f32> {
                (0..rows * width).map(|_| random.random_range(-1.0..1.0)).collect()
            };
            let nodes = grid(&position, cut.min(position.len()));
            let (channels, field) = (numbers(position.len()), numbers(nodes.level(0).len()));
            let exact: Vec<_> = position.iter().map(|x| x.map(f64::from)).collect();
            let sum = |position: &[[f64; 2]]| {
                let mut p2g = vec![0.0; field.len()];
                let mut g2p = vec![0.0; channels.len()];
                let mut both = 0.0;
                let mut mass = vec![0.0; nodes.level(0).len()];
                for (particle, node, weight) in pairs(&nodes, position) {
                    mass[node] += weight;
                    for c in 0..width {
                        let (p, n) = (particle * width + c, node * width + c);
                        p2g[n] += weight * f64::from(channels[p]);
                        g2p[p] += weight * f64::from(field[n]);
                        both += weight * f64::from(channels[p]) * f64::from(field[n]);
                    }
                }
                (p2g, g2p, mass, both)
            };
            let close = |found: &[f32], expected: &[f64], tolerance: f64| {
                assert_eq!(found.len(), expected.len());
                found.iter().zip(expected).all(|(a, b)| (f64::from(*a) - b).abs() <= tolerance)
            };
            let (p2g, g2p, mass, _) = sum(&exact);
            prop_assert!(close(&to_nodes(&nodes, &channels, width), &p2g, 2e-5));
            prop_assert!(close(&to_particles(&nodes, &field, width), &g2p, 2e-5));
            prop_assert!(close(&super::mass(&nodes), &mass, 2e-5));

            // Within a cell the sum is a polynomial of degree 4 in each coordinate; at a cell's border its second
            // derivative jumps, so that the finite difference is accurate to first order.
            let step = 1e-6;
            let gradient = by_position(&nodes, &field, &channels, width);
            for particle in 0..position.len().min(5) {
                for axis in 0..2 {
                    let at = |side: f64| {
                        let mut moved = exact.clone();
                        moved[particle][axis] += side * step;
                        sum(&moved).3
                    };
                    let expected = (at(1.0) - at(-1.0)) / (2.0 * step);
                    let found = f64::from(gradient[2 * particle + axis]);
                    prop_assert!((found - expected).abs() <= 2e-3, "{found}, {expected}");
                }
            }
        }
    }
}
