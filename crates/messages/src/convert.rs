//! Converts a [`Frame`] from and to its message: the only place where external data becomes particles. The corners of the domain have as
//! many coordinates as the frame has dimensions.

use std::path::PathBuf;

use super::{Header, ParticleFrame, cdr, cdr::CdrError};
use eddy_frames::{AnyFrame, Domain, Frame, InvalidFrame, Material, with_frame};

/// A message that is not a valid frame.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum BadFrame {
    /// The bytes are not a `ParticleFrame`.
    #[error(transparent)]
    Cdr(#[from] CdrError),
    /// The `ParticleFrame` is not a valid frame.
    #[error(transparent)]
    Invalid(#[from] InvalidFrame),
}

/// A frame that cannot be used, and its place.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{place}: stream {stream}, frame {sequence}: {reason}", place = path.display())]
pub struct UnusableFrame {
    /// The file or bag.
    pub path: PathBuf,
    /// The stream.
    pub stream: u64,
    /// Sequence number of the frame.
    pub sequence: u64,
    /// Why it cannot be used.
    pub reason: BadFrame,
}

impl<const D: usize> From<&Frame<D>> for ParticleFrame {
    fn from(frame: &Frame<D>) -> Self {
        Self {
            position: frame.position.as_flattened().to_vec(),
            velocity: frame.velocity.as_flattened().to_vec(),
            material: frame.material.iter().map(|&material| material as u8).collect(),
            ..without_particles(frame)
        }
    }
}

impl<const D: usize> TryFrom<&ParticleFrame> for Frame<D> {
    type Error = InvalidFrame;

    fn try_from(message: &ParticleFrame) -> Result<Self, InvalidFrame> {
        let domain = Domain {
            lower: corner("lower", &message.lower)?,
            upper: corner("upper", &message.upper)?,
        };
        let material = materials(&message.material)?;
        let position = vectors("position", &message.position, material.len())?;
        let velocity = vectors("velocity", &message.velocity, material.len())?;
        let (stamp, dt) = (message.header.stamp.into(), message.dt);
        Self::new(message.stream, message.sequence, stamp, dt, domain, position, velocity, material)
    }
}

impl TryFrom<&ParticleFrame> for AnyFrame {
    type Error = InvalidFrame;

    fn try_from(message: &ParticleFrame) -> Result<Self, InvalidFrame> {
        match message.lower.len() {
            2 => Ok(Self::Two(message.try_into()?)),
            3 => Ok(Self::Three(message.try_into()?)),
            found => {
                let expected = "2 or 3".to_owned();
                Err(InvalidFrame::Dimension { field: "lower", found, expected })
            }
        }
    }
}

/// Encodes and decodes a frame as the CDR of a [`ParticleFrame`].
pub trait FrameCdr: for<'a> TryFrom<&'a ParticleFrame, Error = InvalidFrame> {
    /// The same bytes as from [`cdr::encode`], with the particles copied as a whole rather than number by number.
    fn to_cdr(&self) -> Vec<u8>;

    /// Decodes and checks a frame.
    ///
    /// # Errors
    /// [`BadFrame`] when the bytes are not a [`ParticleFrame`], or it is not a valid frame.
    fn from_cdr(bytes: &[u8]) -> Result<Self, BadFrame> {
        let message: ParticleFrame = cdr::decode(bytes)?;
        Ok(Self::try_from(&message)?)
    }
}

impl<const D: usize> FrameCdr for Frame<D> {
    fn to_cdr(&self) -> Vec<u8> {
        let mut bytes = cdr::encode(&without_particles(self));
        // The last three fields are empty sequences: only their lengths.
        bytes.truncate(bytes.len() - 3 * size_of::<u32>());
        let particles = size_of_val(&self.position[..]) + size_of_val(&self.velocity[..]);
        bytes.reserve_exact(3 * size_of::<u32>() + particles + self.material.len());
        for vectors in [&self.position, &self.velocity] {
            let numbers = vectors.as_flattened();
            bytes.extend((numbers.len() as u32).to_le_bytes());
            let begin = bytes.len();
            bytes.resize(begin + size_of_val(numbers), 0);
            for (to, number) in bytes[begin..].as_chunks_mut().0.iter_mut().zip(numbers) {
                *to = number.to_le_bytes();
            }
        }
        bytes.extend((self.material.len() as u32).to_le_bytes());
        bytes.extend(self.material.iter().map(|&material| material as u8));
        bytes
    }
}

impl FrameCdr for AnyFrame {
    fn to_cdr(&self) -> Vec<u8> {
        with_frame!(self, frame => frame.to_cdr())
    }
}

/// The message of a frame without particles.
fn without_particles<const D: usize>(frame: &Frame<D>) -> ParticleFrame {
    ParticleFrame {
        header: Header::world(frame.stamp),
        stream: frame.stream,
        sequence: frame.sequence,
        dt: frame.dt,
        lower: frame.domain.lower.to_vec(),
        upper: frame.domain.upper.to_vec(),
        ..ParticleFrame::default()
    }
}

fn corner<const D: usize>(field: &'static str, values: &[f32]) -> Result<[f32; D], InvalidFrame> {
    values.try_into().map_err(|_| {
        let (found, expected) = (values.len(), D.to_string());
        InvalidFrame::Dimension { field, found, expected }
    })
}

fn vectors<const D: usize>(
    field: &'static str,
    values: &[f32],
    particles: usize,
) -> Result<Vec<[f32; D]>, InvalidFrame> {
    let (found, expected) = (values.len(), D * particles);
    if found != expected {
        return Err(InvalidFrame::Length { field, found, expected, particles });
    }
    Ok(values.as_chunks().0.to_vec())
}

fn materials(numbers: &[u8]) -> Result<Vec<Material>, InvalidFrame> {
    numbers
        .iter()
        .enumerate()
        .map(|(particle, &number)| {
            Material::try_from(number).map_err(|found| InvalidFrame::Material { particle, found })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use eddy_frames::Stamp;

    fn message() -> ParticleFrame {
        ParticleFrame {
            header: Header::world(Stamp(16_000_000)),
            stream: 3,
            sequence: 1,
            dt: 0.016,
            lower: vec![0.0, 0.0],
            upper: vec![1.0, 1.0],
            position: vec![0.25, 0.5, 0.75, 0.5],
            velocity: vec![0.0, -1.0, 1.0, 0.0],
            material: vec![0, 3],
        }
    }

    #[test]
    fn a_frame_is_converted_to_its_message_and_back() {
        let frame = <Frame>::try_from(&message()).unwrap();
        assert_eq!(ParticleFrame::from(&frame), message());
        assert_eq!(Frame::from_cdr(&frame.to_cdr()), Ok(frame));
    }

    #[test]
    fn corners_say_the_dimension() {
        let mut message = message();
        message.upper.push(2.0);
        let of_upper = AnyFrame::try_from(&message).unwrap_err().to_string();
        assert_eq!(of_upper, "upper: found 3 dimensions, expected 2");
        message.lower.push(0.0);
        message.position.extend([0.5, 0.25]);
        message.velocity.extend([0.0, -1.0]);
        let AnyFrame::Three(frame) = AnyFrame::try_from(&message).unwrap() else {
            panic!("corners of three coordinates")
        };
        assert_eq!(frame.position, [[0.25, 0.5, 0.75], [0.5, 0.5, 0.25]]);
        assert_eq!(ParticleFrame::from(&frame), message);
        let in_plane = <Frame>::try_from(&message).unwrap_err();
        assert_eq!(in_plane.to_string(), "lower: found 3 dimensions, expected 2");
        assert_eq!(<Frame>::try_from(AnyFrame::Three(frame)), Err(in_plane));
        message.lower.push(0.0);
        let none = AnyFrame::try_from(&message).unwrap_err().to_string();
        assert_eq!(none, "lower: found 4 dimensions, expected 2 or 3");
    }

    /// A frame of some numbers of each particle.
    fn frame<const D: usize>(
        (stream, sequence, stamp, dt): (u64, u64, i64, f32),
        particles: &[([f32; 6], u8)],
    ) -> Frame<D> {
        let vectors = |first: usize| -> Vec<[f32; D]> {
            let vector = |numbers: &[f32; 6]| std::array::from_fn(|axis| numbers[first + axis]);
            particles.iter().map(|(numbers, _)| vector(numbers)).collect()
        };
        Frame {
            stream,
            sequence,
            stamp: Stamp(stamp),
            dt,
            domain: Domain { lower: [0.0; D], upper: [1.0; D] },
            position: vectors(0),
            velocity: vectors(3),
            material: particles.iter().map(|p| Material::try_from(p.1).unwrap()).collect(),
        }
    }

    proptest! {
        #[test]
        fn frames_have_the_bytes_of_their_messages(
            stream: u64, sequence: u64, stamp: i64, dt in 1e-6f32..1.0,
            particles in prop::collection::vec(
                (prop::array::uniform6(-1e9f32..1e9), 0u8..4),
                0..40,
            ),
        ) {
            let setup = (stream, sequence, stamp, dt);
            let (plane, space) = (frame::<2>(setup, &particles), frame::<3>(setup, &particles));
            prop_assert_eq!(plane.to_cdr(), cdr::encode(&ParticleFrame::from(&plane)));
            prop_assert_eq!(space.to_cdr(), cdr::encode(&ParticleFrame::from(&space)));
            for frame in [AnyFrame::from(plane), AnyFrame::from(space)] {
                let checked = with_frame!(&frame, frame => frame.check());
                let found = AnyFrame::from_cdr(&frame.to_cdr());
                // A stamp that does not fit into a message is another one there.
                prop_assert!(checked.is_err() || found == Ok(frame));
            }
        }
    }

    #[test]
    fn invalid_frames_are_rejected_with_found_and_expected() {
        type Fault = fn(&mut ParticleFrame);
        let cases: [(Fault, &str); 6] = [
            (|m| m.lower = vec![0.0; 3], "lower: found 3 dimensions, expected 2"),
            (
                |m| m.material[1] = 9,
                "material[1]: found 9, expected 0 (liquid), 1 (snow), 2 (jelly), 3 (rope) or 4 (sand)",
            ),
            (|m| m.position.truncate(3), "position: found 3 numbers, expected 4 for 2 particles"),
            (|m| m.velocity.push(0.0), "velocity: found 5 numbers, expected 4 for 2 particles"),
            (|m| m.position[2] = f32::INFINITY, "position[1]: found inf, expected a finite number"),
            (|m| m.dt = 0.0, "dt: found 0 s, expected a positive number"),
        ];
        for (fault, expected) in cases {
            let mut message = message();
            fault(&mut message);
            assert_eq!(<Frame>::try_from(&message).unwrap_err().to_string(), expected);
        }
    }
}
