//! Summaries and `metadata.yaml` of the files that are there.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use crate::{
    bag::{
        error::BagError,
        index::{FileIndex, Watch},
        layout, metadata, summary,
        writer::{BagSummary, WrittenFile, WrittenTopic},
    },
    frame::Stamp,
};

/// What was done to a bag.
#[derive(Clone, Debug)]
pub struct Reindexed {
    /// The bag as its files are now.
    pub bag: BagSummary,
    /// The files that had no usable summary and have one now.
    pub summarized: Vec<PathBuf>,
}

/// Gives every file of a bag that lacks a usable summary a new one, and a directory a new
/// `metadata.yaml`. Each file is replaced as a whole; the records in it stay as they are.
///
/// # Errors
/// [`BagError::Unfinished`] and damage of a file, which [`Recovery`](super::Recovery) is for: nothing is
/// changed then. [`BagError::Io`] when writing failed, [`BagError::Interrupted`] when `watch`, which is
/// called with the bytes that were read since, wants no more: each file is then the old or the new one.
pub fn reindex(path: &Path, watch: &mut dyn FnMut(u64) -> bool) -> Result<Reindexed, BagError> {
    let files = layout::mcap_files(path)?;
    if let Some(active) = files.iter().find(|file| layout::is_active(file)) {
        return Err(BagError::Unfinished { path: active.clone() });
    }
    let mut indexes = open(&files, watch)?;
    let mut summarized = Vec::new();
    for index in indexes.iter().filter(|index| !index.summarized) {
        summarize(&index.path, watch)?;
        summarized.push(index.path.clone());
    }
    if !summarized.is_empty() {
        indexes = open(&files, &mut |_| true)?;
    }
    indexes.sort_by_key(|index| index.times.unwrap_or((u64::MAX, u64::MAX)));
    let bag = describe(path, &indexes);
    if path.is_dir() {
        metadata::write(&bag)?;
    }
    Ok(Reindexed { bag, summarized })
}

fn open(files: &[PathBuf], watch: &mut Watch<'_>) -> Result<Vec<FileIndex>, BagError> {
    let indexes: Vec<FileIndex> = files
        .iter()
        .enumerate()
        .map(|(number, file)| FileIndex::open_watched(file, number, watch))
        .collect::<Result<_, _>>()?;
    indexes.iter().flat_map(FileIndex::faults).next().map_or(Ok(()), Err)?;
    Ok(indexes)
}

/// Writes the summary of a file into a copy, which then takes its place.
fn summarize(file: &Path, watch: &mut Watch<'_>) -> Result<(), BagError> {
    let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let copy = file.with_file_name(format!(".{name}.{}.unfinished", std::process::id()));
    let replaced = fs::copy(file, &copy)
        .map_err(BagError::io(&copy, "copying the file"))
        .and_then(|_| summary::end_file(&copy, summary::Chunks::Stay, watch))
        .and_then(|_| fs::rename(&copy, file).map_err(BagError::io(file, "replacing the file")));
    if replaced.is_err() {
        // The first error counts.
        let _ = fs::remove_file(&copy);
    }
    replaced
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
