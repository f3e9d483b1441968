//! Into bags.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use super::{error::ExchangeError, gns, metadata::Scale, npz, streams::Watch, trajectory::Found};
use eddy_bag::{BagWriter, WriterOptions};
use eddy_evaluation::dataset::TRUTH_TOPIC;
use eddy_frames::{Domain, Material};
use eddy_messages::{FrameCdr, Message, ParticleFrame};
use eddy_settings::atomic::Staged;

/// What frames can be read from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum ImportFormat {
    /// numpy arrays, one .npz a stream: a file, or a directory of files.
    Npz,
    /// A data set for graph network simulators: an .npz file, or a directory of them with its metadata.json.
    Gns,
    /// A data set as LagrangeBench has it: an .h5 file, or a directory of them with its metadata.json.
    #[cfg_attr(feature = "clap", value(alias = "lagrangebench"))]
    Hdf5,
}

/// What files may lack. What is given here goes before what they hold.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Supplement {
    /// Time between two frames (s).
    pub dt: Option<f32>,
    /// The box that holds the particles; the unit square where nobody tells and all lie in it.
    pub domain: Option<Domain>,
    /// What all particles are made of.
    pub material: Option<Material>,
}

/// What was imported.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Imported {
    /// How many streams, one bag each.
    pub streams: usize,
    /// How many frames they have together.
    pub frames: usize,
}

/// Reads trajectories and writes bags as `eddy simulate` does, one a stream, on [`TRUTH_TOPIC`]:
/// `output/stream_0007` and so on. `output` is there whole or not at all. One trajectory at a time
/// is held in memory.
///
/// Streams are numbered as the files say, or in their order. Velocities that a file lacks are
/// backward differences of its positions (forward for the first frame).
///
/// # Errors
/// [`ExchangeError`] when something is missing, malformed, or an object array; when `output` exists;
/// when a bag cannot be written.
pub fn import(
    path: &Path,
    format: ImportFormat,
    supplement: &Supplement,
    output: &Path,
    watch: &mut Watch<'_>,
) -> Result<Imported, ExchangeError> {
    let staged = Staged::new(output).map_err(ExchangeError::output(output))?;
    let directory = staged.path();
    fs::create_dir(&directory).map_err(ExchangeError::io(&directory, "creating the directory"))?;
    let mut bags = Bags { directory, supplement, sources: BTreeMap::new(), frames: 0, watch };
    match format {
        ImportFormat::Npz => {
            for file in npz_files(path)? {
                bags.write(npz::read(&file)?, &file)?;
            }
        }
        ImportFormat::Gns => {
            let scale = scale(path, supplement)?;
            gns::read(path, scale.as_ref(), |found, file| bags.write(found, file))?;
        }
        #[cfg(feature = "hdf5")]
        ImportFormat::Hdf5 => {
            let scale = scale(path, supplement)?;
            super::hdf5::read(path, scale.as_ref(), |found, file| bags.write(found, file))?;
        }
        #[cfg(not(feature = "hdf5"))]
        ImportFormat::Hdf5 => return Err(ExchangeError::NoHdf5),
    }
    let imported = Imported { streams: bags.sources.len(), frames: bags.frames };
    staged.commit().map_err(ExchangeError::output(output))?;
    Ok(imported)
}

/// The `metadata.json` of a data set, where it is needed.
fn scale(path: &Path, supplement: &Supplement) -> Result<Option<Scale>, ExchangeError> {
    if supplement.dt.is_some() && supplement.domain.is_some() {
        return Ok(None);
    }
    let directory = if path.is_dir() { Some(path) } else { path.parent() };
    directory.map_or(Ok(None), Scale::read)
}

/// The file, or the `.npz` files in a directory by their names.
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
    supplement: &'a Supplement,
    /// The file of each stream.
    sources: BTreeMap<u64, PathBuf>,
    frames: usize,
    watch: &'a mut Watch<'b>,
}

impl Bags<'_, '_> {
    fn write(&mut self, found: Found, file: &Path) -> Result<(), ExchangeError> {
        let next = self.sources.last_key_value().map_or(0, |(last, _)| last.saturating_add(1));
        let stream = found.stream().unwrap_or(next);
        if let Some(first) = self.sources.insert(stream, file.into()) {
            return Err(ExchangeError::SameStream { stream, first, second: file.into() });
        }
        self.frames += found.frames();
        let bag = self.directory.join(format!("stream_{stream:04}"));
        let mut writer = BagWriter::create(&bag, WriterOptions::default())?;
        let topic = writer.topic(TRUTH_TOPIC, ParticleFrame::TYPE)?;
        found.hand_over(stream, self.supplement, |frame| {
            writer.write(topic, frame.stamp, frame.stamp, &frame.to_cdr())?;
            if (self.watch)() { Ok(()) } else { Err(ExchangeError::Interrupted) }
        })?;
        writer.finish()?;
        Ok(())
    }
}
