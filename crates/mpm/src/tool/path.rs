//! Paths of tools: poses by time, and the motion between two of them.

use serde::{Deserialize, Serialize};

use super::{
    super::{error::MpmError, scene::finite},
    Pose,
};
use eddy_frames::plane;

/// Where a tool is at a time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Keyframe {
    /// Time after the first frame (s).
    pub time: f64,
    /// Position of the origin of its outline (domain lengths).
    #[serde(deserialize_with = "plane::pair")]
    pub position: [f32; 2],
    /// Counter-clockwise rotation about it (degrees); 0 by default. 360 more are a whole turn.
    #[serde(default)]
    pub angle_degrees: f32,
}

impl Keyframe {
    pub(super) fn pose(&self) -> Pose {
        Pose { position: self.position, angle: self.angle_degrees.to_radians() }
    }
}

/// The motion of a tool in an interval: uniform from its start to its end.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Pose at its start.
    pub start: Pose,
    /// Pose at its end.
    pub end: Pose,
}

impl Motion {
    /// A tool at rest.
    pub fn rest(pose: Pose) -> Self {
        Self { start: pose, end: pose }
    }

    /// The pose after a share of the interval, 0 to 1.
    pub(in super::super) fn at(&self, share: f32) -> Pose {
        let Self { start, end } = *self;
        let between = |from: f32, to: f32| from + share * (to - from);
        Pose {
            position: [0, 1].map(|k| between(start.position[k], end.position[k])),
            angle: between(start.angle, end.angle),
        }
    }

    /// The same in coordinates with another origin.
    pub(in super::super) fn shifted(self, by: f32) -> Self {
        let shifted = |pose: Pose| Pose { position: pose.position.map(|x| x + by), ..pose };
        Self { start: shifted(self.start), end: shifted(self.end) }
    }

    /// The way of the point of its outline that is fastest, at most `reach` from the origin (domain lengths).
    pub(in super::super) fn speed(&self, reach: f32) -> f32 {
        let Self { start, end } = *self;
        let [x, y] = [0, 1].map(|k| end.position[k] - start.position[k]);
        (x * x + y * y).sqrt() + (end.angle - start.angle).abs() * reach
    }
}

/// Checks keyframes; `field` is their name in the file.
pub(super) fn check(keyframes: &[Keyframe], field: &str) -> Result<(), MpmError> {
    let wrong = |field: String, found: String, expected: &str| {
        Err(MpmError::Field { field, found, expected: expected.into() })
    };
    if keyframes.is_empty() {
        return wrong(field.into(), "none".into(), "at least one: where the tool is");
    }
    for (index, keyframe) in keyframes.iter().enumerate() {
        let [x, y] = keyframe.position.map(f64::from);
        let numbers = [("time", keyframe.time), ("position", x), ("position", y)];
        for (name, number) in
            numbers.into_iter().chain([("angle_degrees", keyframe.angle_degrees.into())])
        {
            finite(&format!("{field}[{index}].{name}"), number)?;
        }
    }
    for (index, pair) in keyframes.windows(2).enumerate() {
        if pair[1].time <= pair[0].time {
            let found = format!("{} after {}", pair[1].time, pair[0].time);
            return wrong(
                format!("{field}[{}].time", index + 1),
                found,
                "a later time than before: a tool does not jump",
            );
        }
    }
    Ok(())
}

/// Where a tool is at a time.
pub(super) fn at(keyframes: &[Keyframe], time: f64) -> Pose {
    let next = keyframes.partition_point(|keyframe| keyframe.time <= time);
    match (next.checked_sub(1).map(|last| &keyframes[last]), keyframes.get(next)) {
        (Some(last), Some(next)) => {
            let share = (time - last.time) / (next.time - last.time);
            Motion { start: last.pose(), end: next.pose() }.at(share as f32)
        }
        (Some(only), None) | (None, Some(only)) => only.pose(),
        (None, None) => unreachable!("`check` refuses paths without keyframes"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tools_rest_before_and_after_their_path_and_move_uniformly_on_it() {
        let keyframe =
            |time, x, angle_degrees| Keyframe { time, position: [x, 0.5], angle_degrees };
        let path = [keyframe(1.0, 0.2, 0.0), keyframe(2.0, 0.6, 180.0)];
        for (time, x, degrees) in [
            (0.0, 0.2, 0.0),
            (1.0, 0.2, 0.0),
            (1.25, 0.3, 45.0),
            (2.0, 0.6, 180.0),
            (9.0, 0.6, 180.0),
        ] {
            let Pose { position, angle } = at(&path, time);
            assert!((position[0] - x).abs() < 1e-6 && position[1] == 0.5, "{time}: {position:?}");
            assert!((angle.to_degrees() - degrees).abs() < 1e-4, "{time}: {angle}");
        }
    }
}
