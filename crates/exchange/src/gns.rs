//! The data sets of graph network simulators: DeepMind's `learning_to_simulate` in the `.npz` form
//! of its PyTorch ports (geoelements/gns, `gns/data_loader.py`).
//!
//! Those loaders read two forms. The common one, an object array a trajectory, is a pickle and is
//! neither written nor read here. The other is one structured array `gns_data` `[S]` with the fields
//! `position` `[T, N, 2]` and `particle_type` `[N]`: plain numbers, but `T` and `N` are the same for
//! all trajectories of a file.
//!
//! Positions only: velocities are differences between frames, in a GNS as in what is read here.

use std::path::Path;

use npyz::{DType, Field};

use super::{
    arrays::{Archive, ArchiveWriter},
    data_set::{files, one_material},
    error::ExchangeError,
    metadata::{Scale, Statistics},
    streams::{Streams, Track, Watch},
    trajectory::{Found, Types},
};

/// The structured array.
const DATA: &str = "gns_data";

/// GNS's types (`render_rollout.py`): 5 water, 6 sand, 7 goop. Snow goes as sand, jelly as goop, rope
/// as 8, which is free; 3 would be an obstacle that does not move.
const TYPES: Types = Types([5, 6, 7, 8]);

const RULE: &str = "without pickles, a GNS file holds trajectories of one shape; --frames N takes \
                    the first N frames of each, --stream takes one alone";

/// Writes one file of trajectories, frame by frame.
pub(super) fn write(
    streams: &Streams,
    tracks: &[&Track],
    path: &Path,
    mut statistics: Option<&mut Statistics>,
    watch: &mut Watch<'_>,
) -> Result<(), ExchangeError> {
    let first = tracks[0];
    for track in tracks {
        track.keeps(&["particles", "sequence"], RULE)?;
        one_material(track, RULE)?;
        for (field, found, expected) in [
            ("frames", track.frames, first.frames),
            ("particles", track.particles(), first.particles()),
        ] {
            if found != expected {
                let expected = format!("{expected} as in stream {}", first.stream);
                return Err(track.unfit(field, found.to_string(), expected, RULE));
            }
        }
    }
    let mut archive = ArchiveWriter::create(path)?;
    archive.begin(DATA, record(first.frames, first.particles()), &[tracks.len()])?;
    for track in tracks {
        if let Some(statistics) = &mut statistics {
            statistics.begin_trajectory();
        }
        streams.read(track, watch, |frame| {
            if let Some(statistics) = &mut statistics {
                statistics.add(&frame);
            }
            let numbers = frame.position.as_flattened().iter();
            archive.bytes(&numbers.flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>())
        })?;
        let types = track.material.iter().map(|&material| i64::from(TYPES.number(material)));
        archive.bytes(&types.flat_map(i64::to_le_bytes).collect::<Vec<u8>>())?;
    }
    archive.finish()
}

/// The type of one trajectory.
fn record(frames: usize, particles: usize) -> DType {
    let plain = |text: &str| {
        let text = text.parse().expect("a type string of numpy's");
        Box::new(DType::Plain(text))
    };
    let extents = |extents: &[usize], plain: Box<DType>| {
        let nest = |inner, &extent: &usize| Box::new(DType::Array(extent as u64, inner));
        *extents.iter().rev().fold(plain, nest)
    };
    let field = |name: &str, dtype| Field { name: name.into(), dtype };
    DType::Record(vec![
        field("position", extents(&[frames, particles, 2], plain("<f4"))),
        field("particle_type", extents(&[particles], plain("<i8"))),
    ])
}

/// Hands over the trajectories of a file, or of the files of a data set.
pub(super) fn read(
    path: &Path,
    scale: Option<&Scale>,
    mut each: impl FnMut(Found, &Path) -> Result<(), ExchangeError>,
) -> Result<(), ExchangeError> {
    for file in files(path, "npz", "train.npz, valid.npz or test.npz")? {
        let mut archive = Archive::open(&file)?;
        if !archive.has(DATA) {
            // The common form: its first array tells what it is.
            for name in archive.names() {
                archive.read::<f32>(&name)?;
            }
            return Err(ExchangeError::Array {
                path: file,
                array: DATA.into(),
                found: archive.names().join(", "),
                expected: "a structured array gns_data (position, particle_type)".into(),
            });
        }
        archive.records(DATA, |position, types| {
            let mut found = Found::new(&file, position)?;
            found.material = Some((types, TYPES));
            found.dt = scale.map(Scale::interval);
            found.domain = scale.and_then(Scale::domain);
            each(found, &file)
        })?;
    }
    Ok(())
}
