//! Tools as shapes of a picture.

use eddy_frames::{
    palette::{FORCE, Rgb, TOOL},
    tool::{Outline, Part, Pose, ToolFrame, Tools, Wrench},
};

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

/// The scale of arrows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ForceScale {
    /// The force of the longest arrow (density x domain lengths^3 per s^2, in the plane domain lengths^2).
    pub strongest: f64,
    /// The length of that arrow (domain lengths).
    pub length: f32,
}

impl ForceScale {
    /// The scale for frames of tools: the strongest force has an arrow of this length (domain lengths).
    pub fn of<'a>(frames: impl IntoIterator<Item = &'a ToolFrame>, length: f32) -> Self {
        let wrenches = frames.into_iter().flat_map(|frame| &frame.wrenches);
        let strongest = wrenches.map(|wrench| wrench.force[0].hypot(wrench.force[1]));
        Self { strongest: strongest.fold(0.0, f64::max), length }
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
    use eddy_frames::{
        Stamp,
        tool::{Contact, Tool, ToolState},
    };

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
        let scale = ForceScale::of([&pushed], 0.2);
        let drawn = shapes(&tools, &pushed, scale);
        let [tool, shaft, head] = &drawn[..] else { panic!("{} shapes", drawn.len()) };
        assert_eq!((tool.color, shaft.color, head.color), (TOOL, FORCE, FORCE));
        assert!(tool.part.distance([0.5, 0.34]) < 0.0 && tool.part.distance([0.5, 0.36]) > 0.0);
        assert!(shaft.part.distance([0.5, 0.3]) < 0.0 && head.part.distance([0.5, 0.44]) < 0.0);
        assert!(head.part.distance([0.5, 0.46]) > 0.0, "it is as long as the scale says");
        let still = frame(vec![Wrench::default()]);
        assert_eq!(shapes(&tools, &still, scale).len(), 1);
        assert_eq!(shapes(&tools, &still, ForceScale::of([&still], 0.2)).len(), 1);
        assert_eq!(shapes(&tools, &frame(Vec::new()), scale).len(), 1);
    }
}
