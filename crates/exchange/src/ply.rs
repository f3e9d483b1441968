//! Binary PLY, one file per frame: vertices `x y z vx vy vz` (z = 0 in the plane) and `material`.
//!
//! Format: G. Turk, "The PLY Polygon File Format" (1994).

use std::{
    fs::{self, File},
    io::{self, BufWriter, Write},
    path::Path,
};

use super::{
    error::ExchangeError,
    streams::{Progress, Streams},
};
use eddy_frames::{Frame, Material, spatial};

/// Writes `stream_0007/000000.ply` and so on into the directory.
pub(super) fn write<const D: usize>(
    streams: &Streams<D>,
    directory: &Path,
    progress: &mut Progress<'_>,
) -> Result<(), ExchangeError> {
    for track in streams.tracks() {
        let folder = directory.join(track.name());
        fs::create_dir(&folder).map_err(ExchangeError::io(&folder, "creating the directory"))?;
        let mut number = 0;
        streams.read(track, progress, |frame| {
            let path = folder.join(format!("{number:06}.ply"));
            number += 1;
            let file = File::create_new(&path);
            file.and_then(|file| vertices(BufWriter::new(file), &frame))
                .map_err(ExchangeError::io(&path, "writing"))
        })?;
    }
    Ok(())
}

fn vertices<const D: usize>(mut file: impl Write, frame: &Frame<D>) -> io::Result<()> {
    let materials = Material::ALL.map(|material| format!("{} {}", material as u8, material.name()));
    write!(
        file,
        "ply\nformat binary_little_endian 1.0\n\
         comment time {} s, stream {}, sequence {}\n\
         comment material: {}\n\
         element vertex {}\n",
        frame.stamp.seconds(),
        frame.stream,
        frame.sequence,
        materials.join(", "),
        frame.len()
    )?;
    for name in ["x", "y", "z", "vx", "vy", "vz"] {
        writeln!(file, "property float {name}")?;
    }
    write!(file, "property uchar material\nend_header\n")?;
    for particle in 0..frame.len() {
        let vectors = [frame.position[particle], frame.velocity[particle]].map(spatial);
        for number in vectors.as_flattened() {
            file.write_all(&number.to_le_bytes())?;
        }
        file.write_all(&[frame.material[particle] as u8])?;
    }
    file.flush()
}
