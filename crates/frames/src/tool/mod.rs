//! Tools: rigid bodies with prescribed motion, such as a cup or a blade, in the plane.
//!
//! [`Tools`] says what the tools of a stream are, once; [`ToolFrame`] where they are, beside each frame of particles with the same sequence
//! number. [`outline`](Outline) has their geometry, [`shapes`] draws them,
//! [`Sweep`] is what they do to particles from frame to frame.

mod outline;
mod shapes;
mod sweep;

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use super::Stamp;
pub use outline::{Edge, Outline, Part};
pub use shapes::{ForceScale, Shape, shapes};
pub use sweep::Sweep;

/// Maximum number of tools of a stream.
pub const MAX_TOOLS: usize = 8;
/// Maximum coefficient of friction: with 10 times the normal change of velocity all motion along a surface is stopped.
pub const MAX_FRICTION: f64 = 1e3;

/// What matter does at the surface of a tool.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Contact {
    /// It moves with the tool.
    Sticky,
    /// It slides along the surface and leaves it freely.
    #[default]
    Slip,
    /// It slides against Coulomb's friction with this coefficient, and leaves the surface freely.
    Friction(f32),
}

/// Position and rotation of a tool.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Where the origin of its outline is (domain lengths).
    pub position: [f32; 2],
    /// Counter-clockwise rotation about it (rad).
    pub angle: f32,
}

impl Pose {
    /// Cosine and sine of its angle, with the same bits on every machine.
    pub fn direction(&self) -> [f32; 2] {
        let (sin, cos) = libm::sincosf(self.angle);
        [cos, sin]
    }

    /// The same rotation with the angle that is nearest to `other`'s: at most half a turn from it.
    pub fn nearest_to(self, other: Self) -> Self {
        let turn = 2.0 * std::f64::consts::PI;
        let turns = ((f64::from(other.angle) - f64::from(self.angle)) / turn).round();
        Self { angle: (f64::from(self.angle) + turns * turn) as f32, ..self }
    }
}

/// A tool, wherever it is.
#[derive(Clone, Debug, PartialEq)]
pub struct Tool {
    /// Its name, different from those of the other tools of its stream.
    pub name: String,
    /// Its outline, relative to its position.
    pub shape: Outline,
    /// What matter does at its surface.
    pub contact: Contact,
}

/// All tools of a stream.
#[derive(Clone, Debug, PartialEq)]
pub struct Tools {
    /// Id of the stream.
    pub stream: u64,
    /// The tools, at most [`MAX_TOOLS`].
    pub tools: Vec<Tool>,
}

/// Force and torque of matter on a tool, mean values of the interval before a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Wrench {
    /// Force (density x domain lengths^3 per s^2).
    pub force: [f64; 2],
    /// Torque about its position, counter-clockwise (density x domain lengths^4 per s^2).
    pub torque: f64,
}

/// A tool at a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToolState {
    /// Where it is.
    pub pose: Pose,
    /// Velocity of its position, the mean of the interval before the frame (domain lengths per s).
    pub velocity: [f32; 2],
    /// Angular velocity, the mean of that interval (rad/s).
    pub spin: f32,
}

/// All tools of a stream at one of its frames.
#[derive(Clone, Debug, PartialEq)]
pub struct ToolFrame {
    /// Id of the stream.
    pub stream: u64,
    /// Sequence number of the frame.
    pub sequence: u64,
    /// Stamp of the frame.
    pub stamp: Stamp,
    /// One for each tool, in the order of [`Tools`].
    pub states: Vec<ToolState>,
    /// What matter does to each; empty if unknown, as at the first frame and in predictions.
    pub wrenches: Vec<Wrench>,
}

/// A tool, or a pose of one, that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: found {found}, expected {expected}")]
pub struct InvalidTool {
    /// The field, such as `tools[1].shape.disc.radius`.
    pub field: String,
    /// What it is.
    pub found: String,
    /// What it should be.
    pub expected: String,
}

