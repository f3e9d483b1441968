//! Tools: rigid bodies with prescribed motion that push matter, such as a cup or a blade.
//!
//! A tool has an outline and a law of contact ([`eddy_frames::tool`]), and a path ([`path`]). In a substep it is a [`barrier`] between particles and
//! nodes.

mod barrier;
mod path;

use serde::{Deserialize, Serialize};

use super::{error::MpmError, grid::GridShape, particle::Particle, scene::Scene};
use eddy_frames::tool as body;

pub use barrier::ToolLoad;
pub(super) use barrier::{Barriers, Hidden, Loads, Moving, Posed};
pub use eddy_frames::tool::{Contact, MAX_TOOLS, Outline, Pose};
use eddy_frames::tool::{Edge, Part};
pub use path::{Keyframe, Motion};

/// A rigid body whose motion is given.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tool {
    /// Its name, different from those of the other tools.
    pub name: String,
    /// Its outline, relative to its position.
    pub shape: Outline,
    /// What matter does at its surface; slips by default.
    #[serde(default)]
    pub contact: Contact,
    /// Where it is, by time; it moves uniformly from one to the next, and rests before the first and after the last. Between two frames it
    /// moves uniformly, too.
    pub keyframes: Vec<Keyframe>,
}

/// How all tools move in an interval of so many substeps.
#[derive(Clone, Copy, Debug)]
pub(super) struct ToolMotion<'a> {
    pub(super) tools: &'a [Tool],
    pub(super) motions: &'a [Motion],
    pub(super) substeps: u32,
    pub(super) grid: GridShape,
}

/// The velocity of matter that meets a surface with this outward normal, relative to it.
fn met(contact: Contact, relative: [f32; 2], [u, v]: [f32; 2]) -> [f32; 2] {
    let friction = match contact {
        Contact::Sticky => return [0.0; 2],
        Contact::Slip => 0.0,
        Contact::Friction(friction) => friction,
    };
    let into = relative[0] * u + relative[1] * v;
    if into >= 0.0 {
        return relative;
    }
    let along = [relative[0] - into * u, relative[1] - into * v];
    let speed = (along[0] * along[0] + along[1] * along[1]).sqrt();
    let taken = 0.0 - friction * into;
    let share = if taken >= speed { 0.0 } else { 1.0 - taken / speed };
    along.map(|x| x * share)
}

/// Checks the tools of a scene, without its bodies.
///
/// # Errors
/// [`MpmError::Field`] for the first that is wrong, outside the domain, or overlaps another one at its start.
pub(super) fn check(tools: &[Tool], scene: &Scene) -> Result<(), MpmError> {
    let domain = scene.domain;
    let wrong = |field: String, found: String, expected: &str| {
        Err(MpmError::Field { field, found, expected: expected.into() })
    };
    let bodies: Vec<body::Tool> = tools.iter().map(Tool::body).collect();
    body::check(&bodies)?;
    if !tools.is_empty() && scene.attractor.is_some() {
        let expected = "tools without an attractor";
        return wrong("attractor".into(), "an attractor and tools".into(), expected);
    }
    for (index, tool) in tools.iter().enumerate() {
        let field = format!("tools[{index}]");
        path::check(&tool.keyframes, &format!("{field}.keyframes"))?;
        let reach = tool.reach_in(domain);
        for (number, keyframe) in tool.keyframes.iter().enumerate() {
            let is_outside = (0..2)
                .any(|k| keyframe.position[k] < -reach || keyframe.position[k] > domain[k] + reach);
            if is_outside {
                let field = format!("{field}.keyframes[{number}].position");
                let found = format!("{:?}, outside the domain", keyframe.position);
                return wrong(
                    field,
                    found,
                    &format!("a tool that reaches into the domain of {domain:?}"),
                );
            }
        }
        let parts = tool.shape.posed(tool.pose(0.0));
        let is_inside = |p: [f32; 2]| parts.iter().any(|part| part.distance(p) < 0.0);
        if let Some(emitter) = scene.emitters.iter().position(|it| is_inside(it.position)) {
            let found = format!("a tool around emitters[{emitter}] at the start");
            return wrong(field, found, "a tool beside all emitters");
        }
        for (other, before) in tools[..index].iter().enumerate() {
            if tool.shape.overlaps(tool.pose(0.0), &before.shape, before.pose(0.0)) {
                let found = format!("a tool that overlaps tools[{other}] at the start");
                return wrong(
                    field,
                    found,
                    "tools apart from each other; one tool may have several polygons",
                );
            }
        }
    }
    Ok(())
}

