//! Outlines of tools: half-planes, discs and convex polygons.

use serde::{Deserialize, Serialize};

use super::Pose;
use crate::plane;

/// The outline of a tool, relative to its position.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Outline {
    /// All below a line through the position, which is horizontal at an angle of 0.
    HalfPlane,
    /// A disc around the position.
    Disc {
        /// Radius (domain lengths).
        radius: f32,
    },
    /// A rectangle centred at the position.
    Rectangle {
        /// Width and height (domain lengths).
        #[serde(deserialize_with = "plane::pair")]
        size: [f32; 2],
    },
    /// Convex polygons that move together, such as the walls of a cup.
    Polygons {
        /// Corners of each in order, relative to the position (domain lengths).
        #[serde(deserialize_with = "plane::lists")]
        corners: Vec<Vec<[f32; 2]>>,
    },
}

/// The largest length of an outline (domain lengths): the square of a larger one could be too large for its number.
const LONGEST: f32 = 1e4;

/// A convex part of an outline.
#[derive(Clone, Debug, PartialEq)]
pub enum Part {
    /// A disc.
    Disc {
        /// Its centre.
        centre: [f32; 2],
        /// Its radius.
        radius: f32,
    },
    /// What lies behind all of these edges.
    Convex {
        /// The edges.
        edges: Vec<Edge>,
        /// The corners between them; none of a half-plane.
        corners: Vec<[f32; 2]>,
    },
}

/// A straight edge: matter is where `normal x > offset`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Edge {
    /// Points outwards, of length 1.
    pub normal: [f32; 2],
    /// Distance of the edge from the origin.
    pub offset: f32,
}

impl Edge {
    /// Distance of a point in front of it; negative behind it.
    #[inline]
    pub fn distance(&self, [x, y]: [f32; 2]) -> f32 {
        self.normal[0] * x + self.normal[1] * y - self.offset
    }

    /// From one point to another, outwards to the right.
    fn between(from: [f32; 2], to: [f32; 2]) -> Self {
        let [x, y] = [to[0] - from[0], to[1] - from[1]];
        let length = (x * x + y * y).sqrt();
        let normal = [y / length, (0.0 - x) / length];
        Self { normal, offset: normal[0] * from[0] + normal[1] * from[1] }
    }
}

impl Outline {
    /// The first invalid number or polygon, as field, found and expected.
    pub fn invalid(&self) -> Option<(String, String, &'static str)> {
        let length = |field: &str, found: f32| {
            let fine = found > 0.0 && found <= LONGEST;
            (!fine).then(|| (field.to_owned(), found.to_string(), "a positive number up to 1e4"))
        };
        match self {
            Self::HalfPlane => None,
            Self::Disc { radius } => length("disc.radius", *radius),
            Self::Rectangle { size } => {
                size.iter().find_map(|&side| length("rectangle.size", side))
            }
            Self::Polygons { corners } if corners.is_empty() => {
                Some(("polygons.corners".into(), "none".into(), "at least one polygon"))
            }
            Self::Polygons { corners } => {
                corners.iter().enumerate().find_map(|(index, corners)| {
                    let (found, expected) = fault(corners)?;
                    Some((format!("polygons.corners[{index}]"), found, expected))
                })
            }
        }
    }

    /// Its convex parts.
    pub fn parts(&self) -> Vec<Part> {
        let convex = |corners: &[[f32; 2]]| {
            let mut corners = corners.to_vec();
            if area(&corners) < 0.0 {
                corners.reverse();
            }
            let next = corners.iter().cycle().skip(1);
            let edges =
                corners.iter().zip(next).map(|(&from, &to)| Edge::between(from, to)).collect();
            Part::Convex { edges, corners }
        };
        match self {
            Self::HalfPlane => {
                let edges = vec![Edge { normal: [0.0, 1.0], offset: 0.0 }];
                vec![Part::Convex { edges, corners: Vec::new() }]
            }
            Self::Disc { radius } => vec![Part::Disc { centre: [0.0; 2], radius: *radius }],
            Self::Rectangle { size: [width, height] } => {
                let (x, y) = (0.5 * width, 0.5 * height);
                vec![convex(&[[-x, -y], [x, -y], [x, y], [-x, y]])]
            }
            Self::Polygons { corners } => corners.iter().map(|corners| convex(corners)).collect(),
        }
    }

