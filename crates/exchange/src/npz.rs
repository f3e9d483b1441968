//! eddy's own arrays: `position` `[T, N, 2]`, `velocity` `[T, N, 2]`, `material` `[N]` (`[T, N]`
//! where it changes), `stamp` `[T]` (ns), `sequence` `[T]`, `dt` `[]` (s), `lower` `[2]`,
//! `upper` `[2]`, `stream` `[]`.
//!
//! One file a stream, which is held in memory: the arrays lie one after the other, frames do not.

use std::path::Path;

use super::{
    arrays::{Archive, ArchiveWriter},
    error::ExchangeError,
    streams::{Streams, Track, Watch},
    trajectory::{Found, Types},
};

/// What a stream needs to be an array.
const RULE: &str = "an array has one shape, and one dt and domain stand beside it; \
                    vtu, ply and csv can hold streams that change";

/// Writes one stream.
pub(super) fn write(
    streams: &Streams,
    track: &Track,
    path: &Path,
    watch: &mut Watch<'_>,
) -> Result<(), ExchangeError> {
    track.keeps(&["particles", "dt", "domain"], RULE)?;
    let (frames, particles) = (track.frames, track.particles());
    let (mut position, mut velocity) = (Vec::new(), Vec::new());
    let (mut material, mut stamp, mut sequence) = (Vec::new(), Vec::new(), Vec::new());
    streams.read(track, watch, |frame| {
        position.extend_from_slice(frame.position.as_flattened());
        velocity.extend_from_slice(frame.velocity.as_flattened());
        if track.material_varies || material.is_empty() {
            material.extend(frame.material.iter().map(|&material| material as u8));
        }
        stamp.push(frame.stamp.0);
        sequence.push(frame.sequence);
        Ok(())
    })?;
    let of_materials =
        if track.material_varies { vec![frames, particles] } else { vec![particles] };
    let mut archive = ArchiveWriter::create(path)?;
    archive.array("position", &[frames, particles, 2], position)?;
    archive.array("velocity", &[frames, particles, 2], velocity)?;
    archive.array("material", &of_materials, material)?;
    archive.array("stamp", &[frames], stamp)?;
    archive.array("sequence", &[frames], sequence)?;
    archive.array("dt", &[], [track.dt])?;
    archive.array("lower", &[2], track.domain.lower)?;
    archive.array("upper", &[2], track.domain.upper)?;
    archive.array("stream", &[], [track.stream])?;
    archive.finish()
}

/// Reads one file. Only `position` must be there.
pub(super) fn read(path: &Path) -> Result<Found, ExchangeError> {
    let mut archive = Archive::open(path)?;
    let Some(position) = archive.read("position")? else {
        let names = archive.names();
        let found = if names.is_empty() { "no array".into() } else { names.join(", ") };
        return Err(ExchangeError::Array {
            path: path.into(),
            array: "position".into(),
            found,
            expected: "an array position [frames, particles, 2]".into(),
        });
    };
    let mut found = Found::new(path, position)?;
    found.velocity = archive.read("velocity")?;
    found.material = archive.read("material")?.map(|types| (types, Types::EDDY));
    found.stamp = archive.read("stamp")?;
    found.sequence = archive.read("sequence")?;
    found.dt = found.one("dt", archive.read::<f32>("dt")?)?;
    found.stream = found.one("stream", archive.read("stream")?)?;
    let (lower, upper) = (archive.read("lower")?, archive.read("upper")?);
    found.domain = found.corners(lower, upper)?;
    Ok(found)
}
