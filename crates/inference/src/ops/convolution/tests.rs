use proptest::prelude::*;
use pulp::{Arch, Simd, WithSimd};
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::{
    checkpoint::{Weights, grid::MAX_LISTS},
    kernels::nodes::{MISSING, Window},
};
use eddy_threads::DisjointSlice;

/// A grid of two scenes.
fn grid(random: &mut ChaCha8Rng) -> Nodes {
    let count = random.random_range(1..30);
    let position: Vec<_> =
        (0..count).map(|_| [(); 2].map(|()| random.random_range(0.0..1.0f32))).collect();
    let cut = random.random_range(0..count);
    let window = |particles| Window { particles, lower: [0.0; 2], upper: [1.0; 2] };
    let mut nodes = Nodes::default();
    nodes.rebuild(&position, &[window(0..cut), window(cut..count)], 0.07, 3);
    nodes
}

/// Multiples of 1/8, whose products and sums have no rounding errors.
fn numbers(random: &mut ChaCha8Rng, length: usize) -> Vec<f32> {
    (0..length).map(|_| random.random_range(-8..8) as f32 / 8.0).collect()
}

/// Not multiples of 1/8, so that no sum is exactly zero, where ReLU has no derivative.
fn biases(random: &mut ChaCha8Rng, length: usize) -> Vec<f32> {
    numbers(random, length).into_iter().map(|bias| bias + 1.0 / 128.0).collect()
}

/// A layer with these channels at a level.
fn layer(stencil: Stencil, level: usize, channels: [usize; 2], rectified: bool) -> GridLayer {
    let skip = (stencil == Stencil::Parent).then_some(0);
    GridLayer { name: String::new(), stencil, level, channels, skip, rectified, lists: [0, 1] }
}

/// Numbers of rows that a layer reads and writes.
fn rows(nodes: &Nodes, layer: &GridLayer) -> [usize; 2] {
    let count = |level: usize| nodes.level(level).len();
    let read = match layer.stencil {
        Stencil::Neighbours => layer.level,
        Stencil::Children => layer.level - 1,
        Stencil::Parent => layer.level + 1,
    };
    [count(read), count(layer.level)]
}

/// The definition of a layer: y[output] += x[input] W[block] for each row that a table connects with another one.
fn plain(nodes: &Nodes, layer: &GridLayer, [x, weight, bias, added]: [&[f64]; 4]) -> Vec<f64> {
    let (level, parents) = (nodes.level(layer.node_level()), layer.stencil == Stencil::Parent);
    let (table, places) = match layer.stencil {
        Stencil::Neighbours => (level.neighbours.as_flattened(), 9),
        Stencil::Children | Stencil::Parent => (level.children.as_flattened(), 4),
    };
    let [inputs, outputs] = layer.channels;
    let mut y = added.to_vec();
    y.chunks_exact_mut(outputs).for_each(|y| y.iter_mut().zip(bias).for_each(|(y, b)| *y += b));
    for (at, &row) in table.iter().enumerate().filter(|(_, row)| **row != MISSING) {
        let (block, row) = (at % places, row as usize);
        let (from, to) = if parents { (at / places, row) } else { (row, at / places) };
        for i in 0..inputs {
            for o in 0..outputs {
                let w = match layer.stencil {
                    Stencil::Parent => weight[(i * places + block) * outputs + o],
                    _ => weight[(block * inputs + i) * outputs + o],
                };
                y[to * outputs + o] += x[from * inputs + i] * w;
            }
        }
    }
    if layer.rectified {
        y.iter_mut().for_each(|y| *y = y.max(0.0));
    }
    y
}

/// Random numbers for a layer: x, W, b, what is added, and the gradient by the output.
fn random_lists(random: &mut ChaCha8Rng, nodes: &Nodes, layer: &GridLayer) -> [Vec<f32>; 5] {
    let ([read, written], [inputs, outputs]) = (rows(nodes, layer), layer.channels);
    let places = layer.stencil.places() * layer.stencil.children();
    let [x, weight] = [read * inputs, places * inputs * outputs].map(|n| numbers(random, n));
    let [mut added, gradient] = [(); 2].map(|()| numbers(random, written * outputs));
    if layer.skip.is_none() {
        added.fill(0.0);
    }
    [x, weight, biases(random, outputs), added, gradient]
}

/// The packed form, whose lists have wider rows and a row of zeros behind them.
struct Packed<'a>(&'a Nodes, &'a GridLayer, &'a [Vec<f32>; 5]);

