use proptest::prelude::*;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::*;

const SPACING: f32 = 0.1;

/// A body of irregularly placed particles of several materials.
fn body(random: &mut ChaCha8Rng, count: usize) -> (Vec<[f32; 2]>, Vec<Material>) {
    let side = SPACING * (count as f32).sqrt();
    let position =
        (0..count).map(|_| [(); 2].map(|()| random.random_range(-side..side / 2.0))).collect();
    let material = (0..count).map(|_| Material::ALL[random.random_range(1..4)]).collect();
    (position, material)
}

/// The shape of each particle in T frames, `[T R, 5]`.
fn shape_of_all(rest: &RestShape, position: &[[f32; 2]]) -> Vec<f32> {
    let frames = position.chunks(rest.len());
    let frame = |position: &[[f32; 2]]| -> Vec<f32> {
        (0..rest.len()).flat_map(|particle| rest.shape_of(particle, position)).collect()
    };
    frames.flat_map(frame).collect()
}

/// A neighbour: its row, its coefficient, its weight, and its relative rest position.
type Neighbour = (usize, [f64; 2], f64, [f64; 2]);

/// Neighbours of each particle, from all pairs.
fn links(position: &[[f32; 2]], material: &[Material]) -> Vec<Vec<Neighbour>> {
    let range = 2.1 * f64::from(SPACING);
    let of = |i: usize| {
        let apart =
            |j: usize| [0, 1].map(|k| f64::from(position[j][k]) - f64::from(position[i][k]));
        let squared = |j: usize| apart(j).iter().map(|d| d * d).sum::<f64>();
        let mut near: Vec<_> = (0..position.len())
            .filter(|&j| j != i && material[j] == material[i] && squared(j) < range * range)
            .collect();
        near.sort_by(|&a, &b| squared(a).total_cmp(&squared(b)));
        near.truncate(12);
        let weight = |j: usize| (1.0 - squared(j) / range.powi(2)).powi(2);
        let sum = |a: usize, b: usize| {
            near.iter().map(|&j| weight(j) * apart(j)[a] * apart(j)[b]).sum::<f64>()
        };
        let (xx, xy, yy) = (sum(0, 0), sum(0, 1), sum(1, 1));
        let root = ((xx - yy).powi(2) + 4.0 * xy * xy).sqrt();
        let (small, large) = ((xx + yy - root) / 2.0, (xx + yy + root) / 2.0);
        if material[i] == Material::Snow || near.len() < 3 || small < 0.05 * large {
            return Vec::new();
        }
        let determinant = xx * yy - xy * xy;
        let solve =
            |[x, y]: [f64; 2]| [(yy * x - xy * y) / determinant, (xx * y - xy * x) / determinant];
        near.iter()
            .map(|&j| (j, solve(apart(j)).map(|c| weight(j) * c), weight(j), apart(j)))
            .collect()
    };
    (0..position.len()).map(of).collect()
}

/// Strain and bend of each particle, from their definitions.
fn shapes(links: &[Vec<Neighbour>], position: &[[f64; 2]]) -> Vec<f64> {
    let of = |(i, links): (usize, &Vec<Neighbour>)| {
        if links.is_empty() {
            return [0.0; 5];
        }
        let apart = |j: usize, axis: usize| position[j][axis] - position[i][axis];
        let f = |row: usize, column: usize| {
            links.iter().map(|(j, c, ..)| apart(*j, row) * c[column]).sum::<f64>()
        };
        let b = |row: usize, column: usize| f(row, 0) * f(column, 0) + f(row, 1) * f(column, 1);
        let bend = |row: usize| {
            let left = |(j, _, k, x): &Neighbour| {
                k * (apart(*j, row) - f(row, 0) * x[0] - f(row, 1) * x[1])
            };
            let weights: f64 = links.iter().map(|link| link.2).sum();
            links.iter().map(left).sum::<f64>() / weights / f64::from(SPACING)
        };
        let strain = [b(0, 0) - 1.0, b(1, 1) - 1.0, b(0, 1)].map(|strain| 10.0 * strain);
        let [xx, yy, xy] = strain;
        [xx, yy, xy, 60.0 * bend(0), 60.0 * bend(1)].map(|number| number.clamp(-4.0, 4.0))
    };
    links.iter().enumerate().flat_map(of).collect()
}

/// The same links, shifted by a number of rows.
fn moved(mut links: Vec<Vec<Neighbour>>, rows: usize) -> Vec<Vec<Neighbour>> {
    links.iter_mut().flatten().for_each(|link| link.0 += rows);
    links
}

fn exact(position: &[[f32; 2]]) -> Vec<[f64; 2]> {
    position.iter().map(|x| x.map(f64::from)).collect()
}