    /// Its parts where it is.
    pub fn posed(&self, pose: Pose) -> Vec<Part> {
        let direction = pose.direction();
        self.parts().iter().map(|part| part.posed(pose, direction)).collect()
    }

    /// Whether it has a point in common with another one.
    pub fn overlaps(&self, pose: Pose, other: &Self, other_pose: Pose) -> bool {
        let others = other.posed(other_pose);
        self.posed(pose).iter().any(|part| others.iter().any(|other| part.overlaps(other)))
    }

    /// Distance of its farthest point from its position (domain lengths); infinite for a half-plane.
    pub fn reach(&self) -> f32 {
        let length = |[x, y]: [f32; 2]| (x * x + y * y).sqrt();
        match self {
            Self::HalfPlane => f32::INFINITY,
            Self::Disc { radius } => *radius,
            Self::Rectangle { size } => 0.5 * length(*size),
            Self::Polygons { corners } => {
                corners.iter().flatten().map(|&corner| length(corner)).fold(0.0, f32::max)
            }
        }
    }
}

impl Part {
    /// The part of a tool that is there.
    pub fn posed(&self, pose: Pose, [cos, sin]: [f32; 2]) -> Self {
        let [x0, y0] = pose.position;
        let turned = |[x, y]: [f32; 2]| [cos * x - sin * y, sin * x + cos * y];
        let moved = |point: [f32; 2]| {
            let [x, y] = turned(point);
            [x0 + x, y0 + y]
        };
        let of_edge = |edge: &Edge| {
            let normal = turned(edge.normal);
            Edge { normal, offset: edge.offset + normal[0] * x0 + normal[1] * y0 }
        };
        match self {
            Self::Disc { centre, radius } => Self::Disc { centre: moved(*centre), radius: *radius },
            Self::Convex { edges, corners } => Self::Convex {
                edges: edges.iter().map(of_edge).collect(),
                corners: corners.iter().copied().map(moved).collect(),
            },
        }
    }

    /// Its mirror image about a vertical line with `sides` twice the x of its points.
    pub(super) fn mirrored(&self, sides: f32) -> Self {
        let mirror = |[x, y]: [f32; 2]| [sides - x, y];
        match self {
            Self::Disc { centre, radius } => {
                Self::Disc { centre: mirror(*centre), radius: *radius }
            }
            Self::Convex { edges, corners } => {
                let of_edge = |&Edge { normal: [u, v], offset }: &Edge| Edge {
                    normal: [-u, v],
                    offset: offset - u * sides,
                };
                // In the same sense around it.
                let corners = corners.iter().rev().copied().map(mirror).collect();
                Self::Convex { edges: edges.iter().map(of_edge).collect(), corners }
            }
        }
    }

    /// Distance of a point outside from its nearest point; negative inside.
    fn gap(&self, [x, y]: [f32; 2]) -> f32 {
        let Self::Convex { corners, .. } = self else { return self.distance([x, y]) };
        let depth = self.distance([x, y]);
        if depth < 0.0 || corners.is_empty() {
            return depth;
        }
        let next = corners.iter().cycle().skip(1);
        let from_side = |(a, b): (&[f32; 2], &[f32; 2])| {
            let [u, v] = [b[0] - a[0], b[1] - a[1]];
            let along = ((x - a[0]) * u + (y - a[1]) * v) / (u * u + v * v);
            let along = along.clamp(0.0, 1.0);
            (x - a[0] - along * u).hypot(y - a[1] - along * v)
        };
        corners.iter().zip(next).map(from_side).fold(f32::INFINITY, f32::min)
    }

    /// Whether it has a point in common with another one.
    fn overlaps(&self, other: &Self) -> bool {
        let separates = |edge: &Edge, other: &Self| match other {
            Self::Disc { .. } => false, // compared below
            // Of two half-planes only the edges are compared: they have points in common unless they face each other.
            Self::Convex { corners, edges } if corners.is_empty() => {
                let [x, y] = edges[0].normal;
                let faces = edge.normal[0] * x + edge.normal[1] * y <= -1.0 + 1e-6;
                faces && edge.offset + edges[0].offset <= 0.0
            }
            Self::Convex { corners, .. } => {
                corners.iter().all(|&corner| edge.distance(corner) >= 0.0)
            }
        };
        match (self, other) {
            (Self::Disc { centre, radius }, other) => other.gap(*centre) < *radius,
            (part, Self::Disc { centre, radius }) => part.gap(*centre) < *radius,
            (Self::Convex { edges, .. }, Self::Convex { edges: others, .. }) => {
                !edges.iter().any(|edge| separates(edge, other))
                    && !others.iter().any(|edge| separates(edge, self))
            }
        }
    }

