//! Emitters and drains: particles that enter and leave while a scene runs.
//!
//! The number of particles then changes between frames of the stream, which is valid: a surrogate node resets at such a
//! change, and a data set splits the stream there.

use serde::{Deserialize, Serialize};

use super::{
    error::MpmError,
    particle::Particle,
    placement::{inside, interior},
    scene::{Scene, finite, positive},
};
use eddy_frames::{Material, plane};

/// Minimum distance of a new particle from all others (spacings).
const CLEARANCE: f32 = 0.7;

/// A slit that emits rows of particles at a velocity, one row per spacing.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Emitter {
    /// Material of the emitted particles.
    pub material: Material,
    /// Centre of the slit (domain lengths).
    #[serde(deserialize_with = "plane::pair")]
    pub position: [f32; 2],
    /// Length of the slit, across the velocity (domain lengths).
    pub width: f32,
    /// Velocity of the emitted particles (domain lengths per second).
    #[serde(deserialize_with = "plane::pair")]
    pub velocity: [f32; 2],
    /// Maximum total number of emitted particles.
    pub particles: u32,
}

/// A box that removes the particles that enter it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Drain {
    /// Corner with the smallest coordinates (domain lengths).
    #[serde(deserialize_with = "plane::pair")]
    pub lower: [f32; 2],
    /// Corner with the largest coordinates (domain lengths).
    #[serde(deserialize_with = "plane::pair")]
    pub upper: [f32; 2],
}

impl Emitter {
    /// Speed of the emitted particles (domain lengths per second).
    pub(super) fn speed(&self) -> f32 {
        self.velocity[0].hypot(self.velocity[1])
    }

    /// Checks the numbers; `field` is the emitter's name in its file.
    pub(super) fn check(&self, field: &str, scene: &Scene) -> Result<(), MpmError> {
        positive(&format!("{field}.width"), self.width.into(), f64::MAX)?;
        positive(&format!("{field}.velocity"), self.speed().into(), f64::MAX)?;
        positive(&format!("{field}.particles"), self.particles.into(), f64::MAX)?;
        let room = interior(scene.grid()?);
        let reach = self.speed() * scene.frames.interval;
        let end = 0.5 * (self.width - scene.spacing()).max(0.0);
        let mut outside =
            [-end, end].into_iter().flat_map(|across| [0.0, reach].map(|x| self.place(x, across)));
        if let Some(found) = outside.find(|&position| !inside(room, position)) {
            return Err(MpmError::Field {
                field: format!("{field}.position"),
                found: format!("a particle at {found:?}"),
                expected: format!("all between the walls, {:?} to {:?}", room[0], room[1]),
            });
        }
        Ok(())
    }

    /// Positions of a row at a distance `along` from the slit (domain lengths).
    fn row(&self, along: f32, spacing: f32) -> impl Iterator<Item = [f32; 2]> {
        // The cast saturates.
        let count = (self.width / spacing).round().max(1.0) as u64;
        let middle = 0.5 * (count as f32 - 1.0);
        (0..count).map(move |column| self.place(along, (column as f32 - middle) * spacing))
    }

    /// The position at these distances from the centre of the slit, along and across the velocity (domain lengths).
    fn place(&self, along: f32, across: f32) -> [f32; 2] {
        let [u, v] = self.velocity.map(|x| x / self.speed());
        [self.position[0] + along * u - across * v, self.position[1] + along * v + across * u]
    }
}

impl Drain {
    /// Checks the numbers; `field` is the drain's name in its file.
    pub(super) fn check(&self, field: &str) -> Result<(), MpmError> {
        for number in self.lower.into_iter().chain(self.upper) {
            finite(field, number.into())?;
        }
        if (0..2).all(|axis| self.lower[axis] < self.upper[axis]) {
            return Ok(());
        }
        Err(MpmError::Field {
            field: field.into(),
            found: format!("lower {:?}, upper {:?}", self.lower, self.upper),
            expected: "lower below upper".into(),
        })
    }
}

/// State of the emitters and drains of a scene.
#[derive(Clone, Debug)]
pub(super) struct Flow {
    emitters: Vec<(Emitter, u32)>,
    drains: Vec<Drain>,
    interval: f32,
    spacing: f32,
}

impl Flow {
    /// Nothing emitted yet.
    pub(super) fn new(scene: &Scene) -> Self {
        Self {
            emitters: scene.emitters.iter().map(|&emitter| (emitter, 0)).collect(),
            drains: scene.drains.clone(),
            interval: scene.frames.interval,
            spacing: scene.spacing(),
        }
    }

