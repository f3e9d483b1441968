//! Muon (Jordan et al. 2024, "Muon: An optimizer for hidden layers in neural networks"): Nesterov's momentum, made nearly
//! orthogonal as a matrix, so that a step moves all its directions alike, also those in which gradients are small.
//!
//! The Newton-Schulz iteration X <- a X + b (X X^T) X + c (X X^T)^2 X only multiplies X by polynomials of X X^T. Here these are
//! computed from the smaller of X X^T and X^T X alone, and multiply the momentum once. On GPUs: `muon.cu` of eddy-cuda.

use eddy_inference::kernels::matrix::{Matrix, product};

/// Decay of the momentum, which is Nesterov's.
const MOMENTUM: f32 = 0.95;
/// a, b and c as published: in [`ITERATIONS`], they bring singular values from .003 of the norm on to between .65 and 1.25.
const POLYNOMIAL: [f32; 3] = [3.4445, -4.7750, 2.0315];
const ITERATIONS: usize = 5;
/// Smallest norm that the momentum is divided by, so that vanishing gradients do not move the weights (`torch.optim.Muon`'s).
const EPSILON: f32 = 1e-7;
/// Root mean square of a step at a learning rate of 1, about that of Adam (Liu et al. 2025, "Muon is scalable for LLM training").
const STEP: f32 = 0.2;

/// Changes a matrix of `[rows, columns]` by its gradient, times `scale` to clip it.
pub(super) fn change(
    shape: [usize; 2],
    values: &mut [f32],
    gradient: &[f32],
    momentum: &mut [f32],
    scale: f32,
    rate: f32,
) {
    let direction: Vec<f32> = momentum
        .iter_mut()
        .zip(gradient)
        .map(|(momentum, gradient)| {
            let gradient = scale * gradient;
            *momentum = MOMENTUM * *momentum + gradient;
            MOMENTUM * *momentum + gradient
        })
        .collect();
    // An orthogonal matrix has the root mean square 1 / sqrt(max(rows, columns)).
    let rate = rate * STEP * (shape[0].max(shape[1]) as f32).sqrt();
    for (value, step) in values.iter_mut().zip(orthogonalized(&direction, shape)) {
        *value -= rate * step;
    }
}

/// The matrix with its singular values brought to about 1.
fn orthogonalized(values: &[f32], [rows, columns]: [usize; 2]) -> Vec<f32> {
    let whole = Matrix::new(values, rows, columns);
    let wide = rows <= columns;
    let (size, mut gram) = match wide {
        true => (rows, product(whole, whole.transposed())),
        false => (columns, product(whole.transposed(), whole)),
    };
    let square: f32 = gram.iter().step_by(size + 1).sum();
    let norm = square.sqrt().max(EPSILON);
    // Of X = values / norm, whose singular values are at most 1.
    gram.iter_mut().for_each(|value| *value /= norm * norm);
    let times =
        |a: &[f32], b: &[f32]| product(Matrix::new(a, size, size), Matrix::new(b, size, size));
    let mut factor = polynomial(&gram, &times(&gram, &gram), size);
    let mut all = factor.clone();
    for _ in 1..ITERATIONS {
        gram = times(&times(&gram, &factor), &factor);
        factor = polynomial(&gram, &times(&gram, &gram), size);
        all = times(&factor, &all);
    }
    all.iter_mut().for_each(|value| *value /= norm);
    let all = Matrix::new(&all, size, size);
    if wide { product(all, whole) } else { product(whole, all) }
}

/// a I + b G + c G^2.
fn polynomial(gram: &[f32], square: &[f32], size: usize) -> Vec<f32> {
    let [a, b, c] = POLYNOMIAL;
    let mut sum: Vec<f32> = gram.iter().zip(square).map(|(g, gg)| b * g + c * gg).collect();
    sum.iter_mut().step_by(size + 1).for_each(|value| *value += a);
    sum
}

#[cfg(test)]
mod tests {
    use std::{fs, path::Path};

    use proptest::prelude::*;
    use safetensors::SafeTensors;

    use super::*;

    /// The published iteration, on the matrix itself, in double precision.
    fn reference(values: &[f32], [rows, columns]: [usize; 2]) -> Vec<f64> {
        let at = |x: &[f64], row: usize, column: usize| x[row * columns + column];
        let norm = values.iter().map(|&value| f64::from(value).powi(2)).sum::<f64>().sqrt();
        // A gradient that vanishes moves nothing.
        let norm = norm.max(EPSILON.into());
        let mut x: Vec<f64> = values.iter().map(|&value| f64::from(value) / norm).collect();
        let [a, b, c] = POLYNOMIAL.map(f64::from);
        for _ in 0..ITERATIONS {
            let gram = |i: usize, j: usize| -> f64 {
                (0..columns).map(|k| at(&x, i, k) * at(&x, j, k)).sum()
            };
            let gram: Vec<f64> =
                (0..rows * rows).map(|place| gram(place / rows, place % rows)).collect();
            let apply = |y: &[f64]| -> Vec<f64> {
                let sum = |row: usize, column: usize| -> f64 {
                    (0..rows).map(|k| gram[row * rows + k] * at(y, k, column)).sum()
                };
                (0..rows * columns).map(|place| sum(place / columns, place % columns)).collect()
            };
            let once = apply(&x);
            let twice = apply(&once);
            let terms = x.iter().zip(once.iter().zip(&twice));
            x = terms.map(|(x, (once, twice))| a * x + b * once + c * twice).collect();
        }
        x
    }

