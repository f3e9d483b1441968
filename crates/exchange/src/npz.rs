//! eddy's own arrays: `position` `[T, N, D]`, `velocity` `[T, N, D]`, `material` `[N]` (`[T, N]`
//! where it changes), `stamp` `[T]` (ns), `sequence` `[T]`, `dt` `[]` (s), `lower` `[D]`,
//! `upper` `[D]`, `stream` `[]`, and if they are known `stiffness` `[]` (density x velocity^2) and `gravity` `[]` (along y, domain
//! lengths per s^2).
//!
//! One file per stream, which is collected in memory because an array has the values of all frames.

use std::path::Path;

use super::{
    arrays::{Archive, ArchiveWriter},
    error::ExchangeError,
    streams::{Progress, Streams, Track},
    trajectory::{POSITION, RawTrajectory, Types},
};
use eddy_bag::{BagReader, custom_data::Quantity};
use eddy_dataset::{quantity_of_stream, simulate::ScenesBeside};

/// The arrays of quantities of all matter.
const QUANTITIES: [(&str, Quantity); 2] =
    [("stiffness", Quantity::Stiffness), ("gravity", Quantity::Gravity)];

/// Requirements for a stream.
const RULE: &str = "an .npz file has arrays of one shape, one dt and one domain; \
                    vtu, ply and csv can represent streams that change";

/// Writes one stream. `scenes` are those beside its bag, if that does not state the quantities of its matter.
pub(super) fn write<const D: usize>(
    streams: &Streams<D>,
    track: &Track<D>,
    path: &Path,
    scenes: &mut ScenesBeside,
    progress: &mut Progress<'_>,
) -> Result<(), ExchangeError> {
    track.check_constant(&["particles", "dt", "domain"], RULE)?;
    let bag = BagReader::open(&track.bag)?;
    let mut stated = |(name, quantity)| {
        let value = quantity_of_stream(&bag, track.stream, quantity, scenes)?;
        Ok((name, value))
    };
    let stated: Vec<(&str, Option<f32>)> = QUANTITIES
        .into_iter()
        .map(&mut stated)
        .collect::<Result<_, _>>()
        .map_err(ExchangeError::Stated)?;
    let (frames, particles) = (track.frames, track.particles());
    let (mut position, mut velocity) = (Vec::new(), Vec::new());
    let (mut material, mut stamp, mut sequence) = (Vec::new(), Vec::new(), Vec::new());
    streams.read(track, progress, |frame| {
        position.extend_from_slice(frame.position.as_flattened());
        velocity.extend_from_slice(frame.velocity.as_flattened());
        if track.material_varies || material.is_empty() {
            material.extend(frame.material.iter().map(|&material| material as u8));
        }
        stamp.push(frame.stamp.0);
        sequence.push(frame.sequence);
        Ok(())
    })?;
    let material_shape =
        if track.material_varies { vec![frames, particles] } else { vec![particles] };
    let mut archive = ArchiveWriter::create(path)?;
    archive.array("position", &[frames, particles, D], position)?;
    archive.array("velocity", &[frames, particles, D], velocity)?;
    archive.array("material", &material_shape, material)?;
    archive.array("stamp", &[frames], stamp)?;
    archive.array("sequence", &[frames], sequence)?;
    archive.array("dt", &[], [track.dt])?;
    archive.array("lower", &[D], track.domain.lower)?;
    archive.array("upper", &[D], track.domain.upper)?;
    archive.array("stream", &[], [track.stream])?;
    for (name, value) in stated {
        if let Some(value) = value {
            archive.array(name, &[], [value])?;
        }
    }
    archive.finish()
}

/// Reads one file. Only `position` is required.
pub(super) fn read(path: &Path) -> Result<RawTrajectory, ExchangeError> {
    let mut archive = Archive::open(path)?;
    let Some(position) = archive.read("position")? else {
        let names = archive.names();
        let found = if names.is_empty() { "no array".into() } else { names.join(", ") };
        return Err(ExchangeError::Array {
            path: path.into(),
            array: "position".into(),
            found,
            expected: format!("an array position {POSITION}"),
        });
    };
    let mut trajectory = RawTrajectory::new(path, position)?;
    trajectory.velocity = archive.read("velocity")?;
    trajectory.material = archive.read("material")?.map(|types| (types, Types::EDDY));
    trajectory.stamp = archive.read("stamp")?;
    trajectory.sequence = archive.read("sequence")?;
    trajectory.dt = trajectory.scalar("dt", archive.read::<f32>("dt")?)?;
    trajectory.stream = trajectory.scalar("stream", archive.read("stream")?)?;
    for (name, quantity) in QUANTITIES {
        trajectory.set_quantity(quantity, name, archive.read(name)?)?;
    }
    let (lower, upper) = (archive.read("lower")?, archive.read("upper")?);
    trajectory.domain = trajectory.domain_of_corners(lower, upper)?;
    Ok(trajectory)
}