/// Checks that no particle begins inside a tool. `owners` has the index of the body of each, or of each group of equally many.
///
/// # Errors
/// [`MpmError::Field`].
pub(super) fn check_room(
    tools: &[Tool],
    particles: &[Particle],
    owners: &[usize],
) -> Result<(), MpmError> {
    for (index, tool) in tools.iter().enumerate() {
        let parts = tool.shape.posed(tool.pose(0.0));
        let is_inside = |p: &Particle| parts.iter().any(|part| part.distance(p.position) < 0.0);
        let inside = particles.iter().filter(|p| is_inside(p)).count();
        if let Some(first) = particles.iter().position(is_inside) {
            let body = owners[first * owners.len() / particles.len()];
            return Err(MpmError::Field {
                field: format!("tools[{index}]"),
                found: format!(
                    "{inside} particles inside it at the start, the first of bodies[{body}] at {:?}",
                    particles[first].position
                ),
                expected: "a start beside all bodies".into(),
            });
        }
    }
    Ok(())
}

impl Tool {
    /// What it is, without its path.
    pub fn body(&self) -> body::Tool {
        let Self { name, shape, contact, .. } = self.clone();
        body::Tool { name, shape, contact }
    }

    /// Where it is at a time after the first frame (s).
    pub fn pose(&self, time: f64) -> Pose {
        path::at(&self.keyframes, time)
    }

    /// Distance from its position of the farthest point of its surface that lies in a domain of this size (domain lengths).
    pub(super) fn reach_in(&self, [width, height]: [f32; 2]) -> f32 {
        self.shape.reach().min((width * width + height * height).sqrt())
    }

