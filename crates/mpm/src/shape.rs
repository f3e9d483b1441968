//! Outlines of bodies, and lattices of particles that fill them.

use serde::{Deserialize, Serialize};

use eddy_frames::plane;

/// The outline of a body, relative to its position.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Shape {
    /// A disc.
    Disc {
        /// Radius (domain lengths).
        radius: f32,
    },
    /// A rectangle centred at the body's position.
    Rectangle {
        /// Width and height (domain lengths).
        #[serde(deserialize_with = "plane::pair")]
        size: [f32; 2],
    },
    /// A polygon without holes.
    Polygon {
        /// Corners in order, relative to the body's position (domain lengths).
        #[serde(deserialize_with = "plane::pairs")]
        corners: Vec<[f32; 2]>,
    },
    /// A band along a polyline, such as a rope.
    Strip {
        /// Points of the polyline in order, relative to the body's position (domain lengths).
        #[serde(deserialize_with = "plane::pairs")]
        path: Vec<[f32; 2]>,
        /// Width of the band (domain lengths); its ends are round.
        thickness: f32,
    },
}

impl Shape {
    /// The first invalid number, as field, found and expected.
    pub(super) fn invalid(&self) -> Option<(&'static str, String, &'static str)> {
        let length = |field, found: f32| {
            let fine = found > 0.0 && found.is_finite();
            (!fine).then(|| (field, found.to_string(), "a positive number"))
        };
        let points = |field, found: &[[f32; 2]], least: usize, expected| {
            let fine = found.len() >= least && found.as_flattened().iter().all(|x| x.is_finite());
            (!fine).then(|| (field, format!("{found:?}"), expected))
        };
        match self {
            Self::Disc { radius } => length("shape.disc.radius", *radius),
            Self::Rectangle { size } => {
                size.iter().find_map(|&side| length("shape.rectangle.size", side))
            }
            Self::Polygon { corners } => {
                points("shape.polygon.corners", corners, 3, "at least three finite points")
            }
            Self::Strip { path, thickness } => {
                let expected = "at least two finite points";
                points("shape.strip.path", path, 2, expected)
                    .or_else(|| length("shape.strip.thickness", *thickness))
            }
        }
    }

    /// Corners of the bounding box (domain lengths), lower first.
    fn bounds(&self) -> [[f64; 2]; 2] {
        let around = |points: &[[f32; 2]], margin: f64| {
            let axis = |k: usize| points.iter().map(move |point| f64::from(point[k]));
            let lower = |k| axis(k).fold(f64::INFINITY, f64::min) - margin;
            let upper = |k| axis(k).fold(f64::NEG_INFINITY, f64::max) + margin;
            [[lower(0), lower(1)], [upper(0), upper(1)]]
        };
        match self {
            Self::Disc { radius } => around(&[[0.0; 2]], f64::from(*radius)),
            Self::Rectangle { size: [width, height] } => {
                let (x, y) = (0.5 * width, 0.5 * height);
                around(&[[-x, -y], [x, y]], 0.0)
            }
            Self::Polygon { corners } => around(corners, 0.0),
            Self::Strip { path, thickness } => around(path, 0.5 * f64::from(*thickness)),
        }
    }

    /// Whether it contains a point.
    pub(super) fn contains(&self, point: [f64; 2]) -> bool {
        match self {
            Self::Disc { radius } => point[0].hypot(point[1]) <= f64::from(*radius),
            Self::Rectangle { size } => (0..2).all(|k| 2.0 * point[k].abs() < f64::from(size[k])),
            Self::Polygon { corners } => {
                // A ray to the right crosses the outline an odd number of times.
                let crossings = edges(corners.iter().chain(corners.first()))
                    .filter(|[a, b]| (a[1] > point[1]) != (b[1] > point[1]))
                    .filter(|[a, b]| {
                        let along = (point[1] - a[1]) / (b[1] - a[1]);
                        point[0] < a[0] + along * (b[0] - a[0])
                    });
                crossings.count() % 2 == 1
            }
            Self::Strip { path, thickness } => {
                edges(path.iter()).any(|edge| distance(point, edge) <= 0.5 * f64::from(*thickness))
            }
        }
    }

    /// Approximate number of particles that fill it, `spacing` apart, without creating them.
    pub(super) fn estimate(&self, spacing: f32) -> f64 {
        let [lower, upper] = self.bounds();
        let filled = match self {
            Self::Disc { .. } => std::f64::consts::FRAC_PI_4,
            _ => 1.0,
        };
        let spacing = f64::from(spacing);
        filled * (0..2).map(|k| ((upper[k] - lower[k]) / spacing).round().max(1.0)).product::<f64>()
    }

