//! What a frame and a stream may be. Whoever reads frames asks here, so that a model is trained on what it can predict.

use std::fmt;

use super::{AnyDomain, Coordinates, Domain, FrameView, Material, Particles, Stamp, decimal};

/// Largest accepted distance of a particle from any wall of its domain (widths or heights of the domain). Solvers leave a
/// few particles slightly outside.
const MAX_REACH: f32 = 1.1;

/// Largest accepted distance that a particle would travel until the next frame (widths or heights of the domain): with more,
/// frames say nothing about the motion.
const MAX_CROSSINGS: f32 = 2.0;

/// A stamp more than this many intervals in the past means that the stream restarted (a looped bag).
const RESTART_INTERVALS: u32 = 16;

/// Nanoseconds in a second.
const NANOSECONDS: i64 = 1_000_000_000;

/// Why data is not a valid frame, or not a plausible one, or does not belong to its stream.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the message says what the fields are")]
pub enum InvalidFrame {
    /// A corner of the domain does not have as many coordinates as the frames that are expected.
    #[error("{field}: found {found} dimensions, expected {expected}")]
    Dimension { field: &'static str, found: usize, expected: String },
    /// The domain is empty or not finite.
    #[error("lower, upper: found {found}, expected finite corners with lower < upper")]
    Domain { found: AnyDomain },
    /// The length of an array does not match the number of particles.
    #[error("{field}: found {found} numbers, expected {expected} for {particles} particles")]
    Length { field: &'static str, found: usize, expected: usize, particles: usize },
    /// There are no particles.
    #[error("material: found 0 particles, expected at least 1")]
    Empty,
    /// A number is NaN or infinite.
    #[error("{field}[{particle}]: found {found}, expected a finite number")]
    NotFinite { field: &'static str, particle: usize, found: f32 },
    /// A material number is unknown.
    #[error("material[{particle}]: found {found}, expected {}", Material::numbered())]
    Material { particle: usize, found: u8 },
    /// The sequence number has no successor.
    #[error("sequence: found {found}, expected less than the largest 64-bit number")]
    Sequence { found: u64 },
    /// The interval between frames is not positive.
    #[error("dt: found {found} s, expected a positive number")]
    Interval { found: f32 },
    /// A message cannot hold the stamp.
    #[error(
        "stamp: found {found} ns, expected seconds of 32 bits as in ROS 2: -2147483648 to 2147483647 s"
    )]
    Stamp { found: i64 },
    /// A particle is far outside of the domain; probably the units are wrong.
    #[error(
        "position[{particle}]: found {found}, expected inside the domain {domain}, or outside by at most a tenth of it: units?"
    )]
    Outside { particle: usize, found: Coordinates, domain: AnyDomain },
    /// A particle would cross the domain between two frames; probably the units are wrong.
    #[error(
        "velocity[{particle}]: found {found} domain lengths/s, expected at most {most}: twice through the domain in {dt} s: units?"
    )]
    Fast { particle: usize, found: Coordinates, most: Coordinates, dt: f32 },
    /// What is the same in all frames that are used together differs from most streams.
    #[error("{field}: found {found}, expected {expected} as in most streams")]
    OtherSetup { field: &'static str, found: String, expected: String },
}

