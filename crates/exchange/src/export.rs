//! Out of bags.

use std::{fs, path::Path};

use super::{
    csv, data_set,
    error::ExchangeError,
    gns, npz, ply,
    streams::{Streams, Track, Watch},
    vtu,
};
use eddy_settings::atomic::Staged;

/// What frames can be written as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum ExportFormat {
    /// numpy arrays, one .npz a stream (one stream at a time is held in memory).
    Npz,
    /// VTK grids for ParaView: one .vtu a frame, and a .pvd a stream.
    Vtu,
    /// Binary point clouds, one .ply a frame.
    Ply,
    /// A data set for graph network simulators: train.npz, valid.npz, test.npz, metadata.json.
    Gns,
    /// One table, a line a particle and frame.
    Csv,
    /// A data set as LagrangeBench has it: train.h5, valid.h5, test.h5, metadata.json.
    #[cfg_attr(feature = "clap", value(alias = "lagrangebench"))]
    Hdf5,
}

impl ExportFormat {
    /// What a path named `stem` is called when it holds `streams` streams in this format.
    pub fn output_name(self, stem: &str, streams: usize) -> String {
        match self {
            Self::Npz if streams == 1 => format!("{stem}.npz"),
            Self::Npz => format!("{stem}_npz"),
            Self::Vtu => format!("{stem}_vtu"),
            Self::Ply => format!("{stem}_ply"),
            Self::Gns => format!("{stem}_gns"),
            Self::Csv => format!("{stem}.csv"),
            Self::Hdf5 => format!("{stem}_hdf5"),
        }
    }
}

/// Writes streams to `path`, where nothing may be yet: a file for CSV, a directory otherwise; with
/// a name that ends in `.npz`, `Npz` (of one stream) and `Gns` write a lone file. The output is
/// there whole or not at all.
///
/// # Errors
/// [`ExchangeError::Exists`], [`ExchangeError::Unfit`] when the format cannot hold a stream,
/// [`ExchangeError::OneFile`], [`ExchangeError::NoHdf5`], [`ExchangeError::Io`] and those of
/// [`Streams::read`].
pub fn export(
    streams: &Streams,
    format: ExportFormat,
    path: &Path,
    watch: &mut Watch<'_>,
) -> Result<(), ExchangeError> {
    let lone_file = path.extension().is_some_and(|extension| extension == "npz");
    let tracks: Vec<&Track> = streams.tracks().iter().collect();
    let output = Staged::new(path).map_err(ExchangeError::output(path))?;
    let place = &output.path();
    let directory = || {
        fs::create_dir(place).map_err(ExchangeError::io(place, "creating the directory"))?;
        Ok::<&Path, ExchangeError>(place)
    };
    match format {
        ExportFormat::Npz if lone_file => match tracks.as_slice() {
            [track] => npz::write(streams, track, place, watch)?,
            _ => return Err(ExchangeError::OneFile { path: path.into(), found: tracks.len() }),
        },
        ExportFormat::Npz => {
            let directory = directory()?;
            for track in tracks {
                let file = directory.join(format!("{}.npz", track.name()));
                npz::write(streams, track, &file, watch)?;
            }
        }
        ExportFormat::Vtu => vtu::write(streams, directory()?, watch)?,
        ExportFormat::Ply => ply::write(streams, directory()?, watch)?,
        ExportFormat::Gns if lone_file => gns::write(streams, &tracks, place, None, watch)?,
        ExportFormat::Gns => data_set::write_set(streams, directory()?, "npz", gns::write, watch)?,
        ExportFormat::Csv => csv::write(streams, place, watch)?,
        #[cfg(feature = "hdf5")]
        ExportFormat::Hdf5 => {
            data_set::write_set(streams, directory()?, "h5", super::hdf5::write, watch)?
        }
        #[cfg(not(feature = "hdf5"))]
        ExportFormat::Hdf5 => return Err(ExchangeError::NoHdf5),
    }
    output.commit().map_err(ExchangeError::output(path))
}
