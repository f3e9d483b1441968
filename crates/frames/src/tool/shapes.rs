//! Tools and the forces on them as shapes of a picture.

use super::{Outline, Part, Pose, ToolFrame, Tools, Wrench};
use crate::{
    Domain,
    palette::{FORCE, Rgb, TOOL},
};

/// Corners of the polygon that a disc is drawn as.
const DISC_CORNERS: usize = 40;

/// Length of the longest arrow (share of the domain's height).
const LONGEST_ARROW: f32 = 0.2;
/// Width of an arrow's shaft, width and length of its head (share of the arrow's greatest length).
const ARROW: [f32; 3] = [0.06, 0.22, 0.26];

/// A filled convex shape in the domain.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// Where it is (domain lengths).
    pub part: Part,
    /// Its colour.
    pub color: Rgb,
}

impl Part {
    /// Corners of a polygon that covers it where it may be seen in a domain, in order (domain lengths).
    pub fn polygon(&self, Domain { lower, upper }: Domain) -> Vec<[f32; 2]> {
        match self {
            Self::Disc { centre: [x, y], radius } => (0..DISC_CORNERS)
                .map(|k| {
                    let angle = k as f32 * (2.0 * std::f32::consts::PI / DISC_CORNERS as f32);
                    [x + radius * angle.cos(), y + radius * angle.sin()]
                })
                .collect(),
            Self::Convex { edges, corners } if corners.is_empty() => {
                let far = 2.0 * (upper[0] - lower[0]).hypot(upper[1] - lower[1]);
                let ([u, v], middle) =
                    (edges[0].normal, [0, 1].map(|k| 0.5 * (lower[k] + upper[k])));
                let height = edges[0].distance(middle);
                let [x, y] = [middle[0] - height * u, middle[1] - height * v];
                [(far, 0.0), (-far, 0.0), (-far, -far), (far, -far)]
                    .map(|(along, out)| [x + along * v + out * u, y - along * u + out * v])
                    .to_vec()
            }
            Self::Convex { corners, .. } => corners.clone(),
        }
    }
}

impl Shape {
    /// Triangles that cover it where it may be seen in a domain, three corners each, as shares of the domain's width and height.
    pub fn triangles(&self, domain: Domain) -> Vec<[f32; 2]> {
        let (corners, Domain { lower, upper }) = (self.part.polygon(domain), domain);
        let share = |point: [f32; 2]| [0, 1].map(|k| (point[k] - lower[k]) / (upper[k] - lower[k]));
        let fan = corners.windows(2).skip(1);
        fan.flat_map(|pair| [corners[0], pair[0], pair[1]]).map(share).collect()
    }
}

/// The scale of arrows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ForceScale {
    /// The force of the longest arrow (density x domain lengths^3 per s^2, in the plane domain lengths^2).
    pub strongest: f64,
    /// The length of that arrow (domain lengths).
    pub length: f32,
}

impl ForceScale {
    /// The scale in a domain of this height, for forces up to the strongest.
    pub fn new(strongest: f64, height: f32) -> Self {
        Self { strongest, length: LONGEST_ARROW * height }
    }
}

impl ToolFrame {
    /// The strongest force on any of the tools; 0 if none is known.
    pub fn strongest_force(&self) -> f64 {
        let forces = self.wrenches.iter().map(|wrench| wrench.force[0].hypot(wrench.force[1]));
        forces.fold(0.0, f64::max)
    }
}

/// Tools where they are at a frame, and an arrow from the position of each for the force on it.
pub fn shapes(tools: &Tools, frame: &ToolFrame, scale: ForceScale) -> Vec<Shape> {
    let outlines = tools.tools.iter().zip(&frame.states);
    let parts = outlines.flat_map(|(tool, state)| tool.shape.posed(state.pose));
    let tools = parts.map(|part| Shape { part, color: TOOL });
    let forces = frame.states.iter().zip(&frame.wrenches);
    let arrows = forces.flat_map(|(state, wrench)| arrow(state.pose.position, wrench, scale));
    tools.chain(arrows.map(|part| Shape { part, color: FORCE })).collect()
}

