//! Frames: all particles of a simulation at one instant.
//!
//! Data from outside becomes a [`Frame`] through [`Frame::new`], which checks that lengths agree, every number is finite
//! and every material is known. An [`InvalidFrame`] names the field, the value found and the value expected. Fields are
//! public and predictions may diverge: predicted frames are checked with [`Frame::check`] before they are published. A
//! [`FrameView`] reads a frame in place.
//!
//! Frames are of two or three dimensions, which is part of their type: what knows two writes `Frame`, what knows both is generic. Where
//! the dimension is only known from the data, [`AnyFrame`] has one of the two.
//!
//! [`tool`] has the rigid bodies that move in the same domain.
//!
//! What a model is trained on or predicts from must also be plausible ([`FrameView::check_plausible`]), and frames that
//! are used together have one setup ([`same_setup`]): `valid` has these rules, whoever reads the frames.

mod any;
pub mod clock;
pub mod date;
pub mod palette;
pub mod plane;
pub mod progress;
mod state;
pub mod tool;
mod valid;
mod view;

pub use any::{AnyDomain, AnyFrame, Coordinates};
pub use state::{State, distance, mean_squared_distance, spatial, squared_distance};
pub use valid::{InvalidFrame, same_setup};
pub use view::{FrameView, Particle, Particles};

use std::{fmt, io::Write as _};

use serde::{Deserialize, Serialize};

/// Simulation time, in nanoseconds since the start of the simulation's clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Stamp(pub i64);

/// Nanoseconds in a second.
const NANOSECONDS: f64 = 1e9;

impl Stamp {
    /// The stamp `seconds` after zero, to the nearest nanosecond.
    pub fn from_seconds(seconds: f64) -> Self {
        Self((seconds * NANOSECONDS).round() as i64)
    }

    /// Seconds since zero.
    pub fn seconds(self) -> f64 {
        self.0 as f64 / NANOSECONDS
    }

    /// The stamp `steps` intervals of `dt` seconds later. The interval is rounded to whole
    /// nanoseconds first, so that `advance(dt, 2)` equals two times `advance(dt, 1)`.
    pub fn advance(self, dt: f32, steps: u32) -> Self {
        let interval = (decimal(dt) * NANOSECONDS).round() as i64;
        Self(self.0.saturating_add(interval.saturating_mul(i64::from(steps))))
    }
}

/// A number with its unit in the singular or the plural: `1 scene`, `20 scenes`.
pub fn counted(number: u64, unit: &str) -> String {
    format!("{number} {unit}{}", if number == 1 { "" } else { "s" })
}

/// The shortest decimal number that is `value` as `f32`, as `f64`: 0.016f32 is 0.016, not 0.01599999964.
pub fn decimal(value: f32) -> f64 {
    // Without the allocation of `to_string`; at most nine digits, two signs, a point and an exponent.
    let mut text = [0; 24];
    let mut rest = text.as_mut_slice();
    let written = write!(rest, "{value:e}").is_ok();
    let left = rest.len();
    let length = text.len() - left;
    let digits = str::from_utf8(&text[..length]).ok().filter(|_| written);
    digits.and_then(|digits| digits.parse().ok()).unwrap_or(f64::from(value))
}

/// Material of a particle, with the numbers of `eddy_msgs/msg/ParticleFrame`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[repr(u8)]
pub enum Material {
    /// Weakly compressible, no shear stiffness.
    Liquid = 0,
    /// Elastoplastic: yields, packs and hardens.
    Snow = 1,
    /// Soft elastic solid.
    Jelly = 2,
    /// Stiff elastic strip.
    Rope = 3,
    /// Grains: resist compression, slide where shear exceeds friction, part without resistance.
    Sand = 4,
}

impl Material {
    /// Number of materials.
    pub const COUNT: usize = 5;
    /// Every material, in the order of the numbers.
    pub const ALL: [Self; Self::COUNT] =
        [Self::Liquid, Self::Snow, Self::Jelly, Self::Rope, Self::Sand];

    /// The name in files and tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Liquid => "liquid",
            Self::Snow => "snow",
            Self::Jelly => "jelly",
            Self::Rope => "rope",
            Self::Sand => "sand",
        }
    }

    /// Whether it returns to its shape at rest.
    pub fn keeps_shape(self) -> bool {
        match self {
            Self::Jelly | Self::Rope => true,
            Self::Liquid | Self::Snow | Self::Sand => false,
        }
    }

    /// All numbers with their names: `0 (liquid), 1 (snow), 2 (jelly), 3 (rope) or 4 (sand)`.
    pub fn numbered() -> impl fmt::Display {
        fmt::from_fn(|f| {
            for (number, material) in Self::ALL.into_iter().enumerate() {
                let between = match Self::COUNT - number {
                    Self::COUNT => "",
                    1 => " or ",
                    _ => ", ",
                };
                write!(f, "{between}{number} ({})", material.name())?;
            }
            Ok(())
        })
    }
}

impl TryFrom<u8> for Material {
    type Error = u8;

    fn try_from(number: u8) -> Result<Self, u8> {
        Self::ALL.get(usize::from(number)).copied().ok_or(number)
    }
}

/// The axis-aligned box of `D` dimensions that contains the particles (domain lengths).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(
    deny_unknown_fields,
    bound(serialize = "[f32; D]: Serialize", deserialize = "[f32; D]: Deserialize<'de>")
)]
pub struct Domain<const D: usize = 2> {
    /// Corner with the smallest coordinates.
    pub lower: [f32; D],
    /// Corner with the largest coordinates.
    pub upper: [f32; D],
}