proptest! {
    #[test]
    fn shapes_and_gradients_equal_those_from_all_pairs(seed: u64, count in 1usize..60) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        // Two windows, two frames of each.
        let (mut at_rest, mut material, mut plain) = (Vec::new(), Vec::new(), Vec::new());
        for window in 0..2 {
            let (position, of) = body(&mut random, count);
            plain.extend(moved(links(&position, &of), window * count));
            at_rest.extend(position);
            material.extend(of);
        }
        let rest = RestShape::new(&at_rest, &material, 2, SPACING);
        plain.extend(moved(plain.clone(), 2 * count));

        // The rest shape itself is not strained.
        prop_assert!(shape_of_all(&rest, &at_rest).iter().all(|shape| shape.abs() < 1e-3));

        let mut jolt = |x: f32| 1.05 * x + random.random_range(-0.003..0.003);
        let now: Vec<[f32; 2]> = at_rest.repeat(2).iter().map(|x| x.map(&mut jolt)).collect();
        let expected = shapes(&plain, &exact(&now));
        prop_assume!(expected.iter().all(|shape| shape.abs() == 4.0 || shape.abs() < 4.0 - 1e-3));
        let found = shape_of_all(&rest, &now);
        for (found, expected) in found.iter().zip(&expected) {
            prop_assert!((f64::from(*found) - expected).abs() < 1e-3, "{found}, {expected}");
        }

        let above: Vec<f32> = found.iter().map(|_| random.random_range(-1.0..1.0)).collect();
        let gradient = rest.backward(&now, &above);
        let step = 1e-7;
        for number in (0..gradient.len()).step_by(1 + gradient.len() / 9) {
            let sum = |side: f64| {
                let mut moved = exact(&now);
                moved[number / 2][number % 2] += side * step;
                let shape = shapes(&plain, &moved);
                shape.iter().zip(&above).map(|(s, above)| s * f64::from(*above)).sum::<f64>()
            };
            let expected = (sum(1.0) - sum(-1.0)) / (2.0 * step);
            let found = f64::from(gradient[number]);
            prop_assert!((found - expected).abs() < 1e-3 * (1.0 + expected.abs()), "{found}, {expected}");
        }
    }
}

/// A square of jelly.
fn square(side: usize) -> Vec<[f32; 2]> {
    (0..side * side).map(|n| [n % side, n / side].map(|n| SPACING * n as f32)).collect()
}

#[test]
fn a_stretched_and_rotated_square_is_strained_by_its_stretch() {
    let at_rest = square(7);
    let rest = RestShape::new(&at_rest, &[Material::Jelly; 49], 1, SPACING);
    let (sin, cos) = 0.4f32.sin_cos();
    let stretched = at_rest.iter().map(|[x, y]| [1.1 * (cos * x - sin * y), sin * x + cos * y]);
    let shape = shape_of_all(&rest, &stretched.collect::<Vec<_>>());
    for [xx, yy, rest @ ..] in shape.as_chunks::<5>().0 {
        assert!((xx - 2.1).abs() < 1e-3 && yy.abs() < 1e-3, "{xx} {yy}");
        assert!(rest.iter().all(|number| number.abs() < 1e-3), "{rest:?}");
    }
}

#[test]
fn rows_out_of_line_are_bent_but_not_strained() {
    let at_rest = square(9);
    let rest = RestShape::new(&at_rest, &[Material::Rope; 81], 1, SPACING);
    let odd = |n: usize| if n % 9 % 2 == 1 { 0.01 * SPACING } else { -0.01 * SPACING };
    let zigzag: Vec<_> = at_rest.iter().enumerate().map(|(n, [x, y])| [*x, y + odd(n)]).collect();
    let [xx, yy, xy, along, across] = rest.shape_of(40, &zigzag);
    assert!([xx, yy, xy, along].iter().all(|number| number.abs() < 1e-3));
    assert!(across > 0.3, "{across}");
}

#[test]
fn positions_far_out_or_in_one_point_or_nan_have_no_links() {
    for x in [f32::NAN, f32::INFINITY, 1e30, -1e30, 0.3] {
        let position = vec![[x, 0.3]; 100_000];
        let rest = RestShape::new(&position, &vec![Material::Rope; position.len()], 1, SPACING);
        assert!(rest.links.is_empty(), "{x}");
        assert_eq!(shape_of_all(&rest, &position), vec![0.0; 500_000]);
    }
    assert!(RestShape::new(&square(4), &[Material::Jelly; 16], 1, 0.0).links.is_empty());
}

#[test]
fn shapes_in_another_order_belong_to_the_same_particles() {
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let (at_rest, material) = body(&mut random, 60);
    let now: Vec<_> = at_rest.iter().map(|[x, y]| [1.05 * x + 0.1 * y, *y]).collect();
    let order: Vec<u32> = (0..60).map(|row| row * 7 % 60).collect();
    let rest = RestShape::new(&at_rest, &material, 1, SPACING);
    let there: Vec<_> = order.iter().map(|&row| now[row as usize]).collect();
    let (here, moved) = (shape_of_all(&rest, &now), shape_of_all(&rest.permuted(&order), &there));
    for (shape, &row) in moved.as_chunks::<SHAPE_FEATURES>().0.iter().zip(&order) {
        let first = row as usize * SHAPE_FEATURES;
        assert_eq!(shape[..], here[first..first + SHAPE_FEATURES]);
    }
    assert!(here.iter().any(|number| *number != 0.0));
}