impl InvalidTool {
    /// Of a field, with what was found and expected.
    pub fn new(
        field: impl Into<String>,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> Self {
        Self { field: field.into(), found: found.into(), expected: expected.into() }
    }
}

impl Tool {
    /// Checks name, outline and friction; `field` is the tool's place, such as `tools[1]`.
    ///
    /// # Errors
    /// [`InvalidTool`] for the first that is wrong.
    pub fn check(&self, field: &str) -> Result<(), InvalidTool> {
        if self.name.is_empty() {
            return Err(InvalidTool::new(format!("{field}.name"), "an empty name", "a name"));
        }
        if let Some((name, found, expected)) = self.shape.invalid() {
            return Err(InvalidTool::new(format!("{field}.shape.{name}"), found, expected));
        }
        if let Contact::Friction(friction) = self.contact
            && !(0.0..=MAX_FRICTION).contains(&f64::from(friction))
        {
            let expected = format!("a number from 0 to {MAX_FRICTION}");
            let field = format!("{field}.contact.friction");
            return Err(InvalidTool::new(field, friction.to_string(), expected));
        }
        Ok(())
    }
}

/// Checks the tools of a stream: their number, each of them, and that their names differ. Fields are called `tools[index]`.
///
/// # Errors
/// [`InvalidTool`] for the first that is wrong.
pub fn check(tools: &[Tool]) -> Result<(), InvalidTool> {
    if tools.len() > MAX_TOOLS {
        let expected = format!("at most {MAX_TOOLS}");
        return Err(InvalidTool::new("tools", tools.len().to_string(), expected));
    }
    let mut names = BTreeSet::new();
    for (index, tool) in tools.iter().enumerate() {
        let field = format!("tools[{index}]");
        tool.check(&field)?;
        if !names.insert(&tool.name) {
            let found = format!("{:?}, the name of another tool", tool.name);
            return Err(InvalidTool::new(format!("{field}.name"), found, "a name of its own"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn disc(name: &str) -> Tool {
        Tool { name: name.into(), shape: Outline::Disc { radius: 0.1 }, contact: Contact::Slip }
    }

    #[test]
    fn tools_that_cannot_be_are_named_with_found_and_expected() {
        let many: Vec<Tool> = (0..9).map(|k| disc(&k.to_string())).collect();
        let rough = |friction| Tool { contact: Contact::Friction(friction), ..disc("rough") };
        let cases = [
            (many, "tools: found 9, expected at most 8"),
            (vec![disc("")], "tools[0].name: found an empty name, expected a name"),
            (
                vec![disc("a"), disc("a")],
                "tools[1].name: found \"a\", the name of another tool, expected a name of its own",
            ),
            (
                vec![Tool { shape: Outline::Disc { radius: 0.0 }, ..disc("a") }],
                "tools[0].shape.disc.radius: found 0, expected a positive number up to 1e4",
            ),
            (
                vec![rough(-1.0)],
                "tools[0].contact.friction: found -1, expected a number from 0 to 1000",
            ),
            (
                vec![rough(f32::NAN)],
                "tools[0].contact.friction: found NaN, expected a number from 0 to 1000",
            ),
        ];
        for (tools, expected) in cases {
            assert_eq!(check(&tools).unwrap_err().to_string(), expected);
        }
        assert_eq!(check(&[disc("a"), disc("b"), rough(0.0)]), Ok(()));
    }

    #[test]
    fn angles_are_counted_on_over_whole_turns() {
        let pose = |degrees: f32| Pose { position: [0.0; 2], angle: degrees.to_radians() };
        for (found, other, expected) in [
            (-170.0, 175.0, 190.0),
            (10.0, 0.0, 10.0),
            (10.0, 720.0, 730.0),
            (170.0, -175.0, -190.0),
        ] {
            let angle = pose(found).nearest_to(pose(other)).angle.to_degrees();
            assert!((angle - expected).abs() < 1e-3, "{angle}, expected {expected}");
        }
    }
}
