//! Exports frames from bags.

use std::{fs, path::Path};

use super::{
    csv, data_set,
    error::ExchangeError,
    gns, npz, ply,
    streams::{Progress, Streams, Track},
    vtu,
};
use eddy_dataset::simulate::ScenesBeside;
use eddy_settings::atomic::Staged;

/// Formats for export.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum ExportFormat {
    /// NumPy arrays, one .npz per stream (one stream at a time is in memory).
    Npz,
    /// VTK grids for ParaView: one .vtu per frame, one .pvd per stream.
    Vtu,
    /// One VTKHDF file per stream, with all frames, for ParaView 5.12 and later.
    Vtkhdf,
    /// Binary point clouds, one .ply per frame.
    Ply,
    /// A data set for graph network simulators: train.npz, valid.npz, test.npz, metadata.json.
    Gns,
    /// One table with a row per particle and frame.
    Csv,
    /// A data set in the format of LagrangeBench: train.h5, valid.h5, test.h5, metadata.json.
    #[cfg_attr(feature = "clap", value(alias = "lagrangebench"))]
    Hdf5,
}

impl ExportFormat {
    /// Checks that this build writes the format.
    ///
    /// # Errors
    /// [`ExchangeError::NoHdf5`].
    pub fn check(self) -> Result<(), ExchangeError> {
        match self {
            Self::Hdf5 | Self::Vtkhdf if cfg!(not(feature = "hdf5")) => Err(ExchangeError::NoHdf5),
            _ => Ok(()),
        }
    }

    /// Default name of an output with `streams` streams: `stem` with a suffix or an extension.
    pub fn output_name(self, stem: &str, streams: usize) -> String {
        match self {
            Self::Npz if streams == 1 => format!("{stem}.npz"),
            Self::Npz => format!("{stem}_npz"),
            Self::Vtu => format!("{stem}_vtu"),
            Self::Vtkhdf if streams == 1 => format!("{stem}.vtkhdf"),
            Self::Vtkhdf => format!("{stem}_vtkhdf"),
            Self::Ply => format!("{stem}_ply"),
            Self::Gns => format!("{stem}_gns"),
            Self::Csv => format!("{stem}.csv"),
            Self::Hdf5 => format!("{stem}_hdf5"),
        }
    }
}

/// Writes streams to `path`, which must not exist: a file for CSV, a directory otherwise; `Npz` and `Vtkhdf` (of one
/// stream) and `Gns` write a single file if the path ends in `.npz` or `.vtkhdf`. The output appears when it is
/// complete. `truth` has streams of the same ids: `Vtu` and `Vtkhdf` then have the distance of each particle from its
/// true position.
///
/// # Errors
/// [`ExchangeError::Exists`], [`ExchangeError::Unsuitable`] when the format cannot represent a stream,
/// [`ExchangeError::OneFile`], [`ExchangeError::NoHdf5`], [`ExchangeError::Io`] and those of
/// [`Streams::read`].
pub fn export<const D: usize>(
    streams: &Streams<D>,
    truth: Option<&Streams<D>>,
    format: ExportFormat,
    path: &Path,
    progress: &mut Progress<'_>,
) -> Result<(), ExchangeError> {
    let single_file = path.extension().is_some_and(|extension| match format {
        ExportFormat::Vtkhdf => extension == "vtkhdf",
        _ => extension == "npz",
    });
    let tracks: Vec<&Track<D>> = streams.tracks().iter().collect();
    let output = Staged::new(path).map_err(ExchangeError::output(path))?;
    let (staged, mut scenes) = (&output.path(), ScenesBeside::default());
    let directory = || {
        fs::create_dir(staged).map_err(ExchangeError::io(staged, "creating the directory"))?;
        Ok::<&Path, ExchangeError>(staged)
    };
    match format {
        ExportFormat::Npz if single_file => {
            npz::write(streams, only(&tracks, path)?, staged, &mut scenes, progress)?;
        }
        ExportFormat::Npz => {
            let directory = directory()?;
            for track in tracks {
                let file = directory.join(format!("{}.npz", track.name()));
                npz::write(streams, track, &file, &mut scenes, progress)?;
            }
        }
        ExportFormat::Vtu => vtu::write(streams, truth, directory()?, progress)?,
        #[cfg(feature = "hdf5")]
        ExportFormat::Vtkhdf if single_file => {
            super::vtkhdf::write(streams, only(&tracks, path)?, truth, staged, progress)?;
        }
        #[cfg(feature = "hdf5")]
        ExportFormat::Vtkhdf => {
            let directory = directory()?;
            for track in tracks {
                let file = directory.join(format!("{}.vtkhdf", track.name()));
                super::vtkhdf::write(streams, track, truth, &file, progress)?;
            }
        }
        ExportFormat::Ply => ply::write(streams, directory()?, progress)?,
        ExportFormat::Gns if single_file => gns::write(streams, &tracks, staged, None, progress)?,
        ExportFormat::Gns => {
            data_set::write_set(streams, directory()?, "npz", gns::write, progress)?
        }
        ExportFormat::Csv => csv::write(streams, staged, progress)?,
        #[cfg(feature = "hdf5")]
        ExportFormat::Hdf5 => {
            data_set::write_set(streams, directory()?, "h5", super::hdf5::write, progress)?
        }
        #[cfg(not(feature = "hdf5"))]
        ExportFormat::Hdf5 | ExportFormat::Vtkhdf => return Err(ExchangeError::NoHdf5),
    }
    output.commit().map_err(ExchangeError::output(path))
}

/// The only stream, for a format with one per file.
fn only<'a, const D: usize>(
    tracks: &[&'a Track<D>],
    path: &Path,
) -> Result<&'a Track<D>, ExchangeError> {
    match tracks {
        [track] => Ok(track),
        _ => Err(ExchangeError::OneFile { path: path.into(), found: tracks.len() }),
    }
}