    /// Corners of the box around it, lower first; infinite for a half-plane.
    pub fn bounds(&self) -> [[f32; 2]; 2] {
        match self {
            Self::Disc { centre, radius } => {
                [centre.map(|x| x - radius), centre.map(|x| x + radius)]
            }
            Self::Convex { corners, .. } if corners.is_empty() => {
                [[f32::NEG_INFINITY; 2], [f32::INFINITY; 2]]
            }
            Self::Convex { corners, .. } => {
                let along = |axis: usize| corners.iter().map(move |corner| corner[axis]);
                let lower = |axis| along(axis).fold(f32::INFINITY, f32::min);
                let upper = |axis| along(axis).fold(f32::NEG_INFINITY, f32::max);
                [[lower(0), lower(1)], [upper(0), upper(1)]]
            }
        }
    }

    /// Distance of a point from it, negative inside; less beside a corner.
    #[inline]
    pub fn distance(&self, point: [f32; 2]) -> f32 {
        match self {
            Self::Disc { centre, radius } => {
                let [x, y] = [point[0] - centre[0], point[1] - centre[1]];
                (x * x + y * y).sqrt() - radius
            }
            Self::Convex { edges, .. } => {
                edges.iter().map(|edge| edge.distance(point)).fold(f32::NEG_INFINITY, f32::max)
            }
        }
    }

    /// The straight surface that is nearest to a point: an edge, or a disc's tangent.
    pub fn surface(&self, point: [f32; 2]) -> Edge {
        match self {
            Self::Disc { centre, radius } => {
                tangent(*centre, *radius, [point[0] - centre[0], point[1] - centre[1]])
            }
            Self::Convex { edges, .. } => {
                let mut nearest = (edges[0], edges[0].distance(point));
                for edge in &edges[1..] {
                    let distance = edge.distance(point);
                    if distance > nearest.1 {
                        nearest = (*edge, distance);
                    }
                }
                nearest.0
            }
        }
    }

    /// The surface that a point is straight in front of, and its distance; `None` inside and beside a corner.
    pub fn faced(&self, point: [f32; 2]) -> Option<(f32, Edge)> {
        let surface = self.surface(point);
        let distance = surface.distance(point);
        if distance < 0.0 {
            return None;
        }
        let foot = [0, 1].map(|k| point[k] - distance * surface.normal[k]);
        let is_on_it = match self {
            Self::Disc { .. } => true,
            Self::Convex { edges, .. } => {
                // The rounding of the foot.
                let most = 1e-6 * (1.0 + distance + foot[0].abs() + foot[1].abs());
                edges.iter().all(|edge| edge.distance(foot) <= most)
            }
        };
        is_on_it.then_some((distance, surface))
    }

    /// Where the way from one point to another enters it: the share of the way, 0 to 1, and the surface there. A way that begins
    /// inside enters at once, through the nearest surface.
    pub fn entered(&self, from: [f32; 2], to: [f32; 2]) -> Option<(f32, Edge)> {
        if self.distance(from) < 0.0 {
            return Some((0.0, self.surface(from)));
        }
        match self {
            Self::Disc { centre, radius } => disc_entered(*centre, *radius, from, to),
            Self::Convex { edges, .. } => edges_entered(edges, from, to),
        }
    }
}

/// Where a way that begins outside enters what lies behind all of these edges.
fn edges_entered(edges: &[Edge], from: [f32; 2], to: [f32; 2]) -> Option<(f32, Edge)> {
    // The length of the way, relative to its part in front of the last edge behind which it comes, and of the first that it leaves.
    let (mut least, mut most, mut surface) = (f32::INFINITY, 1.0, None);
    for edge in edges {
        let (before, after) = (edge.distance(from), edge.distance(to));
        let relative = 1.0 - after * (1.0 / before);
        match (before >= 0.0, after >= 0.0) {
            (true, true) => return None,
            (true, false) if relative <= least => (least, surface) = (relative, Some(*edge)),
            (false, true) => most = f32::max(most, relative),
            (true, false) | (false, false) => {}
        }
    }
    surface.filter(|_| least >= most).map(|surface| (1.0 / least, surface))
}

