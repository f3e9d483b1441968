//! What VTK files hold of every particle: `velocity`, `material`, `density` and `strain` relative to the first frame,
//! `pressure` and `energy` where they were recorded, and `error` where the truth is known.

use super::{
    aligned::{AlignedFrames, Frames},
    error::ExchangeError,
    fields::{Fields, Reference},
    recorded::{self, RecordedProperties},
    streams::{Progress, Streams, Track},
};
use eddy_bag::BagReader;
use eddy_frames::{Frame, distance, spatial};

/// One property of all particles of a frame.
pub(super) struct PointArray {
    pub(super) name: &'static str,
    pub(super) values: Values,
}

/// Values of a property, one per particle.
pub(super) enum Values {
    Byte(Vec<u8>),
    Scalar(Vec<f32>),
    /// Along x, y and z.
    Vector(Vec<[f32; 3]>),
    /// Symmetric, with the components of [`strain_components`].
    Tensor(Vec<f32>),
}

/// Calls `each` with every frame of a stream and its properties, in order. `truth` has the frames to compare with.
///
/// # Errors
/// Those of `each`, [`ExchangeError::Bag`] and [`ExchangeError::Interrupted`].
pub(super) fn read<const D: usize>(
    streams: &Streams<D>,
    track: &Track<D>,
    truth: Option<&Streams<D>>,
    progress: &mut Progress<'_>,
    mut each: impl FnMut(&Frame<D>, &[PointArray]) -> Result<(), ExchangeError>,
) -> Result<(), ExchangeError> {
    let (mut reference, mut has_no_strain) = (None, false);
    let mut recorded = RecordedProperties::open(&BagReader::open(&track.bag)?, streams.topic())?;
    let frames: Frames<D> = Box::new(streams.frames_of(track)?);
    let truth = truth.and_then(|truth| Some((truth, truth.track(track.stream)?)));
    let truth = truth.map(|(truth, track)| truth.frames_of(track)).transpose()?;
    let truth: Vec<Frames<D>> = truth.into_iter().map(|frames| Box::new(frames) as _).collect();
    for row in AlignedFrames::new(frames, truth) {
        let mut row = row?.into_iter();
        let Some(frame) = row.next().flatten() else { continue };
        let reference = reference.get_or_insert_with(|| Reference::new(&frame));
        let Fields { density, strain } = reference.fields(&frame);
        if !reference.has_strain_of(&frame) && !std::mem::replace(&mut has_no_strain, true) {
            tracing::warn!(
                "{}: stream {}: the number of particles changes at sequence {}: their strain since the first frame is not known \
                 there, and NaN",
                track.bag.display(),
                track.stream,
                frame.sequence
            );
        }
        let recorded = recorded.as_mut().map(|recorded| recorded.of(&frame)).transpose()?;
        let velocity = frame.velocity.iter().copied().map(spatial).collect();
        let material = frame.material.iter().map(|&material| material as u8).collect();
        let mut arrays = vec![
            PointArray { name: "velocity", values: Values::Vector(velocity) },
            PointArray { name: "material", values: Values::Byte(material) },
            PointArray { name: "density", values: Values::Scalar(density) },
            PointArray { name: "strain", values: Values::Tensor(strain) },
        ];
        let recorded = recorded::NAMES.into_iter().zip(recorded.into_iter().flatten());
        arrays.extend(recorded.map(|(name, of)| PointArray { name, values: Values::Scalar(of) }));
        arrays.extend(row.map(|truth| PointArray {
            name: "error",
            values: Values::Scalar(errors(&frame, truth.as_ref())),
        }));
        each(&frame, &arrays)?;
        if !progress() {
            return Err(ExchangeError::Interrupted);
        }
    }
    Ok(())
}

/// Distance of every particle from its true position (domain lengths), `[N]`. NaN where there is no true frame of this
/// sequence number, or one with another number of particles.
fn errors<const D: usize>(frame: &Frame<D>, truth: Option<&Frame<D>>) -> Vec<f32> {
    let Some(truth) = truth.filter(|truth| truth.len() == frame.len()) else {
        return vec![f32::NAN; frame.len()];
    };
    let pairs = frame.position.iter().zip(&truth.position);
    pairs.map(|(&position, &expected)| distance(position, expected)).collect()
}