/// An arrow from a point: a shaft and a head; none if it would be hard to see.
fn arrow(from: [f32; 2], wrench: &Wrench, scale: ForceScale) -> Vec<Part> {
    let [x, y] = wrench.force;
    let length = (x.hypot(y) / scale.strongest) as f32 * scale.length;
    let [shaft, head, tip] = ARROW.map(|share| share * scale.length);
    if length.is_nan() || length < 0.5 * tip {
        return Vec::new();
    }
    let neck = (length - tip).max(0.0);
    let corners = vec![
        vec![
            [0.0, -0.5 * shaft],
            [neck + 0.5 * shaft, -0.5 * shaft],
            [neck + 0.5 * shaft, 0.5 * shaft],
            [0.0, 0.5 * shaft],
        ],
        vec![[neck, -0.5 * head], [length, 0.0], [neck, 0.5 * head]],
    ];
    let pose = Pose { position: from, angle: y.atan2(x) as f32 };
    Outline::Polygons { corners }.posed(pose)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        Stamp,
        tool::{Contact, Tool, ToolState},
    };

    #[test]
    fn triangles_cover_their_shape() {
        let domain = Domain { lower: [-1.0, 0.0], upper: [3.0, 2.0] };
        let pose = Pose { position: [0.5, 0.75], angle: 0.4 };
        let square = vec![[0.0, 0.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.5]];
        for outline in [
            Outline::HalfPlane,
            Outline::Disc { radius: 0.3 },
            Outline::Rectangle { size: [0.8, 0.3] },
            Outline::Polygons { corners: vec![square] },
        ] {
            let shape = Shape { part: outline.posed(pose).remove(0), color: TOOL };
            let triangles = shape.triangles(domain);
            for x in 0..40 {
                for y in 0..40 {
                    let share = [x, y].map(|k| (k as f32 + 0.5) / 40.0);
                    let point = [4.0 * share[0] - 1.0, 2.0 * share[1]];
                    let distance = shape.part.distance(point);
                    let cross = |a: [f32; 2], b: [f32; 2]| {
                        (b[0] - a[0]) * (share[1] - a[1]) - (b[1] - a[1]) * (share[0] - a[0])
                    };
                    let covers = |t: &[[f32; 2]; 3]| {
                        let sides = [cross(t[0], t[1]), cross(t[1], t[2]), cross(t[2], t[0])];
                        sides.iter().all(|s| *s >= 0.0) || sides.iter().all(|s| *s <= 0.0)
                    };
                    let is_covered = triangles.as_chunks().0.iter().any(covers);
                    // A disc has corners.
                    if distance.abs() > 2e-3 {
                        assert_eq!(is_covered, distance < 0.0, "{outline:?} at {point:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_tool_is_drawn_where_it_is_and_its_force_points_from_it() {
        let disc =
            Tool { name: "a".into(), shape: Outline::Disc { radius: 0.1 }, contact: Contact::Slip };
        let tools = Tools { stream: 0, tools: vec![disc] };
        let pose = Pose { position: [0.5, 0.25], angle: 0.0 };
        let frame = |wrenches| ToolFrame {
            stream: 0,
            sequence: 1,
            stamp: Stamp(0),
            states: vec![ToolState { pose, velocity: [0.0; 2], spin: 0.0 }],
            wrenches,
        };
        let pushed = frame(vec![Wrench { force: [0.0, 3.0], torque: 0.0 }]);
        let scale = ForceScale::new(pushed.strongest_force(), 1.0);
        let drawn = shapes(&tools, &pushed, scale);
        let [tool, shaft, head] = &drawn[..] else { panic!("{} shapes", drawn.len()) };
        assert_eq!((tool.color, shaft.color, head.color), (TOOL, FORCE, FORCE));
        assert!(tool.part.distance([0.5, 0.34]) < 0.0 && tool.part.distance([0.5, 0.36]) > 0.0);
        assert!(shaft.part.distance([0.5, 0.3]) < 0.0 && head.part.distance([0.5, 0.44]) < 0.0);
        assert!(head.part.distance([0.5, 0.46]) > 0.0, "it is as long as the scale says");
        let still = frame(vec![Wrench::default()]);
        assert_eq!(shapes(&tools, &still, scale).len(), 1);
        assert_eq!(shapes(&tools, &still, ForceScale::new(still.strongest_force(), 1.0)).len(), 1);
        assert_eq!(shapes(&tools, &frame(Vec::new()), scale).len(), 1);
    }
}
