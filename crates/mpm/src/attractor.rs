//! A point attractor that acts before the recording, so that scenes start from varied states.

use serde::{Deserialize, Serialize};

use super::{
    error::MpmError,
    scene::{finite, positive},
};
use eddy_frames::plane;

/// Maximum duration (frame intervals).
const MAX_FRAMES: u32 = 1000;
/// Distance below which the pull fades to zero at the centre (domain lengths).
pub(super) const CORE: f32 = 0.05;

/// A point attractor: a pull of constant magnitude towards one point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Attractor {
    /// The point (domain lengths).
    #[serde(deserialize_with = "plane::pair")]
    pub centre: [f32; 2],
    /// Acceleration far from the point (domain lengths per s^2).
    pub strength: f32,
    /// Duration (frame intervals).
    pub frames: u32,
    /// Period along x at which the point repeats in wide domains (domain lengths): the nearest copy pulls; a single point
    /// by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub period: Option<f32>,
}

impl Attractor {
    /// Checks the numbers.
    pub(super) fn check(&self) -> Result<(), MpmError> {
        let Self { centre, strength, frames, period } = *self;
        positive("attractor.period", period.unwrap_or(1.0).into(), f64::MAX)?;
        if frames > MAX_FRAMES {
            return Err(MpmError::Field {
                field: "attractor.frames".into(),
                found: frames.to_string(),
                expected: format!("at most {MAX_FRAMES}"),
            });
        }
        for (name, number) in [("centre", centre[0]), ("centre", centre[1]), ("strength", strength)]
        {
            finite(&format!("attractor.{name}"), number.into())?;
        }
        Ok(())
    }

    /// Acceleration at a position (domain lengths per s^2).
    pub fn acceleration(&self, position: [f32; 2]) -> [f32; 2] {
        let mut towards = [self.centre[0] - position[0], self.centre[1] - position[1]];
        if let Some(period) = self.period {
            towards[0] -= period * (towards[0] / period).round();
        }
        let distance = (towards[0] * towards[0] + towards[1] * towards[1]).sqrt();
        let scale = self.strength / (CORE + distance);
        [towards[0] * scale, towards[1] * scale]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_pulls_towards_its_centre_and_not_at_its_centre() {
        let attractor = Attractor { centre: [0.5, 0.5], strength: 10.0, frames: 1, period: None };
        assert_eq!(attractor.acceleration([0.5, 0.5]), [0.0, 0.0]);
        let [x, y] = attractor.acceleration([0.1, 0.5]);
        assert!(x > 8.0 && x < 10.0 && y == 0.0);
    }

    #[test]
    fn a_periodic_attractor_pulls_towards_the_nearest_copy() {
        let attractor =
            Attractor { centre: [0.5, 0.5], strength: 10.0, frames: 1, period: Some(2.0) };
        for centre in [0.5, 2.5, 8.5] {
            assert_eq!(attractor.acceleration([centre, 0.5]), [0.0, 0.0]);
            assert!(attractor.acceleration([centre - 0.9, 0.5])[0] > 9.0);
            assert!(attractor.acceleration([centre + 0.9, 0.5])[0] < -9.0);
        }
    }
}
