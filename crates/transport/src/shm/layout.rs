//! Memory layout of a frame in shared memory, of two or three dimensions. Programs in other languages use these type names and this
//! layout.

use std::slice;

use iceoryx2::prelude::ZeroCopySend;

use eddy_frames::{Domain, Frame, FrameView, InvalidFrame, Particle, Particles, Stamp};
use eddy_messages::{Header, ParticleFrame};

/// A [`Particle`] as an element of a payload.
///
/// A newtype, because a trait of iceoryx2 cannot be implemented for a type of another crate.
#[derive(Clone, Copy, Debug)]
#[repr(transparent)]
pub(crate) struct SharedParticle<const D: usize = 2>(Particle<D>);

/// The particles of a payload.
pub(super) fn particles<const D: usize>(payload: &[SharedParticle<D>]) -> &[Particle<D>] {
    // SAFETY: `repr(transparent)`: both types have the same layout.
    unsafe { slice::from_raw_parts(payload.as_ptr().cast(), payload.len()) }
}

/// A frame without its particles, 48 bytes in the plane, 56 in space.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C)]
pub(crate) struct FrameHeader<const D: usize = 2> {
    pub(super) stream: u64,
    pub(super) sequence: u64,
    /// Simulation time (ns).
    pub(super) stamp_ns: i64,
    /// Time between two frames (s).
    pub(super) dt: f32,
    /// Domain corners (domain lengths).
    pub(super) lower: [f32; D],
    pub(super) upper: [f32; D],
}

/// Names of the types of a dimension.
macro_rules! named {
    ($dimension:literal, $particle:literal, $header:literal) => {
        // SAFETY: the layout is fixed (`repr(C)`, numbers), any bits are a valid particle, and it has no references.
        unsafe impl ZeroCopySend for SharedParticle<$dimension> {
            unsafe fn type_name() -> &'static str {
                $particle
            }
        }

        // SAFETY: as above.
        unsafe impl ZeroCopySend for FrameHeader<$dimension> {
            unsafe fn type_name() -> &'static str {
                $header
            }
        }
    };
}

named!(2, "eddy::Particle", "eddy::FrameHeader");
named!(3, "eddy::Particle3", "eddy::FrameHeader3");

impl<const D: usize> Default for FrameHeader<D> {
    fn default() -> Self {
        let [lower, upper] = [[0.0; D]; 2];
        Self { stream: 0, sequence: 0, stamp_ns: 0, dt: 0.0, lower, upper }
    }
}

