//! Writes missing summary sections and `metadata.yaml`.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{self, Read as _},
    path::{Path, PathBuf},
};

use crate::{
    error::BagError,
    format::{
        layout, metadata,
        summary::{BagSummary, WrittenFile, WrittenTopic},
    },
    read::index::{FileIndex, PROGRESS_STEP, Progress},
    write::finish::{OnFullDisk, finish_file},
};
use eddy_frames::Stamp;
use eddy_settings::atomic::Staged;

/// Result of reindexing a bag.
#[derive(Clone, Debug)]
pub struct Reindexed {
    /// The bag with its files as they are now.
    pub bag: BagSummary,
    /// The files that got a summary section.
    pub summarized: Vec<PathBuf>,
}

/// A bag to reindex: every file without a usable summary section gets a new one, and a directory a new
/// `metadata.yaml`. Files are replaced atomically; their records stay as they are.
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
            .map(|(number, file)| FileIndex::open_with_progress(file, number, progress))
            .collect::<Result<_, _>>()?;
        files.iter().flat_map(FileIndex::errors).next().map_or(Ok(()), Err)?;
        Ok(Self { path: path.into(), files })
    }

    /// Total size of the files without a usable summary section, which will be copied (bytes).
    pub fn to_copy(&self) -> u64 {
        self.files.iter().filter(|file| !file.summarized).map(|file| file.size).sum()
    }

    /// Writes the summary sections and `metadata.yaml`. `progress` is called with the number of bytes copied since
    /// the last call; `false` stops the operation, and each file is then either the old or the new one.
    ///
    /// # Errors
    /// [`BagError::Io`] when writing failed; [`BagError::Interrupted`] before the first file was replaced,
    /// [`BagError::PartlyReindexed`] after it.
    pub fn save(self, progress: &mut dyn FnMut(u64) -> bool) -> Result<Reindexed, BagError> {
        let Self { path, files } = self;
        let expected = files.iter().filter(|file| !file.summarized).count();
        let (mut indexes, mut summarized) = (Vec::new(), Vec::new());
        for mut index in files {
            if !index.summarized {
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
        let bag = describe(&path, &indexes);
        if path.is_dir() {
            metadata::write(&bag)?;
        }
        Ok(Reindexed { bag, summarized })
    }
}

/// Replaces a file by a copy with a summary section.
fn summarize(file: &Path, progress: &mut Progress<'_>) -> Result<FileIndex, BagError> {
    let staged = Staged::replacing(file).map_err(BagError::io(file, "copying the file"))?;
    let copy = staged.path();
    copy_file(file, &copy, progress)?;
    // From the records of the copy, regardless of the old summary section.
    let mut index = finish_file(&copy, FileIndex::scan(&copy)?, OnFullDisk::Fail)?;
    staged.commit().map_err(BagError::io(file, "replacing the file"))?;
    index.path = file.into();
    index.file = eddy_storage::File::open(file).map_err(BagError::io(file, "opening the file"))?;
    Ok(index)
}

fn copy_file(file: &Path, copy: &Path, progress: &mut Progress<'_>) -> Result<(), BagError> {
    let failed = |reason| BagError::Io { path: copy.into(), action: "copying the file", reason };
    let source = File::open(file).map_err(BagError::io(file, "opening the file"))?;
    let mut target = File::create(copy).map_err(failed)?;
    let permissions = source.metadata().map_err(failed)?.permissions();
    target.set_permissions(permissions).map_err(failed)?;
    loop {
        match io::copy(&mut (&source).take(PROGRESS_STEP), &mut target).map_err(failed)? {
            0 => return Ok(()),
            copied if progress(copied) => {}
            _ => return Err(BagError::Interrupted { path: file.into() }),
        }
    }
}

fn describe(path: &Path, indexes: &[FileIndex]) -> BagSummary {
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
    BagSummary::new(path.into(), files, topics(indexes), metadata::readable_custom_data(path))
}

fn topics(indexes: &[FileIndex]) -> Vec<WrittenTopic> {
    let mut topics: Vec<WrittenTopic> = Vec::new();
    let mut known: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    for index in indexes {
        for (id, channel) in &index.channels {
            let messages = index.counts.get(id).copied().unwrap_or_default();
            let same_name = known.entry(&channel.topic).or_default();
            match same_name.iter().find(|&&topic| topics[topic].channel == *channel) {
                Some(&topic) => topics[topic].messages += messages,
                None => {
                    same_name.push(topics.len());
                    topics.push(WrittenTopic { messages, ..WrittenTopic::new(channel) });
                }
            }
        }
    }
    topics
}
