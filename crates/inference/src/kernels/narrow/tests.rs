use proptest::prelude::*;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::kernels::matrix::Matrix;

/// Multiples of 1/8, whose products and sums have no rounding errors.
fn numbers(random: &mut ChaCha8Rng, length: usize) -> Vec<f32> {
    (0..length).map(|_| random.random_range(-8..8) as f32 / 8.0).collect()
}

/// The product of a transposed matrix, `[K, M]`, and another, `[K, N]`.
fn product(a: &[f32], b: &[f32], [inner, m, n]: [usize; 3]) -> Vec<f32> {
    let sum = |at: usize| (0..inner).map(|k| a[k * m + at / n] * b[k * n + at % n]).sum();
    (0..m * n).map(sum).collect()
}

fn transposed(numbers: &[f32], columns: usize) -> Vec<f32> {
    (0..columns).flat_map(|column| numbers[column..].iter().step_by(columns)).copied().collect()
}

proptest! {
    #[test]
    fn rows_of_any_number_and_width_are_multiplied(
        seed: u64,
        count in 1usize..40,
        inputs in 1usize..40,
        outputs in 1usize..90,
        rectify: bool,
    ) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let rows = numbers(&mut random, count * inputs);
        let weight = numbers(&mut random, inputs * outputs);
        let bias = numbers(&mut random, outputs);
        let turned = transposed(&weight, outputs);
        let plain = product(&transposed(&rows, inputs), &weight, [inputs, count, outputs]);
        let limited = |sum: f32| if rectify { sum.max(0.0) } else { sum };
        let expected: Vec<f32> =
            plain.iter().zip(bias.iter().cycle()).map(|(x, bias)| limited(x + bias)).collect();

        let rows = Rows::plain(&rows, inputs);
        let panels = Panels::new(Matrix::new(&weight, inputs, outputs));
        prop_assert_eq!(&products(rows, &panels, Some(&bias), rectify), &expected);
        let panels = Panels::new(Matrix::new(&turned, outputs, inputs).transposed());
        prop_assert_eq!(&products(rows, &panels, Some(&bias), rectify), &expected);
        let mut sums = bias.repeat(count);
        add_products(rows, &panels, rectify, &mut sums);
        prop_assert_eq!(&sums, &expected);
    }

    #[test]
    fn the_gradient_by_the_matrix_is_a_sum_of_outer_products(
        seed: u64,
        count in prop::sample::select(vec![1, 7, 300, 2100]),
        inputs in 1usize..40,
        outputs in 1usize..50,
    ) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let rows = numbers(&mut random, count * inputs);
        let gradient = numbers(&mut random, count * outputs);
        let expected = product(&rows, &gradient, [count, inputs, outputs]);
        prop_assert_eq!(matrix_gradient(Rows::plain(&rows, inputs), &gradient, outputs), expected);
    }

    #[test]
    fn missing_lists_count_as_zeros(seed: u64, inputs in 1usize..20, outputs in 1usize..20) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let lists = numbers(&mut random, 5 * inputs);
        let table: Vec<[u32; 3]> = (0..11)
            .map(|_| [(); 3].map(|()| random.random_range(0..6)))
            .map(|row: [u32; 3]| row.map(|list| if list == 5 { MISSING } else { list }))
            .collect();
        let list = |at: &u32| match *at {
            MISSING => vec![0.0; inputs],
            at => lists[at as usize * inputs..][..inputs].to_vec(),
        };
        let whole: Vec<f32> = table.as_flattened().iter().flat_map(list).collect();
        let weight = numbers(&mut random, 3 * inputs * outputs);
        let above = numbers(&mut random, 11 * outputs);
        let panels = Panels::new(Matrix::new(&weight, 3 * inputs, outputs));
        let (some, all) = (Rows::gathered(&lists, inputs, &table), Rows::plain(&whole, 3 * inputs));
        prop_assert_eq!(
            products(some, &panels, None, false),
            products(all, &panels, None, false)
        );
        prop_assert_eq!(matrix_gradient(some, &above, outputs), matrix_gradient(all, &above, outputs));
    }
}
