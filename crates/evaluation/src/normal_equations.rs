//! The normal equations of least squares.

/// Solves A x = b for symmetric A, `[N, N]`, and each of K right-hand sides b, `[N]`, by Gaussian elimination with the largest
/// pivot of each column. `None` if A is singular.
pub(super) fn solve<const N: usize, const K: usize>(
    mut a: [[f64; N]; N],
    mut b: [[f64; N]; K],
) -> Option<[[f64; N]; K]> {
    let largest = a.as_flattened().iter().fold(0.0, |most: f64, x| most.max(x.abs()));
    for column in 0..N {
        let pivot =
            (column..N).max_by(|&p, &q| a[p][column].abs().total_cmp(&a[q][column].abs()))?;
        if a[pivot][column].abs() <= 1e-12 * largest {
            return None;
        }
        a.swap(column, pivot);
        b.iter_mut().for_each(|side| side.swap(column, pivot));
        let known = a[column];
        for row in (0..N).filter(|&row| row != column) {
            let factor = a[row][column] / known[column];
            a[row].iter_mut().zip(known).for_each(|(x, known)| *x -= factor * known);
            b.iter_mut().for_each(|side| side[row] -= factor * side[column]);
        }
    }
    Some(b.map(|side| std::array::from_fn(|row| side[row] / a[row][row])))
}

#[cfg(test)]
mod tests {
    use super::solve;

    #[test]
    fn every_right_hand_side_is_solved_and_a_singular_matrix_is_not() {
        // The first pivot is zero.
        let a = [[0.0, 2.0, 1.0], [2.0, 1.0, 0.0], [1.0, 0.0, 3.0]];
        let product = |x: [f64; 3]| a.map(|row| row.iter().zip(x).map(|(a, x)| a * x).sum());
        let [x, y] = [[1.0, -2.0, 0.5], [0.0, 3.0, 1.0]];
        let found = solve(a, [product(x), product(y)]).unwrap();
        for (found, expected) in found.as_flattened().iter().zip([x, y].as_flattened()) {
            assert!((found - expected).abs() < 1e-12, "{found}: {expected}");
        }
        assert_eq!(solve([[1.0, 2.0], [2.0, 4.0]], [[1.0, 1.0]]), None);
    }
}