    /// The particles that fill it: points of a square lattice centred in the bounding box, for a disc from the centre
    /// outwards, otherwise column by column.
    pub(super) fn lattice(&self, spacing: f32) -> Vec<[f32; 2]> {
        let [lower, upper] = self.bounds();
        let spacing = f64::from(spacing);
        let axis = |k: usize| {
            let count = ((upper[k] - lower[k]) / spacing).round().max(1.0) as usize;
            let first = 0.5 * (lower[k] + upper[k] - (count as f64 - 1.0) * spacing);
            (0..count).map(move |n| first + n as f64 * spacing)
        };
        let mut points: Vec<[f64; 2]> =
            axis(0).flat_map(|x| axis(1).map(move |y| [x, y])).collect();
        points.retain(|&point| self.contains(point));
        if matches!(self, Self::Disc { .. }) {
            points.sort_by(|a, b| a[0].hypot(a[1]).total_cmp(&b[0].hypot(b[1])));
        }
        points.into_iter().map(|point| point.map(|x| x as f32)).collect()
    }
}

/// Segments between successive points.
fn edges<'a>(
    points: impl Iterator<Item = &'a [f32; 2]> + Clone,
) -> impl Iterator<Item = [[f64; 2]; 2]> {
    let double = |point: &[f32; 2]| point.map(f64::from);
    points.clone().zip(points.skip(1)).map(move |(a, b)| [double(a), double(b)])
}

/// Distance of a point from a segment.
fn distance([x, y]: [f64; 2], [a, b]: [[f64; 2]; 2]) -> f64 {
    let [u, v] = [b[0] - a[0], b[1] - a[1]];
    let squared = u * u + v * v;
    let along = if squared > 0.0 { ((x - a[0]) * u + (y - a[1]) * v) / squared } else { 0.0 };
    let along = along.clamp(0.0, 1.0);
    (x - a[0] - along * u).hypot(y - a[1] - along * v)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPACING: f32 = 1.0 / 128.0;

    /// Area represented by the particles (domain lengths^2).
    fn area(shape: &Shape) -> f32 {
        shape.lattice(SPACING).len() as f32 * SPACING * SPACING
    }

    fn shapes() -> [(Shape, f32); 4] {
        let corners = vec![[-0.2, -0.1], [0.2, -0.1], [0.0, 0.0], [0.0, 0.2]];
        let path = vec![[-0.2, 0.0], [0.1, 0.0], [0.1, 0.3]];
        let round_ends = std::f32::consts::PI * 0.02 * 0.02;
        [
            (Shape::Disc { radius: 0.2 }, std::f32::consts::PI * 0.04),
            (Shape::Rectangle { size: [0.3, 0.1] }, 0.03),
            // The shoelace formula.
            (Shape::Polygon { corners }, 0.04),
            // The inner half of the bend is counted twice, the outer quarter is round.
            (Shape::Strip { path, thickness: 0.04 }, 0.6 * 0.04 + round_ends - 0.0001),
        ]
    }

    #[test]
    fn particles_represent_the_area_of_their_shape() {
        for (shape, expected) in shapes() {
            let found = area(&shape);
            assert!((found / expected - 1.0).abs() < 0.03, "{shape:?}: {found}, {expected}");
        }
    }

    #[test]
    fn no_shape_has_many_more_particles_than_estimated() {
        for (shape, _) in shapes() {
            let (found, estimate) = (shape.lattice(SPACING).len(), shape.estimate(SPACING));
            assert!(found as f64 <= 1.02 * estimate, "{shape:?}: {found}, {estimate}");
        }
    }

    #[test]
    fn a_rectangle_of_whole_spacings_is_filled_exactly() {
        let shape = Shape::Rectangle { size: [3.0 * SPACING, 2.0 * SPACING] };
        let points = shape.lattice(SPACING);
        assert_eq!(points.len(), 6);
        assert_eq!(points[0], [-SPACING, -0.5 * SPACING]);
        assert_eq!(points[5], [SPACING, 0.5 * SPACING]);
    }

    #[test]
    fn invalid_lengths_are_found() {
        let invalid = |shape: Shape| shape.invalid().map(|(field, found, _)| (field, found));
        assert_eq!(
            invalid(Shape::Disc { radius: -1.0 }),
            Some(("shape.disc.radius", "-1".to_owned()))
        );
        let size = [0.1, f32::NAN];
        assert_eq!(
            invalid(Shape::Rectangle { size }),
            Some(("shape.rectangle.size", "NaN".to_owned()))
        );
        let line = Shape::Polygon { corners: vec![[0.0, 0.0], [0.1, 0.0]] };
        assert_eq!(invalid(line).unwrap().0, "shape.polygon.corners");
        let (path, thickness) = (vec![[0.0; 2], [0.1; 2]], 0.0);
        assert_eq!(invalid(Shape::Strip { path, thickness }).unwrap().0, "shape.strip.thickness");
        assert!(shapes().iter().all(|(shape, _)| shape.invalid().is_none()));
    }
}
