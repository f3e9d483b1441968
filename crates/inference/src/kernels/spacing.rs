//! The distance between neighbouring particles.

/// Largest number of points whose nearest neighbour is searched: enough for the median, and the time stays linear in the
/// number of points, wherever they are.
const MAX_SAMPLES: usize = 1000;

/// The median of the distance to the nearest other point (domain lengths), over at most 1,000 evenly chosen points;
/// infinite for fewer than two points.
pub fn spacing(points: &[[f32; 2]]) -> f32 {
    let extent = |axis: usize| {
        let along = points.iter().map(|point| point[axis]);
        along.clone().fold(f32::NEG_INFINITY, f32::max) - along.fold(f32::INFINITY, f32::min)
    };
    // Sorted along the longer axis: points in a column would all be close along the other one.
    let long = usize::from(extent(1) > extent(0));
    let mut sorted: Vec<[f32; 2]> = points.iter().map(|x| [x[long], x[1 - long]]).collect();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let samples = sorted.len().min(MAX_SAMPLES);
    let at = |sample: usize| sample * sorted.len() / samples;
    median((0..samples).map(|sample| nearest(&sorted, at(sample))).collect())
}

/// The median of distances (the upper median of an even number); infinite for an empty list.
pub fn median(mut distances: Vec<f32>) -> f32 {
    distances.sort_by(f32::total_cmp);
    distances.get(distances.len() / 2).copied().unwrap_or(f32::INFINITY)
}

/// Searches before and after a point in the sorted list until the distance along the sorted axis alone is too large.
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
    fn the_spacing_of_a_lattice_is_its_lattice_constant() {
        let lattice: Vec<_> = (0..60).map(|k| [(k % 9) as f32 * 0.25, (k / 9) as f32]).collect();
        assert_eq!(spacing(&lattice), 0.25);
        assert_eq!(spacing(&[[0.5; 2]]), f32::INFINITY);
        assert_eq!(spacing(&[]), f32::INFINITY);
        assert_eq!(median(vec![0.3, 0.1, 0.2]), 0.2);
    }

    #[test]
    fn a_million_points_in_a_column_are_as_fast_as_in_a_row() {
        // All pairs of points would be 10^12.
        let line = (0..1_000_000u32).map(|k| (k % 1024) as f32 * 4.0 + (k / 1024) as f32 / 256.0);
        let upright: Vec<_> = line.map(|y| [0.5, y]).collect();
        let flat: Vec<_> = upright.iter().map(|&[x, y]| [y, x]).collect();
        assert_eq!([spacing(&upright), spacing(&flat)], [1.0 / 256.0; 2]);
    }

    #[test]
    fn coincident_points_have_a_spacing_of_zero() {
        assert_eq!(spacing(&[[0.25, 0.75]; 100_000]), 0.0);
    }
}