    /// Removes particles in drains and adds the rows emitted since the frame before `frame`, at their current positions.
    /// `None` if nothing changes; otherwise the number of particles changes too, so that consumers of the stream notice.
    pub(super) fn apply(&mut self, frame: u64, particles: &[Particle]) -> Option<Vec<Particle>> {
        let drained = |p: &Particle| {
            self.drains.iter().any(|drain| inside([drain.lower, drain.upper], p.position))
        };
        let mut after: Vec<Particle> = particles.iter().filter(|p| !drained(p)).copied().collect();
        let kept = after.len();
        let removed = particles.len() - kept;
        let (interval, spacing) = (self.interval, self.spacing);
        let mut last = None;
        for (emitter, emitted) in &mut self.emitters {
            let present = after.len();
            let row = arrivals(emitter, frame, interval, spacing)
                .flat_map(|along| emitter.row(along, spacing));
            let free = row.filter(|&position| is_free(position, &after[..present], spacing));
            let most = (emitter.particles - *emitted) as usize;
            let new: Vec<Particle> = free
                .take(most)
                .map(|position| Particle {
                    velocity: emitter.velocity,
                    ..Particle::at_rest(position, emitter.material)
                })
                .collect();
            *emitted += new.len() as u32;
            after.extend(new);
            if after.len() > present {
                last = Some(emitted);
            }
        }
        let added = after.len() - kept;
        if added == removed && added > 0 {
            // Keep one back: an unchanged number would hide that the particles have changed.
            after.pop();
            if let Some(emitted) = last {
                *emitted -= 1;
            }
        }
        (added > 0 || removed > 0).then_some(after)
    }
}

/// Distances from the slit of the rows emitted since the previous frame (domain lengths).
fn arrivals(
    emitter: &Emitter,
    frame: u64,
    interval: f32,
    spacing: f32,
) -> impl Iterator<Item = f32> + use<> {
    let moved = |frames: u64| f64::from(emitter.speed()) * f64::from(interval) * frames as f64;
    let spacing = f64::from(spacing);
    let rows = |frames: u64| (moved(frames) / spacing).floor() as u64 + 1;
    let (now, before) = (moved(frame), frame.checked_sub(1).map_or(0, rows));
    (before..rows(frame)).map(move |row| (now - row as f64 * spacing) as f32)
}

fn is_free([x, y]: [f32; 2], particles: &[Particle], spacing: f32) -> bool {
    particles.iter().all(|p| (p.position[0] - x).hypot(p.position[1] - y) >= CLEARANCE * spacing)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPACING: f32 = 1.0 / 128.0;

    fn emitter(particles: u32) -> Emitter {
        let (position, velocity) = ([0.5, 0.5], [0.0, -1.0]);
        Emitter { material: Material::Liquid, position, width: 4.0 * SPACING, velocity, particles }
    }

    fn flow(emitters: Vec<Emitter>, drains: Vec<Drain>) -> Flow {
        Flow::new(&Scene { emitters, drains, ..Scene::default() })
    }

    #[test]
    fn rows_leave_the_slit_a_spacing_apart_at_any_frame_interval() {
        let mut flow = flow(vec![emitter(1000)], Vec::new());
        let mut particles: Vec<Particle> = Vec::new();
        for frame in 0..20 {
            for particle in &mut particles {
                particle.position[1] -= 0.016;
            }
            particles = flow.apply(frame, &particles).unwrap_or(particles);
        }
        let mut heights: Vec<f32> = particles.iter().map(|p| p.position[1]).collect();
        heights.sort_by(f32::total_cmp);
        // 19 frames of 0.016 at speed 1 are 38.9 spacings.
        assert_eq!(particles.len(), 39 * 4);
        for rows in heights.windows(5).step_by(4) {
            assert!((rows[4] - rows[0] - SPACING).abs() < 1e-5, "{rows:?}");
        }
    }

    #[test]
    fn a_slit_that_is_blocked_or_exhausted_emits_nothing() {
        let mut blocked = flow(vec![emitter(1000)], Vec::new());
        let wall: Vec<Particle> = emitter(1)
            .row(0.0, SPACING)
            .map(|position| Particle::at_rest(position, Material::Snow))
            .collect();
        assert_eq!(blocked.apply(0, &wall), None);

        let mut short = flow(vec![emitter(3)], Vec::new());
        assert_eq!(short.apply(0, &[]).unwrap().len(), 3);
        assert_eq!(short.apply(100, &[]), None);
    }

    #[test]
    fn a_slit_that_reaches_into_a_wall_is_rejected() {
        let check = |emitter: Emitter, spacing: f32| {
            let scene = Scene { spacing: Some(spacing), ..Scene::default() };
            emitter.check("emitters[0]", &scene).map_err(|error| error.to_string())
        };
        assert_eq!(check(emitter(1), SPACING), Ok(()));
        let wide = Emitter { width: 1e9, ..emitter(1) };
        for spacing in [SPACING, SPACING / 32.0] {
            let message = check(wide, spacing).unwrap_err();
            assert!(message.starts_with("emitters[0].position: found a particle at"), "{message}");
        }
        let still = Emitter { velocity: [0.0; 2], ..emitter(1) };
        assert_eq!(
            check(still, SPACING).unwrap_err(),
            "emitters[0].velocity: found 0, expected a positive number"
        );
    }

    #[test]
    fn drains_remove_particles_and_every_change_alters_the_number() {
        let drain = Drain { lower: [0.0; 2], upper: [1.0, 0.1] };
        let mut flow = flow(vec![emitter(1000)], vec![drain]);
        let at = |y| Particle::at_rest([0.5, y], Material::Liquid);
        let before: Vec<Particle> = [0.05, 0.05, 0.05, 0.05, 0.2].map(at).to_vec();
        let after = flow.apply(0, &before).unwrap();
        assert_eq!(after.len(), 4, "four removed, three of four added");
        assert!(after.iter().all(|p| p.position[1] > 0.1));
    }
}