impl<const D: usize> FrameView<'_, D> {
    /// Checks that the frame is valid: everything that [`Frame::new`](super::Frame::new) checks, except the lengths of
    /// arrays.
    ///
    /// # Errors
    /// [`InvalidFrame`] with the first fault.
    pub fn check(&self) -> Result<(), InvalidFrame> {
        let Self { sequence, stamp, dt, domain, particles, .. } = self;
        if let Particles::Rows(_) = particles {
            for particle in 0..particles.len() {
                particles
                    .material(particle)
                    .map_err(|found| InvalidFrame::Material { particle, found })?;
            }
        }
        if particles.is_empty() {
            return Err(InvalidFrame::Empty);
        }
        if *sequence == u64::MAX {
            return Err(InvalidFrame::Sequence { found: *sequence });
        }
        if i32::try_from(stamp.0.div_euclid(NANOSECONDS)).is_err() {
            return Err(InvalidFrame::Stamp { found: stamp.0 });
        }
        if !domain.is_valid() {
            return Err(InvalidFrame::Domain { found: (*domain).into() });
        }
        if !(dt.is_finite() && *dt > 0.0) {
            return Err(InvalidFrame::Interval { found: *dt });
        }
        let motions = || (0..particles.len()).map(|particle| particles.motion(particle));
        first_not_finite("position", motions().map(|motion| motion.0))?;
        first_not_finite("velocity", motions().map(|motion| motion.1))
    }

    /// Checks that a valid frame shows a plausible simulation: particles in the domain, or just outside, that do not cross it
    /// within a frame. What a model is trained on or predicts from must be; a prediction that diverges is not.
    ///
    /// # Errors
    /// [`InvalidFrame::Outside`], [`InvalidFrame::Fast`] with the first such particle.
    pub fn check_plausible(&self) -> Result<(), InvalidFrame> {
        let Self { dt, domain, particles, .. } = *self;
        let Domain { lower, upper } = domain;
        let extent = domain.extent();
        let per_length = extent.map(|extent| 1.0 / extent);
        let most = extent.map(|extent| MAX_CROSSINGS * extent / dt);
        let is_outside = |position: [f32; D]| {
            (0..D).fold(false, |outside, axis| {
                let x = (position[axis] - lower[axis]).max(upper[axis] - position[axis]);
                outside | (x * per_length[axis] > MAX_REACH)
            })
        };
        let is_fast = |velocity: [f32; D]| {
            (0..D).fold(false, |fast, axis| fast | (velocity[axis].abs() > most[axis]))
        };
        let motions = || (0..particles.len()).map(|particle| particles.motion(particle));
        // Without a branch per particle: nearly always, there is nothing to find.
        let (mut outside, mut fast) = (false, false);
        for (position, velocity) in motions() {
            outside |= is_outside(position);
            fast |= is_fast(velocity);
        }
        if outside {
            let particle = motions().position(|(position, _)| is_outside(position));
            let particle = particle.unwrap_or_default();
            let (found, domain) = (particles.motion(particle).0.into(), domain.into());
            return Err(InvalidFrame::Outside { particle, found, domain });
        }
        if fast {
            let particle = motions().position(|(_, velocity)| is_fast(velocity));
            let particle = particle.unwrap_or_default();
            let found = particles.motion(particle).1.into();
            // As it is printed: 125, not 124.99999.
            let most = extent
                .map(|extent| (f64::from(MAX_CROSSINGS) * decimal(extent) / decimal(dt)) as f32);
            return Err(InvalidFrame::Fast { particle, found, most: most.into(), dt });
        }
        Ok(())
    }
}

fn first_not_finite<const D: usize>(
    field: &'static str,
    vectors: impl Iterator<Item = [f32; D]>,
) -> Result<(), InvalidFrame> {
    let found = vectors
        .enumerate()
        .find_map(|(particle, v)| v.into_iter().find(|x| !x.is_finite()).map(|x| (particle, x)));
    match found {
        None => Ok(()),
        Some((particle, found)) => Err(InvalidFrame::NotFinite { field, particle, found }),
    }
}

impl Stamp {
    /// Whether a stream restarted between this frame and the next one, which is stamped `next`: as in a looped bag.
    pub fn restarts_at(self, next: Self, dt: f32) -> bool {
        let reach = Self(0).advance(dt, RESTART_INTERVALS).0;
        next.0 < self.0.saturating_sub(reach)
    }
}