/// Where a way that begins outside enters a disc: |(x, y) + share (u, v)| = radius.
fn disc_entered(
    centre: [f32; 2],
    radius: f32,
    from: [f32; 2],
    to: [f32; 2],
) -> Option<(f32, Edge)> {
    let [x, y] = [from[0] - centre[0], from[1] - centre[1]];
    let [u, v] = [to[0] - from[0], to[1] - from[1]];
    let c = x * x + y * y - radius * radius;
    let (a, b) = (u * u + v * v, x * u + y * v);
    let square = b * b - a * c;
    let share = (0.0 - b - square.sqrt()) / a;
    let enters = b < 0.0 && square >= 0.0 && share < 1.0;
    enters.then(|| (share, tangent(centre, radius, [x + share * u, y + share * v])))
}

/// The tangent of a circle at the point that lies in this direction from its centre.
fn tangent(centre: [f32; 2], radius: f32, direction: [f32; 2]) -> Edge {
    let normal = unit(direction);
    Edge { normal, offset: radius + normal[0] * centre[0] + normal[1] * centre[1] }
}

/// The vector of length 1 in this direction; upwards for none.
fn unit([x, y]: [f32; 2]) -> [f32; 2] {
    let length = (x * x + y * y).sqrt();
    if length > 0.0 { [x / length, y / length] } else { [0.0, 1.0] }
}

/// Twice the area of a polygon, positive if its corners go round counter-clockwise.
fn area(corners: &[[f32; 2]]) -> f32 {
    let next = corners.iter().cycle().skip(1);
    corners.iter().zip(next).map(|(a, b)| a[0] * b[1] - a[1] * b[0]).sum()
}

