//! The data sets of graph network simulators: DeepMind's `learning_to_simulate` in the `.npz` form
//! of its PyTorch ports (geoelements/gns, `gns/data_loader.py`).
//!
//! Its loaders read two forms. The common one, an object array per trajectory, is a pickle and neither written
//! nor read here. The other is one structured array `gns_data` `[S]` with the fields `position` `[T, N, D]` and
//! `particle_type` `[N]`: plain numbers, with the same `T` and `N` for all trajectories of a file.
//!
//! Positions only; velocities are differences between frames.

use std::path::Path;

use npyz::{DType, Field};

use super::{
    arrays::{Archive, ArchiveWriter},
    data_set::{check_material, files},
    error::ExchangeError,
    metadata::{Scale, Statistics},
    streams::{Progress, Streams, Track},
    trajectory::{RawTrajectory, Types},
};

/// The structured array.
const DATA: &str = "gns_data";

/// Particle types of GNS (`render_rollout.py`): 5 water, 6 sand, 7 goop. Jelly is written as goop, snow and rope as 4 and 8,
/// which are unused; 3 is a static obstacle.
const TYPES: Types = Types([5, 4, 7, 8, 6]);

const RULE: &str = "without pickles, a GNS file has trajectories of one shape; --frames N selects \
                    the first N frames of each, --stream a single stream";

/// Writes one file of trajectories, frame by frame.
pub(super) fn write<const D: usize>(
    streams: &Streams<D>,
    tracks: &[&Track<D>],
    path: &Path,
    mut statistics: Option<&mut Statistics<D>>,
    progress: &mut Progress<'_>,
) -> Result<(), ExchangeError> {
    let first = tracks[0];
    for track in tracks {
        track.check_constant(&["particles", "sequence"], RULE)?;
        check_material(track, RULE)?;
        for (field, found, expected) in [
            ("frames", track.frames, first.frames),
            ("particles", track.particles(), first.particles()),
        ] {
            if found != expected {
                let expected = format!("{expected} as in stream {}", first.stream);
                return Err(track.unsuitable(field, found.to_string(), expected, RULE));
            }
        }
    }
    let mut archive = ArchiveWriter::create(path)?;
    archive.begin(DATA, record([first.frames, first.particles(), D]), &[tracks.len()])?;
    for track in tracks {
        if let Some(statistics) = &mut statistics {
            statistics.begin_trajectory();
        }
        streams.read(track, progress, |frame| {
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

/// Element type of the array: one trajectory.
fn record(position: [usize; 3]) -> DType {
    let plain = |text: &str| {
        let text = text.parse().expect("a valid NumPy type string");
        Box::new(DType::Plain(text))
    };
    let extents = |extents: &[usize], plain: Box<DType>| {
        let nest = |inner, &extent: &usize| Box::new(DType::Array(extent as u64, inner));
        *extents.iter().rev().fold(plain, nest)
    };
    let field = |name: &str, dtype| Field { name: name.into(), dtype };
    DType::Record(vec![
        field("position", extents(&position, plain("<f4"))),
        field("particle_type", extents(&position[1..2], plain("<i8"))),
    ])
}

/// Calls `each` for the trajectories of a file, or of the files of a data set.
pub(super) fn read(
    path: &Path,
    scale: Option<&Scale>,
    mut each: impl FnMut(RawTrajectory, &Path) -> Result<(), ExchangeError>,
) -> Result<(), ExchangeError> {
    for file in files(path, "npz", "train.npz, valid.npz or test.npz")? {
        let mut archive = Archive::open(&file)?;
        if !archive.has(DATA) {
            // Fails with the reason if the file has the common form.
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
            let mut trajectory = RawTrajectory::new(&file, position)?;
            trajectory.material = Some((types, TYPES));
            trajectory.dt = scale.map(Scale::interval);
            trajectory.domain = scale.and_then(Scale::domain);
            each(trajectory, &file)
        })?;
    }
    Ok(())
}
