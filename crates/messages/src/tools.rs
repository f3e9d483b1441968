//! Converts [`Tools`] and [`ToolFrame`](tool::ToolFrame)s from and to their messages: the only place where external data becomes tools.
//!
//! Poses of messages are those of space. In the plane, x and y are theirs, the rotation is about z, and every other number is 0.

use super::{
    Header, Point, Pose, Quaternion, Tool, ToolDescription, ToolFrame, ToolPart, Twist, Vector3,
    Wrench, cdr::CdrError,
};
use eddy_frames::{
    Stamp,
    tool::{self, Contact, InvalidTool, Outline, ToolState, Tools},
};

/// A message that says nothing valid of tools.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BadTool {
    /// The bytes are not a message of the type.
    #[error(transparent)]
    Cdr(#[from] CdrError),
    /// The message is not valid.
    #[error(transparent)]
    Invalid(#[from] InvalidTool),
}

/// By how much a number that should be 0 in the plane, or 1 as the length of a quaternion, may differ from it.
const TOLERANCE: f64 = 1e-3;

/// Kinds of parts, as in `ToolPart.msg`.
const HALF_SPACE: u8 = 0;
const BALL: u8 = 1;
const BOX: u8 = 2;
const HULL: u8 = 3;

/// The topics of [`ToolFrame`]s and [`ToolDescription`]s that belong to a topic of frames: `/left/tools` and `/left/tools/description` for
/// `/left/particles`.
pub fn tool_topics(frames: &str) -> [String; 2] {
    let namespace = frames.rsplit_once('/').map_or("", |(namespace, _)| namespace);
    [format!("{namespace}/tools"), format!("{namespace}/tools/description")]
}

impl ToolDescription {
    /// The message of the tools of a stream with a stamp.
    pub fn of(tools: &Tools, stamp: Stamp) -> Self {
        Self {
            header: Header::world(stamp),
            stream: tools.stream,
            tools: tools.tools.iter().map(Tool::from).collect(),
        }
    }

    /// The tools, checked.
    ///
    /// # Errors
    /// [`InvalidTool`] for the first field that is wrong.
    pub fn checked(&self) -> Result<Tools, InvalidTool> {
        let tools = self.tools.iter().enumerate();
        let tools = tools
            .map(|(index, tool)| tool.checked(&format!("tools[{index}]")))
            .collect::<Result<Vec<_>, _>>()?;
        tool::check(&tools)?;
        Ok(Tools { stream: self.stream, tools })
    }
}

impl From<&tool::Tool> for Tool {
    fn from(tool::Tool { name, shape, contact }: &tool::Tool) -> Self {
        let part = |kind, size: &[f32]| ToolPart { kind, size: size.to_vec(), corners: Vec::new() };
        let parts = match shape {
            Outline::HalfPlane => vec![part(HALF_SPACE, &[])],
            Outline::Disc { radius } => vec![part(BALL, &[*radius])],
            Outline::Rectangle { size } => vec![part(BOX, size)],
            Outline::Polygons { corners } => corners
                .iter()
                .map(|polygon| ToolPart {
                    corners: polygon.as_flattened().to_vec(),
                    ..part(HULL, &[])
                })
                .collect(),
        };
        let (contact, friction) = match *contact {
            Contact::Sticky => (0, 0.0),
            Contact::Slip => (1, 0.0),
            Contact::Friction(friction) => (2, friction),
        };
        Self { name: name.clone(), parts, contact, friction }
    }
}

impl Tool {
    /// The tool, without the checks of [`tool::check`].
    fn checked(&self, field: &str) -> Result<tool::Tool, InvalidTool> {
        let contact = match self.contact {
            0 => Contact::Sticky,
            1 => Contact::Slip,
            2 => Contact::Friction(self.friction),
            found => {
                let expected = "0 (sticky), 1 (slip) or 2 (friction)";
                return Err(InvalidTool::new(
                    format!("{field}.contact"),
                    found.to_string(),
                    expected,
                ));
            }
        };
        let shape = outline(&self.parts, field)?;
        Ok(tool::Tool { name: self.name.clone(), shape, contact })
    }
}

/// The outline that consists of these parts.
fn outline(parts: &[ToolPart], field: &str) -> Result<Outline, InvalidTool> {
    if let [part] = parts
        && part.kind != HULL
    {
        return single(part, &format!("{field}.parts[0]"));
    }
    if parts.is_empty() {
        return Err(InvalidTool::new(format!("{field}.parts"), "none", "at least one"));
    }
    let polygon = |(index, part): (usize, &ToolPart)| {
        let field = format!("{field}.parts[{index}]");
        if part.kind != HULL {
            let found = format!("{} among other parts", part.kind);
            let expected = "3 (convex hull), if a tool has several parts";
            return Err(InvalidTool::new(format!("{field}.kind"), found, expected));
        }
        match part.corners.as_chunks() {
            (corners, []) => Ok(corners.to_vec()),
            (_, [_, ..]) => {
                let found = format!("{} numbers", part.corners.len());
                let expected = "two for each corner: tools are two-dimensional";
                Err(InvalidTool::new(format!("{field}.corners"), found, expected))
            }
        }
    };
    let corners = parts.iter().enumerate().map(polygon).collect::<Result<_, _>>()?;
    Ok(Outline::Polygons { corners })
}

/// The outline that is one part with a size.
fn single(part: &ToolPart, field: &str) -> Result<Outline, InvalidTool> {
    let lengths = match part.kind {
        HALF_SPACE => 0,
        BALL => 1,
        BOX => 2,
        found => {
            let expected = "0 (half-space), 1 (ball), 2 (box) or 3 (convex hull)";
            return Err(InvalidTool::new(format!("{field}.kind"), found.to_string(), expected));
        }
    };
    match *part.size {
        [] if lengths == 0 => Ok(Outline::HalfPlane),
        [radius] if lengths == 1 => Ok(Outline::Disc { radius }),
        [width, height] if lengths == 2 => Ok(Outline::Rectangle { size: [width, height] }),
        _ => {
            let found = format!("{} numbers", part.size.len());
            let expected = format!("{lengths} for a part of kind {} in the plane", part.kind);
            Err(InvalidTool::new(format!("{field}.size"), found, expected))
        }
    }
}

impl ToolFrame {
    /// The message of a frame of these tools.
    pub fn of(frame: &tool::ToolFrame, tools: &Tools) -> Self {
        Self {
            header: Header::world(frame.stamp),
            stream: frame.stream,
            sequence: frame.sequence,
            names: tools.tools.iter().map(|tool| tool.name.clone()).collect(),
            poses: frame.states.iter().map(|state| state.pose.into()).collect(),
            twists: frame.states.iter().map(Twist::from).collect(),
            wrenches: frame.wrenches.iter().map(Wrench::from).collect(),
        }
    }

    /// The frame with the order of `tools`, checked.
    ///
    /// # Errors
    /// [`InvalidTool`] for another stream than that of the tools, lists of different lengths, a tool without a pose, a pose without a tool,
    /// and a number that is not finite or does not lie in the plane.
    pub fn checked(&self, tools: &Tools) -> Result<tool::ToolFrame, InvalidTool> {
        let Self { names, poses, twists, wrenches, .. } = self;
        if self.stream != tools.stream {
            let (found, expected) = (self.stream.to_string(), tools.stream.to_string());
            return Err(InvalidTool::new("stream", found, expected));
        }
        let lengths = [("poses", poses.len()), ("twists", twists.len())];
        let measured = (!wrenches.is_empty()).then_some(("wrenches", wrenches.len()));
        for (field, found) in lengths.into_iter().chain(measured) {
            if found != names.len() {
                let expected = format!("{}, one for each name", names.len());
                return Err(InvalidTool::new(field, found.to_string(), expected));
            }
        }
        let is_known = |name: &String| tools.tools.iter().any(|tool| tool.name == *name);
        let unknown = names
            .iter()
            .enumerate()
            .find(|(index, name)| !is_known(name) || names[..*index].contains(*name));
        if let Some((index, name)) = unknown {
            let known: Vec<&str> = tools.tools.iter().map(|tool| tool.name.as_str()).collect();
            let expected = format!("each of {known:?} once");
            return Err(InvalidTool::new(format!("names[{index}]"), format!("{name:?}"), expected));
        }
        let (mut states, mut ordered) = (Vec::new(), Vec::new());
        for tool::Tool { name, .. } in &tools.tools {
            let Some(index) = names.iter().position(|other| other == name) else {
                let expected = format!("a pose of the tool {name:?}");
                return Err(InvalidTool::new("names", format!("{names:?}"), expected));
            };
            states.push(state(&poses[index], &twists[index], index)?);
            if let Some(wrench) = wrenches.get(index) {
                ordered.push(in_plane(wrench, index)?);
            }
        }
        let (stream, sequence, stamp) = (self.stream, self.sequence, self.header.stamp.into());
        Ok(tool::ToolFrame { stream, sequence, stamp, states, wrenches: ordered })
    }
}

impl From<tool::Pose> for Pose {
    fn from(tool::Pose { position: [x, y], angle }: tool::Pose) -> Self {
        let (sin, cos) = libm::sincos(0.5 * f64::from(angle));
        Self {
            position: Point { x: x.into(), y: y.into(), z: 0.0 },
            orientation: Quaternion { x: 0.0, y: 0.0, z: sin, w: cos },
        }
    }
}

impl From<&ToolState> for Twist {
    fn from(&ToolState { velocity: [x, y], spin, .. }: &ToolState) -> Self {
        Self {
            linear: Vector3 { x: x.into(), y: y.into(), z: 0.0 },
            angular: Vector3 { x: 0.0, y: 0.0, z: spin.into() },
        }
    }
}

impl From<&tool::Wrench> for Wrench {
    fn from(&tool::Wrench { force: [x, y], torque }: &tool::Wrench) -> Self {
        Self { force: Vector3 { x, y, z: 0.0 }, torque: Vector3 { x: 0.0, y: 0.0, z: torque } }
    }
}

impl Pose {
    /// Position and angle in the plane, the angle above -pi and at most pi (domain lengths, rad); `field` is its name in messages.
    ///
    /// # Errors
    /// [`InvalidTool`] for a number that is not finite or does not lie in the plane, and a quaternion without a length of 1.
    pub fn in_plane(&self, field: &str) -> Result<([f64; 2], f64), InvalidTool> {
        let Self { position, orientation: Quaternion { x, y, z, w } } = *self;
        flat(field, "position", &[position.x, position.y], &[position.z])?;
        flat(field, "orientation", &[z, w], &[x, y])?;
        self.orientation.check(field)?;
        // q and -q are the same rotation: the one with w >= 0 is by at most half a turn.
        let half = if w < 0.0 { libm::atan2(0.0 - z, 0.0 - w) } else { libm::atan2(z, w) };
        Ok(([position.x, position.y], 2.0 * half))
    }

    /// Checks that its numbers are finite and that its quaternion is a rotation in space; `field` is its name in messages.
    ///
    /// # Errors
    /// [`InvalidTool`].
    pub fn check(&self, field: &str) -> Result<(), InvalidTool> {
        let Point { x, y, z } = self.position;
        flat(field, "position", &[x, y, z], &[])?;
        self.orientation.check(field)
    }
}

impl Quaternion {
    /// Checks that its length is 1.
    fn check(&self, field: &str) -> Result<(), InvalidTool> {
        let Self { x, y, z, w } = self;
        let length = (x * x + y * y + z * z + w * w).sqrt();
        if (length - 1.0).abs() <= TOLERANCE {
            return Ok(());
        }
        let (field, found) = (format!("{field}.orientation"), format!("a length of {length}"));
        Err(InvalidTool::new(field, found, "a quaternion of length 1"))
    }
}

/// Pose and velocity of the tool with this index in its message. The angle is above -pi and at most pi.
fn state(pose: &Pose, twist: &Twist, index: usize) -> Result<ToolState, InvalidTool> {
    let ([x, y], angle) = pose.in_plane(&format!("poses[{index}]"))?;
    let Twist { linear, angular } = *twist;
    let field = format!("twists[{index}]");
    flat(&field, "linear", &[linear.x, linear.y], &[linear.z])?;
    flat(&field, "angular", &[angular.z], &[angular.x, angular.y])?;
    Ok(ToolState {
        pose: tool::Pose { position: [x as f32, y as f32], angle: angle as f32 },
        velocity: [linear.x as f32, linear.y as f32],
        spin: angular.z as f32,
    })
}

/// The force and torque on the tool with this index in its message.
fn in_plane(wrench: &Wrench, index: usize) -> Result<tool::Wrench, InvalidTool> {
    let Wrench { force, torque } = *wrench;
    let field = format!("wrenches[{index}]");
    flat(&field, "force", &[force.x, force.y], &[force.z])?;
    flat(&field, "torque", &[torque.z], &[torque.x, torque.y])?;
    Ok(tool::Wrench { force: [force.x, force.y], torque: torque.z })
}

/// Checks that the numbers of the plane are finite as `f32` and that the others are 0.
fn flat(field: &str, name: &str, inside: &[f64], outside: &[f64]) -> Result<(), InvalidTool> {
    let field = || format!("{field}.{name}");
    if let Some(number) = inside.iter().find(|number| !(**number as f32).is_finite()) {
        return Err(InvalidTool::new(field(), number.to_string(), "finite numbers"));
    }
    match outside.iter().find(|number| number.is_nan() || number.abs() > TOLERANCE) {
        Some(number) => {
            let expected = "0: tools move in x and y and turn about z";
            Err(InvalidTool::new(field(), format!("{number} out of the plane"), expected))
        }
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::cdr;

    fn outlines() -> impl Strategy<Value = Outline> {
        let length = 1e-3f32..2.0;
        prop_oneof![
            Just(Outline::HalfPlane),
            length.clone().prop_map(|radius| Outline::Disc { radius }),
            [length.clone(), length.clone()].prop_map(|size| Outline::Rectangle { size }),
            prop::collection::vec((length.clone(), length), 1..4).prop_map(|triangles| {
                let triangle = |(x, y)| vec![[0.0, 0.0], [x, 0.0], [0.0, y]];
                Outline::Polygons { corners: triangles.into_iter().map(triangle).collect() }
            }),
        ]
    }

    fn contacts() -> impl Strategy<Value = Contact> {
        prop_oneof![
            Just(Contact::Sticky),
            Just(Contact::Slip),
            (0.0f32..10.0).prop_map(Contact::Friction)
        ]
    }

    prop_compose! {
        fn states()(position: [i16; 2], angle in -3.0f32..3.0, velocity: [i16; 2], spin in -9.0f32..9.0)
            -> ToolState {
            let position = position.map(|x| f32::from(x) / 999.0);
            let velocity = velocity.map(|x| f32::from(x) / 99.0);
            ToolState { pose: tool::Pose { position, angle }, velocity, spin }
        }
    }

    fn wrench() -> tool::Wrench {
        tool::Wrench { force: [0.25, -1.5], torque: 0.125 }
    }

    proptest! {
        #[test]
        fn tools_and_their_frames_are_converted_to_messages_and_back(
            stream: u64, sequence: u64, nanoseconds in 0i64..1 << 60, is_measured: bool,
            all in prop::collection::vec((outlines(), contacts(), states()), 0..=8),
        ) {
            let stamp = Stamp(nanoseconds);
            let tools = all.iter().enumerate().map(|(index, (shape, contact, _))| {
                tool::Tool { name: format!("tool {index}"), shape: shape.clone(), contact: *contact }
            });
            let tools = Tools { stream, tools: tools.collect() };
            let message: ToolDescription =
                cdr::decode(&cdr::encode(&ToolDescription::of(&tools, stamp))).unwrap();
            prop_assert_eq!(message.checked(), Ok(tools.clone()));

            let states: Vec<ToolState> = all.iter().map(|(_, _, state)| *state).collect();
            let wrenches = if is_measured { vec![wrench(); states.len()] } else { Vec::new() };
            let frame = tool::ToolFrame { stream, sequence, stamp, states, wrenches };
            let mut message: ToolFrame =
                cdr::decode(&cdr::encode(&ToolFrame::of(&frame, &tools))).unwrap();
            prop_assert_eq!(message.checked(&tools), Ok(frame.clone()));
            // Names, not places, say which tool a pose belongs to.
            message.names.reverse();
            message.poses.reverse();
            message.twists.reverse();
            message.wrenches.reverse();
            prop_assert_eq!(message.checked(&tools), Ok(frame));
        }
    }

    fn blade() -> Tools {
        let shape = Outline::Rectangle { size: [0.02, 0.2] };
        let blade = tool::Tool { name: "blade".into(), shape, contact: Contact::Slip };
        Tools { stream: 3, tools: vec![blade] }
    }

    #[test]
    fn topics_of_tools_are_beside_those_of_frames() {
        assert_eq!(tool_topics("/particles"), ["/tools", "/tools/description"]);
        assert_eq!(tool_topics("/left/seen"), ["/left/tools", "/left/tools/description"]);
    }

    #[test]
    fn descriptions_that_cannot_be_used_are_refused_with_found_and_expected() {
        type Fault = fn(&mut Tool);
        let hull = ToolPart { kind: 3, size: Vec::new(), corners: vec![0.0; 5] };
        let cases: [(Fault, &str); 7] = [
            (
                |tool| tool.contact = 3,
                "contact: found 3, expected 0 (sticky), 1 (slip) or 2 (friction)",
            ),
            (|tool| tool.parts.clear(), "parts: found none, expected at least one"),
            (
                |tool| tool.parts[0].kind = 7,
                "parts[0].kind: found 7, expected 0 (half-space), 1 (ball), 2 (box) or 3 (convex hull)",
            ),
            (
                |tool| tool.parts[0].size.push(1.0),
                "parts[0].size: found 3 numbers, expected 2 for a part of kind 2 in the plane",
            ),
            (
                |tool| tool.parts.push(tool.parts[0].clone()),
                "parts[0].kind: found 2 among other parts, expected 3 (convex hull), if a tool has several parts",
            ),
            (
                |tool| tool.parts[0].size[0] = -1.0,
                "shape.rectangle.size: found -1, expected a positive number up to 1e4",
            ),
            (
                |tool| (tool.contact, tool.friction) = (2, f32::NAN),
                "contact.friction: found NaN, expected a number from 0 to 1000",
            ),
        ];
        for (fault, expected) in cases {
            let mut message = ToolDescription::of(&blade(), Stamp(0));
            fault(&mut message.tools[0]);
            let error = message.checked().unwrap_err().to_string();
            assert_eq!(error, format!("tools[0].{expected}"));
        }
        let mut message = ToolDescription::of(&blade(), Stamp(0));
        message.tools[0].parts = vec![hull];
        let error = message.checked().unwrap_err().to_string();
        let expected = "found 5 numbers, expected two for each corner: tools are two-dimensional";
        assert_eq!(error, format!("tools[0].parts[0].corners: {expected}"));
    }

    #[test]
    fn poses_that_cannot_be_used_are_refused_with_found_and_expected() {
        type Fault = fn(&mut ToolFrame);
        let cases: [(Fault, &str); 11] = [
            (|m| m.stream = 4, "stream: found 4, expected 3"),
            (|m| m.twists.clear(), "twists: found 0, expected 1, one for each name"),
            (
                |m| m.wrenches = vec![Wrench::default(); 2],
                "wrenches: found 2, expected 1, one for each name",
            ),
            (
                |m| m.names[0] = "cup".into(),
                "names[0]: found \"cup\", expected each of [\"blade\"] once",
            ),
            (
                |m| {
                    (m.names, m.poses, m.twists) = (Vec::new(), Vec::new(), Vec::new());
                },
                "names: found [], expected a pose of the tool \"blade\"",
            ),
            (
                |m| m.poses[0].position.x = f64::NAN,
                "poses[0].position: found NaN, expected finite numbers",
            ),
            (
                |m| m.poses[0].position.z = 0.5,
                "poses[0].position: found 0.5 out of the plane, expected 0: tools move in x and y and turn about z",
            ),
            (
                |m| m.poses[0].orientation.x = 0.5,
                "poses[0].orientation: found 0.5 out of the plane, expected 0: tools move in x and y and turn about z",
            ),
            (
                |m| m.poses[0].orientation = Quaternion::default(),
                "poses[0].orientation: found a length of 0, expected a quaternion of length 1",
            ),
            (|m| m.twists[0].angular.z = 1e300, "twists[0].angular: found 1"),
            (
                |m| {
                    m.wrenches = vec![Wrench::default()];
                    m.wrenches[0].force.z = f64::INFINITY;
                },
                "wrenches[0].force: found inf out of the plane, expected 0",
            ),
        ];
        let pose = tool::Pose { position: [0.5, 0.5], angle: 0.25 };
        let states = vec![ToolState { pose, velocity: [0.0; 2], spin: 0.0 }];
        let frame = tool::ToolFrame {
            stream: 3,
            sequence: 1,
            stamp: Stamp(0),
            states,
            wrenches: Vec::new(),
        };
        for (fault, expected) in cases {
            let mut message = ToolFrame::of(&frame, &blade());
            fault(&mut message);
            let error = message.checked(&blade()).unwrap_err().to_string();
            assert!(error.starts_with(expected), "{error}, expected {expected}");
        }
    }
}
