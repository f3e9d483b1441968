//! [`Frame`] from and to its message: the one place where bytes from outside become particles.

use super::{Header, ParticleFrame, cdr, cdr::CdrError};
use crate::frame::{Domain, Frame, InvalidFrame, Material};

/// Why a message is not a frame that can be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum BadFrame {
    /// The bytes are no `ParticleFrame`.
    #[error(transparent)]
    Cdr(#[from] CdrError),
    /// The message is one, but not a whole frame.
    #[error(transparent)]
    Invalid(#[from] InvalidFrame),
}

impl From<&Frame> for ParticleFrame {
    fn from(frame: &Frame) -> Self {
        Self {
            header: Header::world(frame.stamp),
            stream: frame.stream,
            sequence: frame.sequence,
            dt: frame.dt,
            lower: frame.domain.lower.to_vec(),
            upper: frame.domain.upper.to_vec(),
            position: frame.position.as_flattened().to_vec(),
            velocity: frame.velocity.as_flattened().to_vec(),
            material: frame.material.iter().map(|&material| material as u8).collect(),
        }
    }
}

impl TryFrom<&ParticleFrame> for Frame {
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

impl Frame {
    /// The frame as CDR bytes of its message.
    pub fn to_cdr(&self) -> Vec<u8> {
        cdr::encode(&ParticleFrame::from(self))
    }

    /// The frame in the CDR bytes of a `ParticleFrame`.
    ///
    /// # Errors
    /// [`BadFrame`] when the bytes are no such message, or the message is not a whole frame.
    pub fn from_cdr(bytes: &[u8]) -> Result<Self, BadFrame> {
        let message: ParticleFrame = cdr::decode(bytes)?;
        Ok(Self::try_from(&message)?)
    }
}

fn corner(field: &'static str, values: &[f32]) -> Result<[f32; 2], InvalidFrame> {
    values.try_into().map_err(|_| InvalidFrame::Dimension { field, found: values.len() })
}

fn vectors(
    field: &'static str,
    values: &[f32],
    particles: usize,
) -> Result<Vec<[f32; 2]>, InvalidFrame> {
    let (found, expected) = (values.len(), 2 * particles);
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
    use super::*;
    use crate::frame::Stamp;

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
    fn a_frame_survives_its_message() {
        let frame = Frame::try_from(&message()).unwrap();
        assert_eq!(ParticleFrame::from(&frame), message());
        assert_eq!(Frame::from_cdr(&frame.to_cdr()), Ok(frame));
    }

    #[test]
    fn each_fault_is_named_with_found_and_expected() {
        type Fault = fn(&mut ParticleFrame);
        let cases: [(Fault, &str); 6] = [
            (|m| m.lower = vec![0.0; 3], "lower: found 3 dimensions, expected 2"),
            (
                |m| m.material[1] = 9,
                "material[1]: found 9, expected 0 (liquid), 1 (snow), 2 (jelly) or 3 (rope)",
            ),
            (|m| m.position.truncate(3), "position: found 3 numbers, expected 4 for 2 particles"),
            (|m| m.velocity.push(0.0), "velocity: found 5 numbers, expected 4 for 2 particles"),
            (|m| m.position[2] = f32::INFINITY, "position[1]: found inf, expected a finite number"),
            (|m| m.dt = 0.0, "dt: found 0 s, expected a positive number"),
        ];
        for (fault, expected) in cases {
            let mut message = message();
            fault(&mut message);
            assert_eq!(Frame::try_from(&message).unwrap_err().to_string(), expected);
        }
    }
}
