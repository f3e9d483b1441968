//! CSV: one table with a row per particle and frame.

use std::{
    fs::File,
    io::{BufWriter, Write},
    path::Path,
};

use super::{
    error::ExchangeError,
    streams::{Progress, Streams},
};

/// Writes every frame of every stream. Times in s, lengths in domain lengths.
pub(super) fn write<const D: usize>(
    streams: &Streams<D>,
    path: &Path,
    progress: &mut Progress<'_>,
) -> Result<(), ExchangeError> {
    let file = File::create_new(path).map_err(ExchangeError::io(path, "creating the file"))?;
    let mut table = BufWriter::new(file);
    let failed = || ExchangeError::io(path, "writing");
    let (axes, speeds) = (&["x", "y", "z"][..D], &["vx", "vy", "vz"][..D]);
    let columns = [&["stream", "sequence", "time", "particle", "material"], axes, speeds].concat();
    writeln!(table, "{}", columns.join(",")).map_err(failed())?;
    for track in streams.tracks() {
        streams.read(track, progress, |frame| {
            let before = format!("{},{},{}", frame.stream, frame.sequence, frame.stamp.seconds());
            for particle in 0..frame.len() {
                let material = frame.material[particle].name();
                write!(table, "{before},{particle},{material}").map_err(failed())?;
                for number in frame.position[particle].iter().chain(&frame.velocity[particle]) {
                    write!(table, ",{number}").map_err(failed())?;
                }
                writeln!(table).map_err(failed())?;
            }
            Ok(())
        })?;
    }
    table.flush().map_err(failed())
}