/// Checks that two frames can be used together: that they have the same interval and domain.
///
/// # Errors
/// [`InvalidFrame::OtherSetup`] if not.
pub fn same_setup<const D: usize>(
    found: (f32, Domain<D>),
    expected: (f32, Domain<D>),
) -> Result<(), InvalidFrame> {
    let other = |field, found: &dyn fmt::Display, expected: &dyn fmt::Display| {
        let (found, expected) = (found.to_string(), expected.to_string());
        Err(InvalidFrame::OtherSetup { field, found, expected })
    };
    if found.0 != expected.0 {
        return other("dt", &format_args!("{} s", found.0), &format_args!("{} s", expected.0));
    }
    if found.1 != expected.1 {
        return other("lower, upper", &found.1, &expected.1);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Frame, Material};

    fn frame() -> Frame {
        Frame {
            stream: 1,
            sequence: 0,
            stamp: Stamp(0),
            dt: 0.016,
            domain: Domain { lower: [-1.0, 0.0], upper: [3.0, 2.0] },
            position: vec![[0.5, 0.5], [2.5, 1.5]],
            velocity: vec![[0.0, -1.0], [1.0, 0.0]],
            material: vec![Material::Liquid, Material::Rope],
        }
    }

    #[test]
    fn a_particle_may_be_outside_by_a_tenth_of_the_domain() {
        let mut frame = frame();
        frame.position[1] = [3.39, -0.19];
        assert_eq!(frame.check_plausible(), Ok(()));
        frame.position[1] = [3.39, -0.21];
        assert_eq!(
            frame.check_plausible().unwrap_err().to_string(),
            "position[1]: found 3.39, -0.21, expected inside the domain -1 to 3 x 0 to 2, or outside by at most a tenth \
             of it: units?"
        );
    }

    #[test]
    fn a_particle_does_not_cross_its_domain_twice_in_a_frame() {
        let mut frame = frame();
        frame.velocity[0] = [499.0, -249.0];
        assert_eq!(frame.check_plausible(), Ok(()));
        frame.velocity[0] = [0.0, -251.0];
        assert_eq!(
            frame.check_plausible().unwrap_err().to_string(),
            "velocity[0]: found 0, -251 domain lengths/s, expected at most 500, 250: twice through the domain in 0.016 s: \
             units?"
        );
    }

    #[test]
    fn a_stamp_fits_into_a_message() {
        let at = |seconds: i64| Frame { stamp: Stamp(seconds * NANOSECONDS), ..frame() }.check();
        assert_eq!(at(i64::from(i32::MIN)), Ok(()));
        assert_eq!(at(i64::from(i32::MAX)), Ok(()));
        let message = at(i64::from(i32::MAX) + 1).unwrap_err().to_string();
        assert!(message.starts_with("stamp: found 2147483648000000000 ns, expected"), "{message}");
    }

    #[test]
    fn a_domain_of_which_the_size_is_not_finite_is_invalid() {
        let domain = Domain { lower: [f32::MIN; 2], upper: [f32::MAX; 2] };
        assert!(!domain.is_valid());
        assert!(!Domain { lower: [0.0; 2], upper: [1.0, 0.0] }.is_valid());
        assert!(!Domain { lower: [f32::NAN; 2], upper: [1.0; 2] }.is_valid());
    }

    #[test]
    fn frames_that_are_used_together_have_one_domain_and_interval() {
        let wide = Domain { upper: [2.0, 1.0], ..Domain::UNIT };
        let setup = (0.016, Domain::UNIT);
        assert_eq!(same_setup(setup, setup), Ok(()));
        assert_eq!(
            same_setup((0.016, wide), setup).unwrap_err().to_string(),
            "lower, upper: found 0 to 2 x 0 to 1, expected 0 to 1 x 0 to 1 as in most streams"
        );
        assert_eq!(
            same_setup((0.02, wide), setup).unwrap_err().to_string(),
            "dt: found 0.02 s, expected 0.016 s as in most streams"
        );
    }

    #[test]
    fn stamps_far_in_the_past_restart_a_stream() {
        let dt = 0.016;
        let last = Stamp(0).advance(dt, 20);
        assert!(!last.restarts_at(Stamp(0).advance(dt, 4), dt));
        assert!(last.restarts_at(Stamp(0).advance(dt, 3), dt));
        assert!(!Stamp(i64::MIN).restarts_at(Stamp(i64::MIN), dt));
    }
}
