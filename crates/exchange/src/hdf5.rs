//! The data sets of LagrangeBench: HDF5 files `train.h5`, `valid.h5`, `test.h5` with a group a
//! trajectory, `00000/position` `[T, N, 2]` (gzip) and `00000/particle_type` `[N]`, beside
//! `metadata.json` (tumaer/lagrangebench, `data_gen/lagrangebench_data/gen_dataset.py` and
//! `lagrangebench/data/data.py`). The paper's own data have this form.
//!
//! Positions only, as for [`super::gns`]. `T` is the same for all trajectories of a file, `N` need
//! not be. One trajectory at a time is held in memory.

use std::path::Path;

use hdf5::{Dataset, File, Group};

use super::{
    arrays::Array,
    data_set::{files, one_material},
    error::ExchangeError,
    metadata::{Scale, Statistics},
    streams::{Streams, Track, Watch},
    trajectory::{Found, Types},
};

/// LagrangeBench's types (`lagrangebench/utils.py`): 0 is fluid; 1 to 3 are walls and rigid bodies,
/// so the other materials get numbers that are free.
const TYPES: Types = Types([0, 4, 5, 6]);

/// Strength of the compression, h5py's default.
const GZIP: u8 = 4;

const RULE: &str = "LagrangeBench reads files whose trajectories have the same length and keep \
                    their particles; --frames N takes the first N frames of each";

/// Writes one file of trajectories, one after the other.
pub(super) fn write(
    streams: &Streams,
    tracks: &[&Track],
    path: &Path,
    mut statistics: Option<&mut Statistics>,
    watch: &mut Watch<'_>,
) -> Result<(), ExchangeError> {
    for track in tracks {
        track.keeps(&["particles"], RULE)?;
        one_material(track, RULE)?;
        let (found, expected) = (track.frames, tracks[0].frames);
        if found != expected {
            let expected = format!("{expected} as in stream {}", tracks[0].stream);
            return Err(track.unfit("frames", found.to_string(), expected, RULE));
        }
    }
    let failed = |error| refused(path, error);
    let file = File::create_excl(path).map_err(failed)?;
    for (number, track) in tracks.iter().enumerate() {
        if let Some(statistics) = &mut statistics {
            statistics.begin_trajectory();
        }
        let mut position = Vec::new();
        streams.read(track, watch, |frame| {
            if let Some(statistics) = &mut statistics {
                statistics.add(&frame);
            }
            position.extend_from_slice(frame.position.as_flattened());
            Ok(())
        })?;
        let types: Vec<i64> =
            track.material.iter().map(|&material| TYPES.number(material).into()).collect();
        let group = file.create_group(&format!("{number:05}")).map_err(failed)?;
        put(&group, &position, &types, track).map_err(failed)?;
    }
    file.close().map_err(failed)
}

fn put(group: &Group, position: &[f32], types: &[i64], track: &Track) -> hdf5::Result<()> {
    let shape = [track.frames, track.particles(), 2];
    let builder = group.new_dataset::<f32>().shape(shape);
    let dataset = if hdf5::filters::deflate_available() {
        builder.chunk([1, shape[1], 2]).deflate(GZIP).create("position")?
    } else {
        builder.create("position")?
    };
    dataset.write_raw(position)?;
    group.new_dataset::<i64>().shape(types.len()).create("particle_type")?.write_raw(types)
}

/// Hands over the trajectories of a file, or of the files of a data set.
pub(super) fn read(
    path: &Path,
    scale: Option<&Scale>,
    mut each: impl FnMut(Found, &Path) -> Result<(), ExchangeError>,
) -> Result<(), ExchangeError> {
    for path in files(path, "h5", "train.h5, valid.h5 or test.h5")? {
        let failed = |error| refused(&path, error);
        let file = File::open(&path).map_err(failed)?;
        let mut groups = file.groups().map_err(failed)?;
        groups.sort_by_key(|group| group.name());
        for group in groups {
            let position = array::<f32>(&group, "position").map_err(failed)?;
            let types = array::<i64>(&group, "particle_type").map_err(failed)?;
            let mut found = Found::new(&path, position)?;
            found.material = Some((types, TYPES));
            found.dt = scale.map(Scale::interval);
            found.domain = scale.and_then(Scale::domain);
            each(found, &path)?;
        }
    }
    Ok(())
}

/// How many times as many bytes deflate makes of its input at most.
const DEFLATE: usize = 1032;

fn array<T: hdf5::H5Type>(group: &Group, name: &str) -> hdf5::Result<Array<T>> {
    let dataset: Dataset = group.dataset(name)?;
    let shape = dataset.shape();
    // A header may declare anything: no more is read than could be stored in so many bytes.
    let declared = shape.iter().try_fold(size_of::<T>(), |bytes, &n| bytes.checked_mul(n));
    let most = usize::try_from(dataset.storage_size()).unwrap_or(usize::MAX);
    if declared.is_none_or(|bytes| bytes > most.saturating_mul(DEFLATE)) {
        return Err(format!("{name}: found {shape:?} values in {most} bytes").into());
    }
    Ok(Array { shape, values: dataset.read_raw()? })
}

fn refused(path: &Path, error: hdf5::Error) -> ExchangeError {
    ExchangeError::Hdf5 { path: path.into(), reason: error.to_string() }
}