    /// The largest speed of its surface on its way in a domain of this size (domain lengths per s).
    pub(super) fn fastest(&self, domain: [f32; 2]) -> f32 {
        let reach = self.reach_in(domain);
        let pairs = self.keyframes.windows(2);
        let motions = pairs.map(|pair| {
            Motion { start: pair[0].pose(), end: pair[1].pose() }.speed(reach)
                / (pair[1].time - pair[0].time) as f32
        });
        motions.fold(0.0, f32::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contact_keeps_slides_or_rubs() {
        let of = |contact: Contact, relative: [f32; 2]| met(contact, relative, [0.0, 1.0]);
        let leaves = |contact: Contact| of(contact, [3.0, 2.0]);
        let met = |contact: Contact| of(contact, [3.0, -2.0]);
        assert_eq!(met(Contact::Sticky), [0.0, 0.0]);
        assert_eq!(met(Contact::Slip), [3.0, 0.0]);
        assert_eq!(met(Contact::Friction(0.75)), [1.5, 0.0]);
        assert_eq!(met(Contact::Friction(1.5)), [0.0, 0.0]);
        assert_eq!(leaves(Contact::Friction(1.5)), [3.0, 2.0]);
        assert_eq!(leaves(Contact::Sticky), [0.0, 0.0]);
    }

    /// The error of a scene with a block in the middle and these tools.
    fn error(tools: &str) -> String {
        let scene = format!(
            r#"{{"bodies": [{{"material": "jelly", "shape": {{"rectangle": {{"size": [0.2, 0.2]}}}},
                "position": [0.5, 0.5]}}], "tools": [{tools}]}}"#
        );
        match serde_json::from_str::<Scene>(&scene) {
            Ok(scene) => scene.particles().unwrap_err().to_string(),
            Err(error) => error.to_string(),
        }
    }

    /// A disc of this name there.
    fn disc(name: &str, x: f32) -> String {
        format!(
            r#"{{"name": "{name}", "shape": {{"disc": {{"radius": 0.05}}}},
            "keyframes": [{{"time": 0.0, "position": [{x}, 0.2]}}]}}"#
        )
    }

    #[test]
    fn tools_that_cannot_be_together_are_named() {
        let many: Vec<String> = (0..9).map(|k| disc(&k.to_string(), 0.1 * k as f32)).collect();
        for (tools, expected) in [
            (many.join(","), "tools: found 9, expected at most 8"),
            (disc("", 0.2), "tools[0].name: found an empty name, expected a name"),
            (
                disc("a", 0.2) + "," + &disc("a", 0.4),
                "tools[1].name: found \"a\", the name of another tool, expected",
            ),
            (
                disc("a", 0.2) + "," + &disc("b", 0.29),
                "tools[1]: found a tool that overlaps tools[0] at the start",
            ),
            (disc("a", 1.2), "keyframes[0].position: found [1.2, 0.2], outside the domain"),
        ] {
            let found = error(&tools);
            assert!(found.contains(expected), "{found}, expected {expected}");
        }
    }

    #[test]
    fn tools_that_cannot_be_are_named_with_found_and_expected() {
        const PLACE: &str = r#"{"time": 0, "position": [0.2, 0.2]}"#;
        const TWICE: &str =
            r#"{"time": 0, "position": [0.2, 0.2]}, {"time": 0, "position": [0.3, 0.2]}"#;
        const CROSSED: &str =
            r#"{"polygons": {"corners": [[[0, 0], [0.1, 0.1], [0.1, 0], [0, 0.1]]]}}"#;
        let in_matter = r#"{"time": 0, "position": [0.6, 0.5]}"#;
        let in_space = r#"{"time": 0, "position": [0.6, 0.5, 0.1]}"#;
        let (plane, disc) = (r#""half_plane""#, r#"{"disc": {"radius": 0.1}}"#);
        let slip = r#""slip""#;
        for (shape, contact, keyframes, expected) in [
            (r#"{"disc": {"radius": 0}}"#, slip, PLACE, "shape.disc.radius: found 0, expected"),
            (r#"{"disc": {"radius": 1e9}}"#, slip, PLACE, "a positive number up to 1e4"),
            (CROSSED, slip, PLACE, "shape.polygons.corners[0]: found a corner at"),
            (plane, r#"{"friction": -1}"#, PLACE, "tools[0].contact.friction: found -1"),
            (plane, slip, "", "tools[0].keyframes: found none, expected at least one"),
            (plane, slip, TWICE, "tools[0].keyframes[1].time: found 0 after 0"),
            (disc, slip, in_matter, "inside it at the start, the first of bodies[0]"),
            (plane, slip, in_space, "found 3 numbers, expected 2"),
        ] {
            let found = error(&format!(
                r#"{{"name": "tool", "shape": {shape}, "contact": {contact}, "keyframes": [{keyframes}]}}"#
            ));
            assert!(found.contains(expected), "{found}, expected {expected}");
        }
    }

    #[test]
    fn a_tool_that_is_faster_than_matter_makes_substeps_shorter() {
        let fastest = |end: f32| {
            Tool {
                name: "tool".into(),
                shape: Outline::Rectangle { size: [0.6, 0.8] },
                contact: Contact::Slip,
                keyframes: vec![
                    Keyframe { time: 0.0, position: [0.2, 0.2], angle_degrees: 0.0 },
                    Keyframe { time: 0.1, position: [0.5, 0.2], angle_degrees: end },
                ],
            }
            .fastest([1.0; 2])
        };
        assert!((fastest(0.0) - 3.0).abs() < 1e-5);
        assert!((fastest(180.0) - 3.0 - 0.5 * std::f32::consts::PI / 0.1).abs() < 1e-4);
    }
}