/// What is wrong with a polygon: found and expected.
fn fault(corners: &[[f32; 2]]) -> Option<(String, &'static str)> {
    if corners.len() < 3 || !corners.as_flattened().iter().all(|x| x.abs() <= LONGEST) {
        return Some((format!("{corners:?}"), "at least three points with numbers up to 1e4"));
    }
    let count = corners.len();
    let sign = area(corners).signum();
    for k in 0..count {
        let [a, b, c] = [0, 1, 2].map(|next| corners[(k + next) % count]);
        if a == b {
            return Some((format!("corner {a:?} twice"), "different corners"));
        }
        let turn = (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]);
        if turn * sign <= 0.0 {
            return Some((
                format!("a corner at {b:?} that turns inwards, or not at all"),
                "a convex polygon: divide it into several",
            ));
        }
    }
    // All corners of a convex polygon lie on one side of each edge.
    for k in 0..count {
        let edge = Edge::between(corners[k], corners[(k + 1) % count]);
        let beyond = corners.iter().find(|corner| edge.distance(**corner) * sign > 1e-4);
        if let Some(corner) = beyond {
            return Some((
                format!("edges that cross, near {corner:?}"),
                "a polygon whose edges do not cross",
            ));
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square() -> Part {
        Outline::Rectangle { size: [2.0, 2.0] }.parts().remove(0)
    }

    #[test]
    fn ways_enter_through_the_surface_that_they_meet_first() {
        let disc = Part::Disc { centre: [0.0; 2], radius: 1.0 };
        for part in [square(), disc] {
            let (share, surface) = part.entered([-3.0, 0.0], [1.0, 0.0]).unwrap();
            assert!((share - 0.5).abs() < 1e-6, "{share}");
            assert_eq!(surface, Edge { normal: [-1.0, 0.0], offset: 1.0 });
            // Through and through, beside, away, and to its surface only.
            assert!(part.entered([-3.0, 0.0], [3.0, 0.0]).is_some());
            assert_eq!(part.entered([-3.0, 1.5], [3.0, 1.5]), None);
            assert_eq!(part.entered([-2.0, 0.0], [-3.0, 0.0]), None);
            assert_eq!(part.entered([-2.0, 0.0], [-1.0, 0.0]), None);
            let (share, surface) = part.entered([0.9, 0.0], [1.5, 0.0]).unwrap();
            assert_eq!((share, surface.normal), (0.0, [1.0, 0.0]), "from inside");
        }
        // Past a corner.
        assert_eq!(square().entered([-3.0, 0.0], [0.0, 3.5]), None);
        assert_eq!(square().entered([-3.0, 0.0], [0.0, 1.4]).unwrap().1.normal, [-1.0, 0.0]);
    }

    #[test]
    fn a_point_faces_a_surface_and_no_corner() {
        assert_eq!(square().faced([0.5, 1.25]).unwrap().0, 0.25);
        assert_eq!(square().faced([0.5, 1.25]).unwrap().1.normal, [0.0, 1.0]);
        for point in [[1.1, 1.25], [-1.1, 1.25], [1.5, -1.01], [0.0, 0.5]] {
            assert_eq!(square().faced(point), None, "{point:?}");
        }
    }

    #[test]
    fn polygons_that_are_not_convex_or_cross_themselves_are_refused() {
        let star = [0usize, 2, 4, 1, 3].map(|k| {
            let angle = 1.2566371 * k as f32;
            [angle.cos(), angle.sin()]
        });
        let cases: [(&[[f32; 2]], &str); 6] = [
            (&[[0.0, 0.0], [1.0, 0.0]], "at least three"),
            (&[[0.0, 0.0], [1e20, 0.0], [0.0, 1.0]], "up to 1e4"),
            (&[[0.0, 0.0], [1.0, 0.0], [0.2, 0.2], [0.0, 1.0]], "convex"),
            (&[[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]], "convex"),
            (&[[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], "different corners"),
            (&star, "do not cross"),
        ];
        for (corners, expected) in cases {
            let (_, _, found) =
                Outline::Polygons { corners: vec![corners.to_vec()] }.invalid().unwrap();
            assert!(found.contains(expected), "{corners:?}: {found}");
        }
        for corners in [[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]]]
        {
            let outline = Outline::Polygons { corners: vec![corners.to_vec()] };
            assert_eq!(outline.invalid(), None);
            assert!(outline.parts()[0].distance([0.2, 0.2]) < 0.0);
        }
    }

    #[test]
    fn outlines_overlap_or_lie_beside_each_other() {
        let at = |x, y, degrees: f32| Pose { position: [x, y], angle: degrees.to_radians() };
        let square = Outline::Rectangle { size: [2.0, 2.0] };
        let disc = Outline::Disc { radius: 1.0 };
        let cases = [
            (&square, at(2.1, 0.0, 0.0), false),
            (&square, at(1.9, 0.0, 0.0), true),
            (&square, at(2.3, 0.0, 45.0), true),
            (&square, at(2.3, 2.3, 45.0), false),
            (&square, at(0.1, 0.0, 45.0), true),
            (&disc, at(2.1, 0.0, 0.0), false),
            (&disc, at(1.9, 0.0, 0.0), true),
            (&disc, at(1.8, 1.8, 0.0), false),
            (&disc, at(0.0, 0.0, 0.0), true),
            (&Outline::HalfPlane, at(0.0, -1.1, 0.0), false),
            (&Outline::HalfPlane, at(0.0, -0.9, 0.0), true),
        ];
        for (other, pose, expected) in cases {
            for (one, one_pose, other, pose) in [
                (&square, at(0.0, 0.0, 0.0), other, pose),
                (other, pose, &square, at(0.0, 0.0, 0.0)),
            ] {
                assert_eq!(one.overlaps(one_pose, other, pose), expected, "{other:?} at {pose:?}");
            }
        }
        assert!(disc.overlaps(at(0.0, 0.0, 0.0), &disc, at(1.9, 0.0, 0.0)));
        assert!(!disc.overlaps(at(0.0, 0.0, 0.0), &disc, at(2.1, 0.0, 0.0)));
    }

    #[test]
    fn a_posed_part_is_turned_and_moved() {
        let pose = Pose { position: [5.0, 0.0], angle: std::f32::consts::FRAC_PI_2 };
        let half_plane = Outline::HalfPlane.parts()[0].posed(pose, [0.0, 1.0]);
        assert_eq!(half_plane.distance([4.0, 7.0]), 1.0);
        assert_eq!(half_plane.surface([4.0, 7.0]).normal, [-1.0, 0.0]);
    }
}
