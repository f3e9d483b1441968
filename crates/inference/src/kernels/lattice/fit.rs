//! The least-squares fit of a body's nodes to its particles.

use super::{Node, Share};

/// Smallest pivot of the normal equations, relative to the diagonal: what particles do not determine stays small.
const SMALLEST_PIVOT: f64 = 1e-6;

/// The normal equations of the least-squares fit of a body's nodes to its particles, as their Cholesky factor.
#[derive(Clone, Debug, PartialEq)]
pub struct Band {
    /// Number of nodes, n.
    count: usize,
    /// Numbers before the diagonal that may differ from zero, k.
    width: usize,
    /// The rows of the factor up to the diagonal, whose reciprocal is stored, `[n, k + 1]`.
    factor: Vec<f32>,
}

impl Band {
    /// Of a body's `count` nodes, whose particles have these shape functions.
    pub(super) fn new(count: usize, corners: &[[Share; 4]]) -> Self {
        let local = |share: &Share| share.index as usize;
        let pairs = || {
            corners.iter().flat_map(|corners| {
                corners.iter().flat_map(move |a| corners.iter().map(move |b| (a, b)))
            })
        };
        let distance = |(a, b): (&Share, &Share)| local(a).saturating_sub(local(b));
        let width = pairs().map(distance).max().unwrap_or(0);
        let mut factor = vec![0.0f64; count * (width + 1)];
        let at = |row: usize, column: usize| row * (width + 1) + width + column - row;
        for (a, b) in pairs().filter(|(a, b)| local(a) >= local(b)) {
            factor[at(local(a), local(b))] += f64::from(a.weight) * f64::from(b.weight);
        }
        for row in 0..count {
            let begin = row.saturating_sub(width);
            let least = SMALLEST_PIVOT * factor[at(row, row)];
            for column in begin..=row {
                let from = begin.max(column.saturating_sub(width));
                let products: f64 =
                    (from..column).map(|k| factor[at(row, k)] * factor[at(column, k)]).sum();
                let rest = factor[at(row, column)] - products;
                factor[at(row, column)] = match column == row {
                    true => 1.0 / rest.max(least).max(f64::MIN_POSITIVE).sqrt(),
                    false => rest * factor[at(column, column)],
                };
            }
        }
        let factor = factor.into_iter().map(|number| number as f32).collect();
        Self { count, width, factor }
    }

    /// Solves for the nodes, in place.
    pub(super) fn solve(&self, nodes: &mut [Node]) {
        let Self { count, width, .. } = *self;
        let row_of = |row: usize| &self.factor[row * (width + 1)..(row + 1) * (width + 1)];
        for row in 0..count {
            let numbers = row_of(row);
            let begin = row.saturating_sub(width);
            let (before, own) = nodes.split_at_mut(row);
            for (other, number) in before[begin..].iter().zip(&numbers[width + begin - row..]) {
                own[0].add(-number, other);
            }
            own[0].scale(numbers[width]);
        }
        for row in (0..count).rev() {
            let numbers = row_of(row);
            let begin = row.saturating_sub(width);
            let (before, own) = nodes.split_at_mut(row);
            own[0].scale(numbers[width]);
            for (other, number) in before[begin..].iter_mut().zip(&numbers[width + begin - row..]) {
                other.add(-number, &own[0]);
            }
        }
    }

    /// The inverse of the normal equations' matrix, `[n, n]`, which is symmetric (1 / number of particles).
    pub fn inverse(&self) -> Vec<f32> {
        let unit = |row: usize| {
            let mut nodes = vec![Node::default(); self.count];
            nodes[row].position[0] = 1.0;
            self.solve(&mut nodes);
            nodes.into_iter().map(|node| node.position[0])
        };
        (0..self.count).flat_map(unit).collect()
    }
}
