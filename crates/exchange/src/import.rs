//! Imports trajectories into bags.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use super::{
    error::ExchangeError,
    gns,
    metadata::Scale,
    npz,
    streams::Progress,
    trajectory::{ImportOverrides, RawTrajectory},
};
use eddy_bag::{BagWriter, WriterOptions};
use eddy_dataset::TRUTH_TOPIC;
use eddy_messages::{FrameCdr, Message, ParticleFrame};
use eddy_settings::atomic::Staged;

/// Formats for import.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum ImportFormat {
    /// NumPy arrays, one .npz per stream: a file, or a directory of files.
    Npz,
    /// A data set for graph network simulators: an .npz file, or a directory of them with its metadata.json.
    Gns,
    /// A data set in the format of LagrangeBench: an .h5 file, or a directory of them with its metadata.json.
    #[cfg_attr(feature = "clap", value(alias = "lagrangebench"))]
    Hdf5,
}

/// Result of an import.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Imported {
    /// Number of streams, each in a bag of its own.
    pub streams: usize,
    /// Total number of frames.
    pub frames: usize,
}

/// Reads trajectories and writes bags like those of `eddy simulate`, one per stream, with the frames on
/// [`TRUTH_TOPIC`]: `output/stream_0007` and so on. `output` appears when it is complete. One trajectory at a time
/// is in memory.
///
/// Stream ids come from the files, or count up. Missing velocities are backward differences of the positions
/// (forward for the first frame).
///
/// # Errors
/// [`ExchangeError`] when data is missing, malformed, or an object array; when `output` exists; when a bag cannot be
/// written.
pub fn import(
    path: &Path,
    format: ImportFormat,
    overrides: &ImportOverrides,
    output: &Path,
    progress: &mut Progress<'_>,
) -> Result<Imported, ExchangeError> {
    let staged = Staged::new(output).map_err(ExchangeError::output(output))?;
    let directory = staged.path();
    fs::create_dir(&directory).map_err(ExchangeError::io(&directory, "creating the directory"))?;
    let mut bags = Bags { directory, overrides, sources: BTreeMap::new(), frames: 0, progress };
    match format {
        ImportFormat::Npz => {
            for file in npz_files(path)? {
                bags.write(npz::read(&file)?, &file)?;
            }
        }
        ImportFormat::Gns => {
            let scale = scale(path, overrides)?;
            gns::read(path, scale.as_ref(), |trajectory, file| bags.write(trajectory, file))?;
        }
        #[cfg(feature = "hdf5")]
        ImportFormat::Hdf5 => {
            let scale = scale(path, overrides)?;
            super::hdf5::read(path, scale.as_ref(), |trajectory, file| {
                bags.write(trajectory, file)
            })?;
        }
        #[cfg(not(feature = "hdf5"))]
        ImportFormat::Hdf5 => return Err(ExchangeError::NoHdf5),
    }
    let imported = Imported { streams: bags.sources.len(), frames: bags.frames };
    staged.commit().map_err(ExchangeError::output(output))?;
    Ok(imported)
}

/// `metadata.json` of a data set, unless the overrides replace it.
fn scale(path: &Path, overrides: &ImportOverrides) -> Result<Option<Scale>, ExchangeError> {
    if overrides.dt.is_some() && overrides.domain.is_some() {
        return Ok(None);
    }
    let directory = if path.is_dir() { Some(path) } else { path.parent() };
    directory.map_or(Ok(None), Scale::read)
}

/// The file, or the `.npz` files of a directory, sorted by name.
fn npz_files(path: &Path) -> Result<Vec<PathBuf>, ExchangeError> {
    if !path.is_dir() {
        return Ok(vec![path.into()]);
    }
    let failed = || ExchangeError::io(path, "listing the directory");
    let mut files = Vec::new();
    for entry in fs::read_dir(path).map_err(failed())? {
        let file = entry.map_err(failed())?.path();
        if file.extension().is_some_and(|extension| extension == "npz") {
            files.push(file);
        }
    }
    files.sort();
    if files.is_empty() {
        return Err(ExchangeError::File {
            path: path.into(),
            found: "no .npz file".into(),
            expected: "at least one",
        });
    }
    Ok(files)
}

/// The bags that are being written.
struct Bags<'a, 'b> {
    directory: PathBuf,
    overrides: &'a ImportOverrides,
    /// The file of each stream.
    sources: BTreeMap<u64, PathBuf>,
    frames: usize,
    progress: &'a mut Progress<'b>,
}

impl Bags<'_, '_> {
    fn write(&mut self, trajectory: RawTrajectory, file: &Path) -> Result<(), ExchangeError> {
        let next = self.sources.last_key_value().map_or(0, |(last, _)| last.saturating_add(1));
        let stream = trajectory.stream.unwrap_or(next);
        if let Some(first) = self.sources.insert(stream, file.into()) {
            return Err(ExchangeError::SameStream { stream, first, second: file.into() });
        }
        self.frames += trajectory.frames();
        let bag = self.directory.join(format!("stream_{stream:04}"));
        let mut writer = BagWriter::create(&bag, WriterOptions::default())?;
        writer.extend_custom_data(trajectory.custom_data(self.overrides));
        match trajectory.dimension() {
            3 => self.write_frames::<3>(trajectory, stream, &mut writer)?,
            _ => self.write_frames::<2>(trajectory, stream, &mut writer)?,
        }
        writer.finish()?;
        Ok(())
    }

    fn write_frames<const D: usize>(
        &mut self,
        trajectory: RawTrajectory,
        stream: u64,
        writer: &mut BagWriter,
    ) -> Result<(), ExchangeError> {
        let topic = writer.topic(TRUTH_TOPIC, ParticleFrame::TYPE)?;
        trajectory.frames_with::<D>(stream, self.overrides, |frame| {
            writer.write_stamped(topic, frame.stamp, &frame.to_cdr())?;
            if (self.progress)() { Ok(()) } else { Err(ExchangeError::Interrupted) }
        })
    }
}
