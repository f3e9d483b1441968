//! How far apart neighbouring particles are.

/// The median over all points of the distance to the nearest other one (domain lengths); infinite for
/// fewer than two.
pub fn spacing(points: &[[f32; 2]]) -> f32 {
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]));
    median((0..sorted.len()).map(|at| nearest(&sorted, at)).collect())
}

/// The median of distances, the upper one of two in the middle; infinite for none.
pub fn median(mut distances: Vec<f32>) -> f32 {
    distances.sort_by(f32::total_cmp);
    distances.get(distances.len() / 2).copied().unwrap_or(f32::INFINITY)
}

/// Looks left and right of a point until even the horizontal distance is too long.
fn nearest(sorted: &[[f32; 2]], at: usize) -> f32 {
    let [x, y] = sorted[at];
    let mut nearest = f32::INFINITY;
    for &[u, v] in sorted[..at].iter().rev() {
        if x - u >= nearest {
            break;
        }
        nearest = nearest.min((u - x).hypot(v - y));
    }
    for &[u, v] in &sorted[at + 1..] {
        if u - x >= nearest {
            break;
        }
        nearest = nearest.min((u - x).hypot(v - y));
    }
    nearest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_spacing_of_a_lattice_is_its_own() {
        let lattice: Vec<_> = (0..60).map(|k| [(k % 9) as f32 * 0.25, (k / 9) as f32]).collect();
        assert_eq!(spacing(&lattice), 0.25);
        assert_eq!(spacing(&[[0.5; 2]]), f32::INFINITY);
        assert_eq!(spacing(&[]), f32::INFINITY);
        assert_eq!(median(vec![0.3, 0.1, 0.2]), 0.2);
    }
}
