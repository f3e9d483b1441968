//! Bodies: one material in one shape, on a square lattice of particles.

use serde::{Deserialize, Serialize};

use super::{error::MpmError, scene::finite, shape::Shape};
use eddy_frames::{Material, plane};

/// Shape, material and initial motion of a body.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Body {
    /// Its material.
    pub material: Material,
    /// Its outline.
    pub shape: Shape,
    /// Its centre, or the origin of its points (domain lengths).
    #[serde(deserialize_with = "plane::pair")]
    pub position: [f32; 2],
    /// Counter-clockwise rotation about its position (degrees); 0 by default.
    #[serde(default)]
    pub angle_degrees: f32,
    /// Its velocity (domain lengths per second); at rest by default.
    #[serde(default, deserialize_with = "plane::pair")]
    pub velocity: [f32; 2],
    /// Number of particles to keep of those that fill the shape; all by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub particles: Option<usize>,
}

impl Body {
    /// Checks the numbers; `field` is the body's name in its file.
    pub(super) fn check(&self, field: &str) -> Result<(), MpmError> {
        if let Some((name, found, expected)) = self.shape.invalid() {
            return Err(MpmError::Field {
                field: format!("{field}.{name}"),
                found,
                expected: expected.into(),
            });
        }
        let ([x, y], [u, v]) = (self.position, self.velocity);
        for (name, number) in [
            ("position", x),
            ("position", y),
            ("angle_degrees", self.angle_degrees),
            ("velocity", u),
            ("velocity", v),
        ] {
            finite(&format!("{field}.{name}"), number.into())?;
        }
        Ok(())
    }

    /// Initial positions of the particles, `spacing` apart (domain lengths).
    pub fn positions(&self, spacing: f32) -> Vec<[f32; 2]> {
        self.placed(&self.lattice(spacing))
    }

    /// Positions of the particles in the frame of the body.
    pub(super) fn lattice(&self, spacing: f32) -> Vec<[f32; 2]> {
        let mut points = self.shape.lattice(spacing);
        points.truncate(self.particles.unwrap_or(usize::MAX));
        points
    }

    /// Transforms points from the frame of the body to the domain.
    pub(super) fn placed(&self, points: &[[f32; 2]]) -> Vec<[f32; 2]> {
        let (sin, cos) = self.angle_degrees.to_radians().sin_cos();
        let [x0, y0] = self.position;
        points.iter().map(|[x, y]| [x0 + cos * x - sin * y, y0 + sin * x + cos * y]).collect()
    }

    /// Offsets of `times`^2 particles that take the place of one of its lattice, `spacing` apart (domain lengths).
    pub(super) fn offsets(
        &self,
        spacing: f32,
        times: u32,
    ) -> impl Iterator<Item = [f32; 2]> + use<> {
        let (sin, cos) = self.angle_degrees.to_radians().sin_cos();
        let along =
            move |number: u32| spacing * (number as f32 - 0.5 * (times - 1) as f32) / times as f32;
        (0..times)
            .flat_map(move |i| (0..times).map(move |j| [along(i), along(j)]))
            .map(move |[x, y]| [cos * x - sin * y, sin * x + cos * y])
    }

    /// Whether a position lies in its outline.
    pub(super) fn contains(&self, position: [f32; 2]) -> bool {
        let (sin, cos) = f64::from(self.angle_degrees).to_radians().sin_cos();
        let [x, y] = [0, 1].map(|k| f64::from(position[k]) - f64::from(self.position[k]));
        self.shape.contains([cos * x + sin * y, cos * y - sin * x])
    }

    /// Approximate number of points in its shape, of which it may keep fewer.
    pub(super) fn estimate(&self, spacing: f32) -> f64 {
        self.shape.estimate(spacing)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_body_is_rotated_about_its_position_and_truncated_to_its_number_of_particles() {
        let body = Body {
            material: Material::Jelly,
            shape: Shape::Rectangle { size: [0.3, 0.1] },
            position: [0.5, 0.25],
            angle_degrees: 90.0,
            velocity: [0.0; 2],
            particles: Some(2),
        };
        let near = |a: [f32; 2], b: [f32; 2]| (a[0] - b[0]).hypot(a[1] - b[1]) < 1e-6;
        let positions = body.positions(0.1);
        assert_eq!(positions.len(), 2);
        assert!(near(positions[0], [0.5, 0.15]) && near(positions[1], [0.5, 0.25]));
        assert!(body.contains([0.5, 0.15]) && !body.contains([0.4, 0.25]));
    }
}
