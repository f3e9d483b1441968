//! Summaries and `metadata.yaml` of the files that are there.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{self, Read as _},
    path::{Path, PathBuf},
};

use crate::{
    error::BagError,
    index::{FileIndex, WATCHED, Watch},
    layout, metadata, summary,
    writer::{BagSummary, WrittenFile, WrittenTopic},
};
use eddy_frames::Stamp;
use eddy_settings::atomic::Staged;

/// What was done to a bag.
#[derive(Clone, Debug)]
pub struct Reindexed {
    /// The bag as its files are now.
    pub bag: BagSummary,
    /// The files that had no usable summary and have one now.
    pub summarized: Vec<PathBuf>,
}

/// A bag of which every file that lacks a usable summary will get a new one, and a directory a new
/// `metadata.yaml`. Each file is replaced as a whole; the records in it stay as they are.
#[derive(Debug)]
pub struct Reindexing {
    path: PathBuf,
    files: Vec<FileIndex>,
}

impl Reindexing {
    /// Looks at all files. `watch` is called with the bytes that were passed over since; `false` ends the
    /// work.
    ///
    /// # Errors
    /// [`BagError::Unfinished`] and damage of a file, which [`Recovery`](super::Recovery) is for;
    /// [`BagError::Io`], [`BagError::NotABag`], [`BagError::Magic`], [`BagError::Interrupted`].
    pub fn open(path: &Path, watch: &mut dyn FnMut(u64) -> bool) -> Result<Self, BagError> {
        let files = layout::mcap_files(path)?;
        if let Some(active) = files.iter().find(|file| layout::is_active(file)) {
            return Err(BagError::Unfinished { path: active.clone() });
        }
        let files: Vec<FileIndex> = files
            .iter()
            .enumerate()
            .map(|(number, file)| FileIndex::open_watched(file, number, watch))
            .collect::<Result<_, _>>()?;
        files.iter().flat_map(FileIndex::faults).next().map_or(Ok(()), Err)?;
        Ok(Self { path: path.into(), files })
    }

    /// Size of the files that will be copied, those without a usable summary (bytes).
    pub fn to_copy(&self) -> u64 {
        self.files.iter().filter(|file| !file.summarized).map(|file| file.size).sum()
    }

    /// Writes the summaries and `metadata.yaml`. `watch` is called with the bytes that were copied since;
    /// `false` ends the work, and each file is then the old or the new one.
    ///
    /// # Errors
    /// [`BagError::Io`] when writing failed; [`BagError::Interrupted`] when no file was replaced yet,
    /// [`BagError::PartlyReindexed`] later.
    pub fn save(self, watch: &mut dyn FnMut(u64) -> bool) -> Result<Reindexed, BagError> {
        let Self { path, files } = self;
        let expected = files.iter().filter(|file| !file.summarized).count();
        let (mut indexes, mut summarized) = (Vec::new(), Vec::new());
        for mut index in files {
            if !index.summarized {
                index = match summarize(&index.path, watch) {
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

/// Writes the summary of a file into a copy, which then takes its place.
fn summarize(file: &Path, watch: &mut Watch<'_>) -> Result<FileIndex, BagError> {
    let staged = Staged::replacing(file).map_err(BagError::io(file, "copying the file"))?;
    let copy = staged.path();
    copy_watched(file, &copy, watch)?;
    // The records of the copy count, whatever the old summary says.
    let index = summary::end_file(&copy, FileIndex::walk(&copy)?, summary::Chunks::Stay)?;
    staged.commit().map_err(BagError::io(file, "replacing the file"))?;
    Ok(FileIndex { path: file.into(), ..index })
}

fn copy_watched(file: &Path, copy: &Path, watch: &mut Watch<'_>) -> Result<(), BagError> {
    let failed = |reason| BagError::Io { path: copy.into(), action: "copying the file", reason };
    let source = File::open(file).map_err(BagError::io(file, "opening the file"))?;
    let mut target = File::create(copy).map_err(failed)?;
    let permissions = source.metadata().map_err(failed)?.permissions();
    target.set_permissions(permissions).map_err(failed)?;
    loop {
        match io::copy(&mut (&source).take(WATCHED), &mut target).map_err(failed)? {
            0 => return Ok(()),
            copied if watch(copied) => {}
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
    BagSummary {
        directory: path.into(),
        messages: files.iter().map(|file| file.messages).sum(),
        lost: 0,
        start: files.iter().filter_map(|file| file.start).min(),
        end: files.iter().filter_map(|file| file.end).max(),
        files,
        topics: topics(indexes),
        custom_data: metadata::custom_data(path).unwrap_or_default(),
    }
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
