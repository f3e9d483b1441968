//! The distance between neighbouring particles.

use eddy_frames::distance;

/// Largest number of points whose nearest neighbour is searched: enough for the median, and the time stays linear in the
/// number of points, wherever they are.
const MAX_SAMPLES: usize = 1000;

/// The median of the distance to the nearest other point (domain lengths), over at most 1,000 evenly chosen points;
/// infinite for fewer than two points.
pub fn spacing<const D: usize>(points: &[[f32; D]]) -> f32 {
    let extent = |axis: usize| {
        let along = points.iter().map(|point| point[axis]);
        along.clone().fold(f32::NEG_INFINITY, f32::max) - along.fold(f32::INFINITY, f32::min)
    };
    // Sorted along the longest axis: points in a column would all be close along the others.
    let long = (1..D).fold(0, |long, axis| if extent(axis) > extent(long) { axis } else { long });
    let mut sorted = points.to_vec();
    sorted.iter_mut().for_each(|point| point.swap(0, long));
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
fn nearest<const D: usize>(sorted: &[[f32; D]], at: usize) -> f32 {
    let point = sorted[at];
    let mut nearest = f32::INFINITY;
    for &other in sorted[..at].iter().rev() {
        if point[0] - other[0] >= nearest {
            break;
        }
        nearest = nearest.min(distance(other, point));
    }
    for &other in &sorted[at + 1..] {
        if other[0] - point[0] >= nearest {
            break;
        }
        nearest = nearest.min(distance(other, point));
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
        assert_eq!(spacing::<2>(&[]), f32::INFINITY);
        let place =
            |k: usize| [0.5 * (k % 3) as f32, 0.75 * (k / 3 % 4) as f32, 0.625 * (k / 12) as f32];
        assert_eq!(spacing(&(0..120).map(place).collect::<Vec<_>>()), 0.5, "longest along z");
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
