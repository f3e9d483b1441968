//! The area that particles occupy.

use eddy_frames::Domain;

/// Pixels per spacing.
const PIXELS: f32 = 2.0;
/// Maximum number of pixels: for larger domains they are wider.
const MAX_PIXELS: f32 = (1 << 26) as f32;
/// Maximum number of pixels along an axis.
const MAX_SIDE: f32 = (1 << 22) as f32;

/// Area within one spacing of any of the particles (domain lengths^2), inside the domain. Zero without a valid
/// spacing.
///
/// Neighbours at rest are a spacing apart, so a body is filled even where its particles are in disorder, and its area
/// follows its outline.
pub(super) fn occupied<'a>(
    position: impl Iterator<Item = &'a [f32; 2]>,
    domain: Domain,
    spacing: f32,
) -> f64 {
    let mut position = position.peekable();
    if position.peek().is_none() || !(spacing > 0.0 && spacing.is_finite()) {
        return 0.0;
    }
    let sides = [0, 1].map(|axis| domain.upper[axis] - domain.lower[axis]);
    let min_pixel =
        (sides[0].max(sides[1]) / MAX_SIDE).max((sides[0] * sides[1] / MAX_PIXELS).sqrt());
    let pixel = (spacing / PIXELS).max(min_pixel);
    let extent = sides.map(|side| (side / pixel).ceil() as usize);
    let radius = spacing / pixel;
    let mut painted = vec![false; extent[0] * extent[1]];
    for position in position {
        let centre = [0, 1].map(|axis| (position[axis] - domain.lower[axis]) / pixel);
        let range = |axis: usize| {
            let first = (centre[axis] - radius).floor().max(0.0) as usize;
            first..((centre[axis] + radius).ceil().max(0.0) as usize).min(extent[axis])
        };
        for column in range(0) {
            for row in range(1) {
                let [dx, dy] = [column as f32 + 0.5 - centre[0], row as f32 + 0.5 - centre[1]];
                if dx * dx + dy * dy <= radius * radius {
                    painted[column * extent[1] + row] = true;
                }
            }
        }
    }
    let pixels = painted.iter().filter(|&&is| is).count();
    pixels as f64 * f64::from(pixel) * f64::from(pixel)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPACING: f32 = 1.0 / 128.0;

    fn block(columns: usize, rows: usize, squeeze: f32) -> f64 {
        let points: Vec<[f32; 2]> = (0..columns * rows)
            .map(|k| [(k % columns) as f32 * SPACING * squeeze, (k / columns) as f32 * SPACING])
            .map(|[x, y]| [0.1 + x, 0.1 + y])
            .collect();
        occupied(points.iter(), Domain::UNIT, SPACING)
    }

    #[test]
    fn a_block_occupies_its_area_and_a_rim() {
        let [width, height] = [41.0, 31.0f64];
        let expected = width * height * f64::from(SPACING * SPACING);
        let found = block(40, 30, 1.0);
        assert!((found / expected - 1.0).abs() < 0.03, "{found}, {expected}");
    }

    #[test]
    fn a_block_squeezed_to_four_fifths_lost_a_fifth() {
        let ratio = block(60, 60, 0.8) / block(60, 60, 1.0);
        assert!((ratio - 0.8).abs() < 0.015, "{ratio}");
    }

    #[test]
    fn particles_outside_occupy_nothing() {
        let far = [[-5.0, 0.5], [f32::NAN, 0.5], [f32::MAX, f32::MAX]];
        assert_eq!(occupied(far.iter(), Domain::UNIT, SPACING), 0.0);
    }

    #[test]
    fn a_tiny_spacing_does_not_exceed_the_maximum_number_of_pixels() {
        let one = [[0.5; 2]];
        for spacing in [0.0, f32::MIN_POSITIVE, f32::INFINITY, f32::NAN] {
            assert!(occupied(one.iter(), Domain::UNIT, spacing) < 1e-6, "{spacing}");
        }
    }
}
