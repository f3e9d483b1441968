//! Memory layout of a frame in shared memory. Programs in other languages use these type names and this layout.

use std::slice;

use iceoryx2::prelude::ZeroCopySend;

use eddy_frames::{Domain, Frame, FrameView, InvalidFrame, Particle, Particles, Stamp};
use eddy_messages::{Header, ParticleFrame};

/// A [`Particle`] as an element of a payload.
///
/// A newtype, because a trait of iceoryx2 cannot be implemented for a type of another crate.
#[derive(Clone, Copy, Debug)]
#[repr(transparent)]
pub(crate) struct SharedParticle(Particle);

/// The particles of a payload.
pub(super) fn particles(payload: &[SharedParticle]) -> &[Particle] {
    // SAFETY: `repr(transparent)`: both types have the same layout.
    unsafe { slice::from_raw_parts(payload.as_ptr().cast(), payload.len()) }
}

// SAFETY: the layout is fixed (`repr(C)`, five numbers), any bits are a valid particle, and it has no references.
unsafe impl ZeroCopySend for SharedParticle {
    unsafe fn type_name() -> &'static str {
        "eddy::Particle"
    }
}

/// A frame without its particles, 48 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("eddy::FrameHeader")]
#[repr(C)]
pub(crate) struct FrameHeader {
    pub(super) stream: u64,
    pub(super) sequence: u64,
    /// Simulation time (ns).
    pub(super) stamp_ns: i64,
    /// Time between two frames (s).
    pub(super) dt: f32,
    /// Domain corners (domain lengths).
    pub(super) lower: [f32; 2],
    pub(super) upper: [f32; 2],
}

impl From<&Frame> for FrameHeader {
    fn from(frame: &Frame) -> Self {
        Self {
            stream: frame.stream,
            sequence: frame.sequence,
            stamp_ns: frame.stamp.0,
            dt: frame.dt,
            lower: frame.domain.lower,
            upper: frame.domain.upper,
        }
    }
}

/// Particle `index` of a frame.
pub(super) fn particle(frame: &Frame, index: usize) -> SharedParticle {
    let ([x, y], [vx, vy]) = (frame.position[index], frame.velocity[index]);
    SharedParticle(Particle { x, y, vx, vy, material: frame.material[index] as u32 })
}

/// The unchecked frame in shared memory as a message. Material numbers that do not fit a byte are saturated, so that
/// they stay unknown.
pub(crate) fn message(header: &FrameHeader, particles: &[Particle]) -> ParticleFrame {
    let material = |p: &Particle| u8::try_from(p.material).unwrap_or(u8::MAX);
    ParticleFrame {
        header: Header::world(Stamp(header.stamp_ns)),
        stream: header.stream,
        sequence: header.sequence,
        dt: header.dt,
        lower: header.lower.to_vec(),
        upper: header.upper.to_vec(),
        position: particles.iter().flat_map(|p| [p.x, p.y]).collect(),
        velocity: particles.iter().flat_map(|p| [p.vx, p.vy]).collect(),
        material: particles.iter().map(material).collect(),
    }
}

/// The unchecked frame in shared memory.
pub(super) fn view<'a>(header: &FrameHeader, particles: &'a [Particle]) -> FrameView<'a> {
    FrameView {
        stream: header.stream,
        sequence: header.sequence,
        stamp: Stamp(header.stamp_ns),
        dt: header.dt,
        domain: Domain { lower: header.lower, upper: header.upper },
        particles: Particles::Rows(particles),
    }
}

/// A checked copy of the frame in shared memory.
pub(crate) fn frame(header: &FrameHeader, particles: &[Particle]) -> Result<Frame, InvalidFrame> {
    let frame = view(header, particles);
    frame.check()?;
    Ok(frame.to_frame())
}

/// Header and particles of any bits, as other programs may write them.
#[cfg(feature = "lab")]
pub(crate) fn from_bits(bytes: &[u8]) -> (FrameHeader, Vec<Particle>) {
    let mut words = bytes.chunks_exact(4).map(|word| {
        let (word, _) = word.split_first_chunk().expect("chunks of four bytes have four");
        u32::from_le_bytes(*word)
    });
    let mut word = || words.next();
    let mut or_zero = || word().unwrap_or_default();
    let mut long = || u64::from(or_zero()) | u64::from(or_zero()) << 32;
    let (stream, sequence, stamp_ns) = (long(), long(), long() as i64);
    let mut number = || f32::from_bits(or_zero());
    let (dt, lower, upper) = (number(), [number(), number()], [number(), number()]);
    let header = FrameHeader { stream, sequence, stamp_ns, dt, lower, upper };
    let mut particle = || {
        let [x, y, vx, vy] = [word()?, word()?, word()?, word()?].map(f32::from_bits);
        Some(Particle { x, y, vx, vy, material: word()? })
    };
    (header, std::iter::from_fn(&mut particle).collect())
}

#[cfg(test)]
mod tests {
    use std::mem::{align_of, offset_of, size_of};

    use proptest::prelude::*;

    use super::*;
    use eddy_frames::Material;

    #[test]
    fn the_layout_is_the_documented_one() {
        assert_eq!((size_of::<SharedParticle>(), align_of::<SharedParticle>()), (20, 4));
        assert_eq!(offset_of!(Particle, material), 16);
        assert_eq!((size_of::<FrameHeader>(), align_of::<FrameHeader>()), (48, 8));
        assert_eq!(offset_of!(FrameHeader, dt), 24);
        assert_eq!((offset_of!(FrameHeader, lower), offset_of!(FrameHeader, upper)), (28, 36));
    }

    #[test]
    fn an_unknown_material_is_rejected() {
        let header = FrameHeader { dt: 0.016, upper: [1.0; 2], ..FrameHeader::default() };
        let particle = Particle { x: 0.5, y: 0.5, vx: 0.0, vy: 0.0, material: 256 };
        let error = view(&header, &[particle]).check().unwrap_err();
        assert_eq!(error, InvalidFrame::Material { particle: 0, found: 255 });
    }

    proptest! {
        #[test]
        fn frames_come_back_as_they_went(
            stream: u64, sequence: u64, stamp: i64,
            rows in prop::collection::vec(
                (prop::array::uniform2(-1e9f32..1e9), prop::array::uniform2(-1e9f32..1e9), 0u8..4),
                1..50,
            ),
        ) {
            let sent = Frame {
                stream, sequence, stamp: Stamp(stamp), dt: 0.016, domain: Domain::UNIT,
                position: rows.iter().map(|p| p.0).collect(),
                velocity: rows.iter().map(|p| p.1).collect(),
                material: rows.iter().map(|p| Material::try_from(p.2).unwrap()).collect(),
            };
            let slice: Vec<_> = (0..sent.len()).map(|index| particle(&sent, index)).collect();
            let header = FrameHeader::from(&sent);
            let received = view(&header, particles(&slice));
            prop_assert_eq!(received.check(), sent.check());
            prop_assert_eq!(received.to_frame(), sent);
        }
    }
}
