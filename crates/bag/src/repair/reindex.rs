//! Writes missing and wrong summary sections and indexes of chunks, and `metadata.yaml`.

use std::path::{Path, PathBuf};

use super::indexes::copy_with_indexes;
use crate::{
    error::BagError,
    format::{
        layout, metadata,
        summary::{BagSummary, OURS, WrittenFile},
    },
    read::{
        index::{FileIndex, Progress},
        open::Source,
        reader::BagReader,
    },
    write::finish::{OnFullDisk, finish_file},
};
use eddy_frames::Stamp;
use eddy_settings::atomic::Staged;

/// Result of reindexing a bag.
#[derive(Clone, Debug)]
pub struct Reindexed {
    /// The bag with its files as they are now.
    pub bag: BagSummary,
    /// The files that got a new summary section.
    pub summarized: Vec<PathBuf>,
}

/// A bag to reindex: every file without a summary section, or that says of its messages what is not so, gets a new one with new
/// message indexes and times of its chunks, and a directory a new `metadata.yaml`. Files are replaced atomically; their messages,
/// channels, attachments and metadata records stay as they are.
#[derive(Debug)]
pub struct Reindexing {
    path: PathBuf,
    files: Vec<FileIndex>,
}

impl Reindexing {
    /// Indexes the files. `progress` is called with the number of bytes read since the last call; `false` stops
    /// the operation.
    ///
    /// # Errors
    /// [`BagError::Unfinished`] and the damage of a file, which need a [`Recovery`](super::Recovery);
    /// [`BagError::Io`], [`BagError::NotABag`], [`BagError::Magic`], [`BagError::Interrupted`].
    pub fn open(path: &Path, progress: &mut dyn FnMut(u64) -> bool) -> Result<Self, BagError> {
        let files = layout::mcap_files(path)?;
        if let Some(active) = files.iter().find(|file| layout::is_active(file)) {
            return Err(BagError::Unfinished { path: active.clone() });
        }
        let files: Vec<FileIndex> = files
            .iter()
            .enumerate()
            .map(|(number, file)| FileIndex::open_by(file, number, Source::Scan, progress))
            .collect::<Result<_, _>>()?;
        files.iter().flat_map(FileIndex::errors).next().map_or(Ok(()), Err)?;
        // A summary section has one content for each id.
        let ambiguous = files.iter().filter(|file| file.has_ambiguous_ids());
        ambiguous.flat_map(|file| file.contradictions().0).next().map_or(Ok(()), Err)?;
        Ok(Self { path: path.into(), files })
    }

    /// Total size of the files that will be copied (bytes).
    pub fn to_copy(&self) -> u64 {
        self.files.iter().filter(|file| is_wrong(file)).map(|file| file.size).sum()
    }

    /// Writes the summary sections and `metadata.yaml`. `progress` is called with the number of bytes copied since
    /// the last call; `false` stops the operation, and each file is then either the old or the new one.
    ///
    /// # Errors
    /// [`BagError::Io`] when writing failed; [`BagError::Interrupted`] before the first file was replaced,
    /// [`BagError::PartlyReindexed`] after it.
    pub fn save(self, progress: &mut dyn FnMut(u64) -> bool) -> Result<Reindexed, BagError> {
        let Self { path, files } = self;
        let expected = files.iter().filter(|file| is_wrong(file)).count();
        let (mut indexes, mut summarized) = (Vec::new(), Vec::new());
        for mut index in files {
            if is_wrong(&index) {
                index = match summarize(&index.path, progress) {
                    Err(BagError::Interrupted { .. }) if !summarized.is_empty() => {
                        let summarized = summarized.len();
                        return Err(BagError::PartlyReindexed { path, summarized, expected });
                    }
                    summarized => summarized?,
                };
                summarized.push(index.path.clone());
            }
            indexes.push(index);
        }
        indexes.sort_by_key(|index| index.times.unwrap_or((u64::MAX, u64::MAX)));
        let bag = describe(&path, indexes);
        if path.is_dir() {
            metadata::write(&bag)?;
        }
        Ok(Reindexed { bag, summarized })
    }
}

/// Whether a file lacks a summary section, or says of its messages what is not so.
fn is_wrong(file: &FileIndex) -> bool {
    !file.summarized || file.contradictions().0.next().is_some()
}

/// Replaces a file by a copy with a summary section.
fn summarize(file: &Path, progress: &mut Progress<'_>) -> Result<FileIndex, BagError> {
    let staged = Staged::replacing(file).map_err(BagError::io(file, "copying the file"))?;
    let copy = staged.path();
    copy_with_indexes(file, &copy, progress)?;
    // From the records of the copy, regardless of the old summary section.
    let mut index = finish_file(&copy, FileIndex::scan(&copy)?, OnFullDisk::Fail)?;
    staged.commit().map_err(BagError::io(file, "replacing the file"))?;
    index.path = file.into();
    index.file = eddy_storage::File::open(file).map_err(BagError::io(file, "opening the file"))?;
    Ok(index)
}

fn describe(path: &Path, mut indexes: Vec<FileIndex>) -> BagSummary {
    let stamp = |time: u64| Stamp(i64::try_from(time).unwrap_or(i64::MAX));
    let files: Vec<WrittenFile> = indexes
        .iter()
        .map(|index| WrittenFile {
            path: index.path.clone(),
            messages: index.messages(),
            start: index.times.map(|(start, _)| stamp(start)),
            end: index.times.map(|(_, end)| stamp(end)),
            size: index.size,
        })
        .collect();
    // Everything is kept that the old metadata.yaml or the files say.
    let is_ours = indexes.iter().all(FileIndex::is_written_by_eddy);
    for (number, index) in indexes.iter_mut().enumerate() {
        index.set_number(number);
    }
    let bag = BagReader::from_files(path, indexes, metadata::readable(path));
    let distro = match bag.distro() {
        "" if is_ours => OURS,
        distro => distro,
    };
    let custom_data = bag.custom_data().clone();
    BagSummary::new(path.into(), files, bag.written_topics(), custom_data, distro.to_owned())
}
