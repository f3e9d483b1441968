//! Data sets of graph network simulators: a file for each part of the split that `eddy train` makes (a single
//! stream is used for training), and `metadata.json` with statistics of the training part.

use std::path::{Path, PathBuf};

use super::{
    error::ExchangeError,
    metadata::{Metadata, Statistics},
    streams::{Progress, Streams, Track},
};
use eddy_dataset::Part;

const SCALE_RULE: &str = "metadata.json has one dt and one domain for all trajectories";

/// The files of a data set.
const PARTS: [(&str, Part); 3] =
    [("train", Part::Train), ("valid", Part::Validation), ("test", Part::Test)];

/// Writes one file of trajectories and adds them to the statistics.
pub(super) type Write<const D: usize> = fn(
    &Streams<D>,
    &[&Track<D>],
    &Path,
    Option<&mut Statistics<D>>,
    &mut Progress<'_>,
) -> Result<(), ExchangeError>;

/// Writes a data set of files with the given extension.
pub(super) fn write_set<const D: usize>(
    streams: &Streams<D>,
    directory: &Path,
    extension: &str,
    write: Write<D>,
    progress: &mut Progress<'_>,
) -> Result<(), ExchangeError> {
    let all: Vec<&Track<D>> = streams.tracks().iter().collect();
    check_scale(&all)?;
    let mut statistics = Statistics::default();
    for (name, part) in PARTS {
        let tracks = part_of(&all, part);
        if tracks.is_empty() {
            continue;
        }
        let counted = (part == Part::Train).then_some(&mut statistics);
        write(streams, &tracks, &directory.join(format!("{name}.{extension}")), counted, progress)?;
    }
    let (train, test) = (part_of(&all, Part::Train), part_of(&all, Part::Test));
    Metadata::new(&all, &train, &test, &statistics).write(directory)
}

/// The streams of one part.
fn part_of<'a, const D: usize>(all: &[&'a Track<D>], part: Part) -> Vec<&'a Track<D>> {
    let ids: Vec<u64> = all.iter().map(|track| track.stream).collect();
    all.iter().copied().filter(|track| Part::of(&ids, track.stream) == part).collect()
}

/// Checks that all streams have the same, constant dt and domain.
fn check_scale<const D: usize>(all: &[&Track<D>]) -> Result<(), ExchangeError> {
    for track in all {
        track.check_constant(&["dt", "domain", "sequence"], SCALE_RULE)?;
        let first = all[0];
        let differ = |field, found: String, expected: String| {
            Err(track.unsuitable(field, found, expected, SCALE_RULE))
        };
        if track.dt != first.dt {
            return differ("dt", format!("{} s", track.dt), format!("{} s", first.dt));
        }
        if track.domain != first.domain {
            let (found, expected) = (track.domain.to_string(), first.domain.to_string());
            return differ("domain", found, expected);
        }
    }
    Ok(())
}

/// Checks that the materials of a stream are constant.
pub(super) fn check_material<const D: usize>(
    track: &Track<D>,
    rule: &'static str,
) -> Result<(), ExchangeError> {
    if !track.material_varies {
        return Ok(());
    }
    let (found, expected) = ("materials that change".into(), "one per particle".into());
    Err(track.unsuitable("material", found, expected, rule))
}

/// The file, or the files of a data set in the order of its parts; `expected` names them in the error.
pub(super) fn files(
    path: &Path,
    extension: &str,
    expected: &'static str,
) -> Result<Vec<PathBuf>, ExchangeError> {
    if !path.is_dir() {
        return Ok(vec![path.into()]);
    }
    let parts = PARTS.map(|(name, _)| path.join(format!("{name}.{extension}")));
    let files: Vec<PathBuf> = parts.into_iter().filter(|file| file.exists()).collect();
    if files.is_empty() {
        let found = "none of its files".into();
        return Err(ExchangeError::File { path: path.into(), found, expected });
    }
    Ok(files)
}