    proptest! {
        #[test]
        fn polynomials_of_the_small_product_are_the_published_iteration(
            [rows, columns] in [1..14usize, 1..14usize],
            numbers in prop::collection::vec(-1.0f32..1.0, 196),
            exponent in -6i32..7,
        ) {
            let scale = 10f32.powi(exponent);
            let values: Vec<f32> =
                numbers[..rows * columns].iter().map(|value| scale * value).collect();
            let found = orthogonalized(&values, [rows, columns]);
            let expected = reference(&values, [rows, columns]);
            for (found, expected) in found.iter().zip(&expected) {
                prop_assert!((f64::from(*found) - expected).abs() < 2e-3, "{found}, {expected}");
            }
        }
    }

    #[test]
    fn singular_values_of_very_different_size_come_to_about_1() {
        // Diagonal, so that they are its elements.
        let [rows, columns] = [4, 6];
        let mut values = vec![0.0; rows * columns];
        for (place, value) in [1.0, 0.3, 0.02, 0.005].into_iter().enumerate() {
            values[place * columns + place] = value;
        }
        let found = orthogonalized(&values, [rows, columns]);
        for (place, value) in found.iter().enumerate() {
            let diagonal = place / columns == place % columns;
            let range = if diagonal { 0.65..1.25 } else { -1e-6..1e-6 };
            assert!(range.contains(value), "{place}: {value}");
        }
    }

    #[test]
    fn a_step_has_the_size_of_the_rate_and_leads_down_the_gradient() {
        let gradient = [3.0, 0.0, 0.0, -0.03, 0.0, 0.0];
        let (mut values, mut momentum) = ([0.0; 6], [0.0; 6]);
        change([3, 2], &mut values, &gradient, &mut momentum, 0.5, 0.1);
        // .2 x .1 x sqrt(3) is .035, times .65 to 1.25 for each singular value.
        for (value, sign) in [(values[0], -1.0), (values[3], 1.0)] {
            assert!((0.0225..0.0434).contains(&(sign * value)), "{values:?}");
        }
        assert_eq!(momentum, [1.5, 0.0, 0.0, -0.015, 0.0, 0.0]);
    }

    #[test]
    fn vanishing_gradients_do_not_move_the_weights() {
        for size in [0.0, 1e-30, 1e-21, 1e-12] {
            let mut values = [0.0; 4];
            let gradient = [size, 0.0, 0.0, -size];
            change([2, 2], &mut values, &gradient, &mut [0.0; 4], 1.0, 0.1);
            assert!(values.iter().all(|value| value.abs() < 1e-3), "{size}: {values:?}");
        }
    }

    #[test]
    fn steps_are_those_of_pytorch() {
        const RATE: f32 = 1e-3;
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
        let bytes = fs::read(root.join("tests/golden/torch/muon/steps.safetensors")).unwrap();
        let data = SafeTensors::deserialize(&bytes).unwrap();
        for name in ["square", "tall", "wide"] {
            let [gradients, changes] = ["gradient", "change"].map(|of| {
                let tensor = data.tensor(&format!("{of}.{name}")).unwrap();
                let (numbers, _) = tensor.data().as_chunks();
                let numbers: Vec<f32> = numbers.iter().map(|&n| f32::from_le_bytes(n)).collect();
                (numbers, tensor.shape().to_vec())
            });
            let [_, rows, columns] = gradients.1[..] else { panic!("{name}: {:?}", gradients.1) };
            let (mut values, mut momentum) = (vec![0.0; rows * columns], vec![0.0; rows * columns]);
            let steps = gradients.0.chunks(rows * columns).zip(changes.0.chunks(rows * columns));
            for (gradient, expected) in steps {
                change([rows, columns], &mut values, gradient, &mut momentum, 1.0, RATE);
                let squares = values.iter().zip(expected).map(|(a, b)| (a - b).powi(2));
                let (error, norm) = (squares.sum::<f32>(), expected.iter().map(|x| x * x));
                let relative = (error / norm.sum::<f32>()).sqrt();
                assert!(relative < 1e-4, "{name}: {relative}");
            }
        }
    }
}
