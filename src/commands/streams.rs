//! The streams that a command works on.

use std::{collections::BTreeSet, path::PathBuf};

use anyhow::anyhow;
use eddy_dataset::{
    DatasetError, LoadOptions, Loaded, Trajectory, available_memory, load_trajectories,
};
use eddy_messages::UnusableFrame;
use eddy_pages::command_line;

use super::counted;

/// The streams of bags; those with an unusable frame are skipped and named, or refused.
pub(super) fn load(data: &[PathBuf], skip_streams: bool) -> anyhow::Result<Vec<Trajectory>> {
    let options = LoadOptions { memory: available_memory() / 2, skip_streams };
    let loaded = load_trajectories(data, options, &mut |_, _| ());
    let Loaded { streams, skipped } = loaded.map_err(|error| refused(error, skip_streams))?;
    name_skipped(&skipped, streams.iter());
    Ok(streams)
}

/// Why data cannot be used, and what can be done.
pub(super) fn refused(error: DatasetError, skip_streams: bool) -> anyhow::Error {
    match error {
        DatasetError::Unusable(first) if !skip_streams => refused_frame(&first),
        DatasetError::Unusable(first) => anyhow!("{first}; no stream is left"),
        other => other.into(),
    }
}

/// Why a stream cannot be used, and what can be done.
pub(super) fn refused_frame(first: &UnusableFrame) -> anyhow::Error {
    anyhow!(
        "{first}; --skip-streams leaves out such streams, `eddy bag check {}` lists what is wrong within a bag",
        command_line(&[first.path.display().to_string()])
    )
}

/// Warns of each stream that was skipped, and counts them beside those that are used.
pub(super) fn name_skipped<'a>(
    skipped: &[UnusableFrame],
    used: impl Iterator<Item = &'a Trajectory>,
) {
    let used: BTreeSet<_> = used.map(|stream| (&stream.source, stream.id)).collect();
    count_skipped(skipped, used.len());
}

/// Warns of each stream that was skipped, and counts them beside `used` others.
pub(super) fn count_skipped(skipped: &[UnusableFrame], used: usize) {
    for first in skipped {
        tracing::warn!("skipped: {first}");
    }
    if !skipped.is_empty() {
        let streams = counted(skipped.len() as u64, "stream");
        tracing::warn!("{streams} skipped, {used} used");
    }
}
