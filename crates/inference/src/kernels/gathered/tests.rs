use proptest::prelude::*;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::kernels::nodes::{MISSING, Nodes, Window};

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

/// Which block of the weight connects which rows: (input, block, output).
type Links = Vec<(usize, usize, usize)>;

/// The definition of the three layers: for each link, y[output] += x[input] W[block].
struct Plain {
    links: Links,
    rows: usize,
    /// Whether the blocks of the weight are stacked, `[K I, O]`, or side by side, `[I, K O]`.
    below: bool,
    rectify: bool,
}

impl Plain {
    fn forward(&self, x: &[f64], weight: &[f64], bias: &[f64]) -> Vec<f64> {
        let outputs = bias.len();
        let blocks = if self.below { 1 } else { 4 };
        let inputs = x.len() / self.links.iter().map(|link| link.0 + 1).max().unwrap_or(1);
        let mut y = bias.repeat(self.rows);
        for &(from, block, to) in &self.links {
            for i in 0..inputs {
                for o in 0..outputs {
                    let at = match self.below {
                        true => (block * inputs + i) * outputs + o,
                        false => (i * blocks + block) * outputs + o,
                    };
                    y[to * outputs + o] += x[from * inputs + i] * weight[at];
                }
            }
        }
        if self.rectify {
            y.iter_mut().for_each(|y| *y = y.max(0.0));
        }
        y
    }

    /// Compares values and gradients of the sum of outputs times `above`.
    fn check(
        &self,
        [x, weight, bias, above]: [&[f32]; 4],
        output: &[f32],
        by: &Gradients,
    ) -> Result<(), TestCaseError> {
        let exact = |list: &[f32]| list.iter().map(|&x| f64::from(x)).collect::<Vec<_>>();
        let lists = [exact(x), exact(weight), exact(bias)];
        let expected = self.forward(&lists[0], &lists[1], &lists[2]);
        prop_assert_eq!(output.len(), expected.len());
        for (found, expected) in output.iter().zip(&expected) {
            prop_assert!((f64::from(*found) - expected).abs() <= 1e-5, "{found}, {expected}");
        }
        let step = 1e-7;
        for (which, gradient) in [&by.input, &by.weight, &by.bias].into_iter().enumerate() {
            prop_assert_eq!(gradient.len(), lists[which].len());
            for (at, &found) in gradient.iter().enumerate().step_by(1 + gradient.len() / 7) {
                let sum = |side: f64| {
                    let mut lists = lists.clone();
                    lists[which][at] += side * step;
                    let y = self.forward(&lists[0], &lists[1], &lists[2]);
                    y.iter().zip(above).map(|(y, above)| y * f64::from(*above)).sum::<f64>()
                };
                let expected = (sum(1.0) - sum(-1.0)) / (2.0 * step);
                prop_assert!((f64::from(found) - expected).abs() <= 1e-4, "{found}, {expected}");
            }
        }
        Ok(())
    }
}

/// Links of a table whose rows are outputs.
fn links<const K: usize>(table: &[[u32; K]]) -> Links {
    let flat = table.as_flattened().iter().enumerate();
    flat.filter(|(_, row)| **row != MISSING)
        .map(|(at, &row)| (row as usize, at % K, at / K))
        .collect()
}

proptest! {
    #[test]
    fn a_convolution_sums_over_neighbours(seed: u64, i in 1usize..12, o in 1usize..20, rectify: bool) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let nodes = grid(&mut random);
        let level = nodes.level(random.random_range(0..3));
        let lengths = [level.len() * i, 9 * i * o, level.len() * o];
        let [x, weight, above] = lengths.map(|length| numbers(&mut random, length));
        let bias = biases(&mut random, o);
        let table = Table::Neighbours(&level.neighbours);
        let layer = Convolution { table, weight: &weight, bias: &bias, rectify };
        let output = layer.forward(&x);
        let by = layer.backward(&x, &output, &above, true, true);
        let plain = Plain { links: links(&level.neighbours), rows: level.len(), below: true, rectify };
        plain.check([&x, &weight, &bias, &above], &output, &by)?;
    }

    #[test]
    fn down_sums_over_children_and_up_shares_among_them(
        seed: u64,
        i in 1usize..12,
        o in 1usize..20,
        rectify: bool,
    ) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let nodes = grid(&mut random);
        let fine = random.random_range(0..2);
        let (fine, coarse) = (nodes.level(fine), nodes.level(fine + 1));
        let (children, parent) = (coarse.children.as_slice(), fine.parent.as_slice());

        let lengths = [fine.len() * i, 4 * i * o, coarse.len() * o];
        let [x, weight, above] = lengths.map(|length| numbers(&mut random, length));
        let bias = biases(&mut random, o);
        let table = Table::Children { children, parent };
        let layer = Convolution { table, weight: &weight, bias: &bias, rectify };
        let output = layer.forward(&x);
        let by = layer.backward(&x, &output, &above, true, true);
        let links = links(children);
        let plain = Plain { links: links.clone(), rows: coarse.len(), below: true, rectify };
        plain.check([&x, &weight, &bias, &above], &output, &by)?;

        let lengths = [coarse.len() * i, 4 * i * o, fine.len() * o];
        let [x, weight, above] = lengths.map(|length| numbers(&mut random, length));
        let bias = biases(&mut random, o);
        let layer = TransposedConvolution { children, parent, weight: &weight, bias: &bias };
        let output = layer.forward(&x);
        let by = layer.backward(&x, &above, true, true);
        let links = links.into_iter().map(|(child, block, parent)| (parent, block, child)).collect();
        let plain = Plain { links, rows: fine.len(), below: false, rectify: false };
        plain.check([&x, &weight, &bias, &above], &output, &by)?;
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits(seed: u64) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let position: Vec<_> =
            (0..4000).map(|_| [(); 2].map(|()| random.random_range(0.0..1.0f32))).collect();
        let mut nodes = Nodes::default();
        nodes.rebuild(&position, &[Window { particles: 0..4000, lower: [0.0; 2], upper: [1.0; 2] }], 0.02, 3);
        let level = nodes.level(0);
        let lengths = [level.len() * 5, 9 * 5 * 8, level.len() * 8];
        let [x, weight, above] = lengths.map(|length| numbers(&mut random, length));
        let bias = biases(&mut random, 8);
        let table = Table::Neighbours(&level.neighbours);
        let layer = Convolution { table, weight: &weight, bias: &bias, rectify: true };
        let all = [1, 2, 5].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let output = layer.forward(&x);
                let by = layer.backward(&x, &output, &above, true, true);
                (output, by.input, by.weight, by.bias)
            })
        });
        prop_assert!(all[0] == all[1] && all[0] == all[2]);
    }
}