impl WithSimd for Packed<'_> {
    type Output = Vec<f32>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Vec<f32> {
        let Self(nodes, layer, [x, weight, bias, added, _]) = self;
        let [inputs, outputs] = layer.channels;
        let rows = weight.len() / (layer.stencil.places() * inputs);
        let columns = weight.len() / rows;
        let turned = (0..rows).flat_map(|row| weight.iter().skip(row).step_by(rows)).copied();
        let weight = Weights { shape: vec![rows, columns], values: turned.collect() };
        let bias = Weights { shape: vec![outputs], values: bias.clone() };
        let before = GridLayer { lists: [3, 2], ..layer.clone() };
        let packed = packed::Convolution::pack(S::F32_LANES, layer, &[before], [&weight, &bias]);
        let widths = [inputs, outputs].map(|width| width.next_multiple_of(S::F32_LANES));
        let list = |list: &[f32], width: usize, wide: usize| {
            let mut rows: Vec<f32> = Vec::new();
            for row in list.chunks_exact(width) {
                rows.extend(row);
                rows.resize(rows.len().next_multiple_of(wide), 0.0);
            }
            rows.resize(rows.len() + wide, 0.0);
            rows
        };
        let mut lists: [Vec<f32>; MAX_LISTS] = Default::default();
        lists[0] = list(x, inputs, widths[0]);
        lists[2] = list(added, outputs, widths[1]);
        lists[1] = vec![7.0; lists[2].len()];
        let mut all = [widths[0]; MAX_LISTS];
        all[1..3].fill(widths[1]);
        let numbers = lists.each_mut().map(|list| DisjointSlice::new(list));
        let shared = packed::Lists { numbers, widths: &all };
        for block in 0..packed.blocks(nodes) {
            packed.run(simd, block, nodes, &shared);
        }
        let count = added.len() / outputs;
        let written = lists[1].chunks_exact(widths[1]).take(count);
        written.flat_map(|row| &row[..outputs]).copied().collect()
    }
}

/// Any layer of a grid.
fn any_layer(random: &mut ChaCha8Rng, channels: [usize; 2], rectified: bool) -> GridLayer {
    let (stencil, levels) =
        [(Stencil::Neighbours, 0..3), (Stencil::Children, 1..3), (Stencil::Parent, 0..2)]
            [random.random_range(0..3)]
        .clone();
    layer(stencil, random.random_range(levels), channels, rectified)
}

proptest! {
    #[test]
    fn layers_have_the_values_and_gradients_of_their_definition(
        seed: u64,
        inputs in 1usize..12,
        outputs in 1usize..20,
        rectified: bool,
    ) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let nodes = grid(&mut random);
        let own = any_layer(&mut random, [inputs, outputs], rectified);
        let lists = random_lists(&mut random, &nodes, &own);
        let [x, weight, bias, added, gradient] = &lists;
        let layer = Convolution { nodes: &nodes, layer: &own, weight, bias };
        let output = layer.forward(x, own.skip.map(|_| &**added));
        let (by, by_added) = layer.backward(x, &output, gradient);

        let exact = [x, weight, bias, added]
            .map(|list| list.iter().map(|&x| f64::from(x)).collect::<Vec<_>>());
        let of = |lists: &[Vec<f64>; 4]| plain(&nodes, &own, lists.each_ref().map(Vec::as_slice));
        let expected = of(&exact);
        let close = |found: &[f32]| {
            let pairs = found.iter().zip(&expected);
            found.len() == expected.len() && pairs.clone().count() > 0
                && pairs.into_iter().all(|(a, b)| (f64::from(*a) - b).abs() <= 1e-5)
        };
        prop_assert!(close(&output), "{own:?}: {output:?}, {expected:?}");
        let packed = Arch::new().dispatch(Packed(&nodes, &own, &lists));
        prop_assert!(close(&packed), "{own:?}, packed: {packed:?}, {expected:?}");

        let step = 1e-7;
        let all = [by.input, by.weight, by.bias, by_added];
        for (which, found) in all[..if own.skip.is_some() { 4 } else { 3 }].iter().enumerate() {
            prop_assert_eq!(found.len(), exact[which].len());
            for (at, &found) in found.iter().enumerate().step_by(1 + found.len() / 7) {
                let sum = |side: f64| {
                    let mut lists = exact.clone();
                    lists[which][at] += side * step;
                    of(&lists).iter().zip(gradient).map(|(y, by)| y * f64::from(*by)).sum::<f64>()
                };
                let expected = (sum(1.0) - sum(-1.0)) / (2.0 * step);
                prop_assert!((f64::from(found) - expected).abs() <= 1e-4, "{found}, {expected}");
            }
        }
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits(seed: u64) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let position: Vec<_> =
            (0..4000).map(|_| [(); 2].map(|()| random.random_range(0.0..1.0f32))).collect();
        let mut nodes = Nodes::default();
        nodes.rebuild(&position, &[Window { particles: 0..4000, lower: [0.0; 2], upper: [1.0; 2] }], 0.02, 3);
        let own = any_layer(&mut random, [5, 8], true);
        let [x, weight, bias, added, gradient] = &random_lists(&mut random, &nodes, &own);
        let layer = Convolution { nodes: &nodes, layer: &own, weight, bias };
        let all = [1, 2, 5].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let output = layer.forward(x, own.skip.map(|_| &**added));
                let (by, by_added) = layer.backward(x, &output, gradient);
                (output, by.input, by.weight, by.bias, by_added)
            })
        });
        prop_assert!(all[0] == all[1] && all[0] == all[2]);
    }
}