impl<const D: usize> From<&Frame<D>> for FrameHeader<D> {
    fn from(frame: &Frame<D>) -> Self {
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
pub(super) fn particle<const D: usize>(frame: &Frame<D>, index: usize) -> SharedParticle<D> {
    let (position, velocity) = (frame.position[index], frame.velocity[index]);
    SharedParticle(Particle { position, velocity, material: frame.material[index] as u32 })
}

/// The unchecked frame in shared memory as a message. Material numbers that do not fit a byte are saturated, so that
/// they stay unknown.
pub(crate) fn message<const D: usize>(
    header: &FrameHeader<D>,
    particles: &[Particle<D>],
) -> ParticleFrame {
    let material = |p: &Particle<D>| u8::try_from(p.material).unwrap_or(u8::MAX);
    ParticleFrame {
        header: Header::world(Stamp(header.stamp_ns)),
        stream: header.stream,
        sequence: header.sequence,
        dt: header.dt,
        lower: header.lower.to_vec(),
        upper: header.upper.to_vec(),
        position: particles.iter().flat_map(|p| p.position).collect(),
        velocity: particles.iter().flat_map(|p| p.velocity).collect(),
        material: particles.iter().map(material).collect(),
    }
}

/// The unchecked frame in shared memory.
pub(super) fn view<'a, const D: usize>(
    header: &FrameHeader<D>,
    particles: &'a [Particle<D>],
) -> FrameView<'a, D> {
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
pub(crate) fn frame<const D: usize>(
    header: &FrameHeader<D>,
    particles: &[Particle<D>],
) -> Result<Frame<D>, InvalidFrame> {
    let frame = view(header, particles);
    frame.check()?;
    Ok(frame.to_frame())
}

/// Header and particles of any bits, as other programs may write them.
#[cfg(feature = "lab")]
pub(crate) fn from_bits<const D: usize>(bytes: &[u8]) -> (FrameHeader<D>, Vec<Particle<D>>) {
    let mut words = bytes.chunks_exact(4).map(|word| {
        let (word, _) = word.split_first_chunk().expect("chunks of four bytes have four");
        u32::from_le_bytes(*word)
    });
    let mut word = || words.next();
    let mut or_zero = || word().unwrap_or_default();
    let mut long = || u64::from(or_zero()) | u64::from(or_zero()) << 32;
    let (stream, sequence, stamp_ns) = (long(), long(), long() as i64);
    let mut number = || f32::from_bits(or_zero());
    let (dt, [lower, upper]) = (number(), [(); 2].map(|()| [(); D].map(|()| number())));
    let header = FrameHeader { stream, sequence, stamp_ns, dt, lower, upper };
    let mut particle = || {
        let mut vector = || {
            let mut numbers = [0.0; D];
            numbers.iter_mut().try_for_each(|x| word().map(|bits| *x = f32::from_bits(bits)))?;
            Some(numbers)
        };
        Some(Particle { position: vector()?, velocity: vector()?, material: word()? })
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
        assert_eq!((offset_of!(Particle, velocity), offset_of!(Particle, material)), (8, 16));
        assert_eq!((size_of::<FrameHeader>(), align_of::<FrameHeader>()), (48, 8));
        assert_eq!(offset_of!(FrameHeader, dt), 24);
        assert_eq!((offset_of!(FrameHeader, lower), offset_of!(FrameHeader, upper)), (28, 36));
        assert_eq!((size_of::<SharedParticle<3>>(), align_of::<SharedParticle<3>>()), (28, 4));
        assert_eq!(
            (offset_of!(Particle<3>, velocity), offset_of!(Particle<3>, material)),
            (12, 24)
        );
        assert_eq!((size_of::<FrameHeader<3>>(), offset_of!(FrameHeader<3>, upper)), (56, 40));
    }

    #[test]
    fn an_unknown_material_is_rejected() {
        let header = FrameHeader { dt: 0.016, upper: [1.0; 2], ..FrameHeader::default() };
        let particle = Particle { position: [0.5; 2], velocity: [0.0; 2], material: 256 };
        let error = view(&header, &[particle]).check().unwrap_err();
        assert_eq!(error, InvalidFrame::Material { particle: 0, found: 255 });
    }

    proptest! {
        #[test]
        fn frames_come_back_as_they_went(
            stream: u64, sequence: u64, stamp: i64,
            rows in prop::collection::vec(
                (prop::array::uniform3(-1e9f32..1e9), prop::array::uniform3(-1e9f32..1e9), 0u8..4),
                1..50,
            ),
        ) {
            let (setup, all) = ((stream, sequence, Stamp(stamp)), &rows[..]);
            travels::<2>(setup, all)?;
            travels::<3>(setup, all)?;
        }
    }

    fn travels<const D: usize>(
        (stream, sequence, stamp): (u64, u64, Stamp),
        rows: &[([f32; 3], [f32; 3], u8)],
    ) -> Result<(), TestCaseError> {
        let first = |of: &[f32; 3]| std::array::from_fn(|axis| of[axis]);
        let sent = Frame::<D> {
            stream,
            sequence,
            stamp,
            dt: 0.016,
            domain: Domain { lower: [0.0; D], upper: [1.0; D] },
            position: rows.iter().map(|p| first(&p.0)).collect(),
            velocity: rows.iter().map(|p| first(&p.1)).collect(),
            material: rows.iter().map(|p| Material::try_from(p.2).unwrap()).collect(),
        };
        let slice: Vec<_> = (0..sent.len()).map(|index| particle(&sent, index)).collect();
        let header = FrameHeader::from(&sent);
        let received = view(&header, particles(&slice));
        prop_assert_eq!(received.check(), sent.check());
        prop_assert_eq!(message(&header, particles(&slice)), ParticleFrame::from(&sent));
        prop_assert_eq!(received.to_frame(), sent);
        Ok(())
    }
}
