//! Bodies: so many particles of one material in one shape, on a square lattice.

use serde::{Deserialize, Serialize};

use crate::frame::Material;

/// The outline of a body. Its size follows from the number of particles and their spacing.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// A disc.
    Disc,
    /// A rectangle so many particles thick; the last column may be shorter.
    Rectangle {
        /// Particles across.
        rows: usize,
    },
}

/// What one body is, and where it starts.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Body {
    /// What it is made of.
    pub material: Material,
    /// Its outline.
    pub shape: Shape,
    /// How many particles it has.
    pub particles: usize,
    /// Its middle (domain lengths).
    pub centre: [f32; 2],
    /// Angle of its long side with x (rad).
    pub angle: f32,
    /// Its velocity (domain lengths per second).
    pub velocity: [f32; 2],
}

impl Body {
    /// Where the particles start, `spacing` apart (domain lengths).
    pub fn positions(&self, spacing: f32) -> Vec<[f32; 2]> {
        let (sin, cos) = self.angle.sin_cos();
        lattice(self.shape, self.particles)
            .into_iter()
            .map(|[x, y]| {
                let (x, y) = (x * spacing, y * spacing);
                [self.centre[0] + cos * x - sin * y, self.centre[1] + sin * x + cos * y]
            })
            .collect()
    }
}

/// Exactly `particles` points of the unit square lattice in a shape around the origin.
fn lattice(shape: Shape, particles: usize) -> Vec<[f32; 2]> {
    match shape {
        Shape::Disc => disc(particles),
        Shape::Rectangle { rows } => {
            let columns = particles.div_ceil(rows);
            let middle = |count: usize| 0.5 * (count as f32 - 1.0);
            (0..particles)
                .map(|k| [(k / rows) as f32 - middle(columns), (k % rows) as f32 - middle(rows)])
                .collect()
        }
    }
}

/// The lattice points nearest to the origin.
fn disc(particles: usize) -> Vec<[f32; 2]> {
    let radius = (particles as f32 / std::f32::consts::PI).sqrt() as i32 + 2;
    let mut points: Vec<(i32, i32, i32)> = (-radius..=radius)
        .flat_map(|i| (-radius..=radius).map(move |j| (i * i + j * j, i, j)))
        .collect();
    points.sort_unstable();
    points.truncate(particles);
    points.into_iter().map(|(_, i, j)| [i as f32, j as f32]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_have_exactly_the_particles_they_are_asked_for() {
        for particles in [1, 2, 7, 625, 2500] {
            assert_eq!(disc(particles).len(), particles);
            assert_eq!(lattice(Shape::Rectangle { rows: 6 }, particles).len(), particles);
        }
    }

    #[test]
    fn a_disc_is_round() {
        let radius = (2500.0 / std::f32::consts::PI).sqrt();
        let farthest = disc(2500).iter().map(|[x, y]| x.hypot(*y)).fold(0.0, f32::max);
        assert!((farthest - radius).abs() < 1.0, "found {farthest}, expected about {radius}");
    }
}