impl Domain {
    /// The unit square of the paper.
    pub const UNIT: Self = Self { lower: [0.0; 2], upper: [1.0; 2] };
}

impl<const D: usize> Domain<D> {
    /// Whether `lower` is below `upper` on all axes, by a finite distance.
    pub fn is_valid(&self) -> bool {
        self.extent().into_iter().all(|extent| extent.is_finite() && extent > 0.0)
    }

    /// Width, height and, in space, depth (domain lengths).
    pub fn extent(&self) -> [f32; D] {
        std::array::from_fn(|axis| self.upper[axis] - self.lower[axis])
    }
}

impl<const D: usize> fmt::Display for Domain<D> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        AnyDomain::from(*self).fmt(f)
    }
}

/// All particles at one instant. `N` is the number of particles, `D` of dimensions.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame<const D: usize = 2> {
    /// Id of the simulated trajectory.
    pub stream: u64,
    /// Number of the frame in its stream; consecutive.
    pub sequence: u64,
    /// Simulation time of this frame.
    pub stamp: Stamp,
    /// Time between two frames of the stream (s).
    pub dt: f32,
    /// The box that contains the particles.
    pub domain: Domain<D>,
    /// Positions, `[N, D]` (domain lengths).
    pub position: Vec<[f32; D]>,
    /// Velocities, `[N, D]` (domain lengths per second).
    pub velocity: Vec<[f32; D]>,
    /// Materials, `[N]`.
    pub material: Vec<Material>,
}

impl<const D: usize> Frame<D> {
    /// Creates a checked frame.
    ///
    /// # Errors
    /// [`InvalidFrame`] when there are no particles, lengths differ, a number is not finite, the domain is empty or `dt` is
    /// not positive.
    #[expect(clippy::too_many_arguments, reason = "one argument for each field of the message")]
    pub fn new(
        stream: u64,
        sequence: u64,
        stamp: Stamp,
        dt: f32,
        domain: Domain<D>,
        position: Vec<[f32; D]>,
        velocity: Vec<[f32; D]>,
        material: Vec<Material>,
    ) -> Result<Self, InvalidFrame> {
        let frame = Self { stream, sequence, stamp, dt, domain, position, velocity, material };
        frame.check()?;
        Ok(frame)
    }

    /// Number of particles.
    pub fn len(&self) -> usize {
        self.material.len()
    }

    /// Whether there are no particles (never the case for a valid frame).
    pub fn is_empty(&self) -> bool {
        self.material.is_empty()
    }

    /// As [`FrameView::check_plausible`].
    ///
    /// # Errors
    /// As [`FrameView::check_plausible`].
    pub fn check_plausible(&self) -> Result<(), InvalidFrame> {
        FrameView::from(self).check_plausible()
    }

    /// Checks everything that [`Frame::new`] checks.
    ///
    /// # Errors
    /// As [`Frame::new`].
    pub fn check(&self) -> Result<(), InvalidFrame> {
        let particles = self.material.len();
        for (field, found) in [("position", self.position.len()), ("velocity", self.velocity.len())]
        {
            // Without particles, `InvalidFrame::Empty` follows instead.
            if found != particles && particles > 0 {
                return Err(InvalidFrame::Length {
                    field,
                    found: D * found,
                    expected: D * particles,
                    particles,
                });
            }
        }
        FrameView::from(self).check()
    }
}

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

#[cfg(test)]
mod tests {
    use super::*;

    fn two_particles() -> Frame {
        Frame {
            stream: 1,
            sequence: 0,
            stamp: Stamp(0),
            dt: 0.016,
            domain: Domain::UNIT,
            position: vec![[0.25, 0.5], [0.75, 0.5]],
            velocity: vec![[0.0, -1.0], [1.0, 0.0]],
            material: vec![Material::Liquid, Material::Rope],
        }
    }

    #[test]
    fn a_valid_frame_passes() {
        assert_eq!(two_particles().check(), Ok(()));
    }

    #[test]
    fn a_nan_is_named_with_its_field_and_particle() {
        let mut frame = two_particles();
        frame.velocity[1][0] = f32::NAN;
        let message = frame.check().unwrap_err().to_string();
        assert_eq!(message, "velocity[1]: found NaN, expected a finite number");
    }

    #[test]
    fn unequal_lengths_are_named_in_numbers_per_message() {
        let mut frame = two_particles();
        frame.position.pop();
        let message = frame.check().unwrap_err().to_string();
        assert_eq!(message, "position: found 2 numbers, expected 4 for 2 particles");
    }

    #[test]
    fn decimals_are_the_numbers_that_are_printed() {
        for value in
            [0.016_f32, 1.0 / 3.0, f32::MAX, f32::MIN_POSITIVE / 3.0, -1.234_567_9e-30, 0.0]
        {
            assert_eq!(decimal(value), value.to_string().parse::<f64>().unwrap(), "{value}");
        }
        assert!(decimal(f32::NAN).is_nan());
    }

    #[test]
    fn stamps_advance_in_whole_intervals() {
        let dt = 0.016;
        let two = Stamp(5).advance(dt, 1).advance(dt, 1);
        assert_eq!(two, Stamp(5).advance(dt, 2));
        assert_eq!(two, Stamp(32_000_005));
    }
}
