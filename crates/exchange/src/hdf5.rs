//! The data sets of LagrangeBench: HDF5 files `train.h5`, `valid.h5`, `test.h5` with a group per trajectory,
//! `00000/position` `[T, N, D]` (gzip) and `00000/particle_type` `[N]`, beside `metadata.json`
//! (tumaer/lagrangebench, `data_gen/lagrangebench_data/gen_dataset.py` and `lagrangebench/data/data.py`).
//!
//! Positions only, as in [`super::gns`]. All trajectories of a file have the same `T`; `N` may differ. One
//! trajectory at a time is in memory.

use std::path::Path;

use hdf5::{Dataset, File, Group};

use super::{
    arrays::Array,
    data_set::{check_material, files},
    error::ExchangeError,
    metadata::{Scale, Statistics},
    streams::{Progress, Streams, Track},
    trajectory::{RawTrajectory, Types},
};

/// Particle types of LagrangeBench (`lagrangebench/utils.py`): 0 is fluid, 1 to 3 are walls and rigid bodies; the
/// other materials get unused numbers.
const TYPES: Types = Types([0, 4, 5, 6, 7]);

/// Compression level, the default of h5py.
pub(super) const GZIP: u8 = 4;

const RULE: &str = "LagrangeBench needs trajectories of equal length with a constant number of \
                    particles; --frames N selects the first N frames of each";

/// Writes one file of trajectories, one after the other.
pub(super) fn write<const D: usize>(
    streams: &Streams<D>,
    tracks: &[&Track<D>],
    path: &Path,
    mut statistics: Option<&mut Statistics<D>>,
    progress: &mut Progress<'_>,
) -> Result<(), ExchangeError> {
    for track in tracks {
        track.check_constant(&["particles"], RULE)?;
        check_material(track, RULE)?;
        let (found, expected) = (track.frames, tracks[0].frames);
        if found != expected {
            let expected = format!("{expected} as in stream {}", tracks[0].stream);
            return Err(track.unsuitable("frames", found.to_string(), expected, RULE));
        }
    }
    let failed = |error| hdf5_error(path, error);
    let file = File::create_excl(path).map_err(failed)?;
    for (number, track) in tracks.iter().enumerate() {
        if let Some(statistics) = &mut statistics {
            statistics.begin_trajectory();
        }
        let mut position = Vec::new();
        streams.read(track, progress, |frame| {
            if let Some(statistics) = &mut statistics {
                statistics.add(&frame);
            }
            position.extend_from_slice(frame.position.as_flattened());
            Ok(())
        })?;
        let types: Vec<i64> =
            track.material.iter().map(|&material| TYPES.number(material).into()).collect();
        let group = file.create_group(&format!("{number:05}")).map_err(failed)?;
        write_group(&group, &position, &types, track).map_err(failed)?;
    }
    file.close().map_err(failed)
}

fn write_group<const D: usize>(
    group: &Group,
    position: &[f32],
    types: &[i64],
    track: &Track<D>,
) -> hdf5::Result<()> {
    let shape = [track.frames, track.particles(), D];
    let builder = group.new_dataset::<f32>().shape(shape);
    let dataset = if hdf5::filters::deflate_available() {
        builder.chunk([1, shape[1], D]).deflate(GZIP).create("position")?
    } else {
        builder.create("position")?
    };
    dataset.write_raw(position)?;
    group.new_dataset::<i64>().shape(types.len()).create("particle_type")?.write_raw(types)
}

/// Calls `each` for the trajectories of a file, or of the files of a data set.
pub(super) fn read(
    path: &Path,
    scale: Option<&Scale>,
    mut each: impl FnMut(RawTrajectory, &Path) -> Result<(), ExchangeError>,
) -> Result<(), ExchangeError> {
    for path in files(path, "h5", "train.h5, valid.h5 or test.h5")? {
        let failed = |error| hdf5_error(&path, error);
        let file = File::open(&path).map_err(failed)?;
        let mut groups = file.groups().map_err(failed)?;
        groups.sort_by_key(|group| group.name());
        for group in groups {
            let position = array::<f32>(&group, "position").map_err(failed)?;
            let types = array::<i64>(&group, "particle_type").map_err(failed)?;
            let mut trajectory = RawTrajectory::new(&path, position)?;
            trajectory.material = Some((types, TYPES));
            trajectory.dt = scale.map(Scale::interval);
            trajectory.domain = scale.and_then(Scale::domain);
            each(trajectory, &path)?;
        }
    }
    Ok(())
}

/// Largest expansion of deflate.
const DEFLATE: usize = 1032;

fn array<T: hdf5::H5Type>(group: &Group, name: &str) -> hdf5::Result<Array<T>> {
    let dataset: Dataset = group.dataset(name)?;
    let shape = dataset.shape();
    // Checked because memory for the declared shape is allocated.
    let declared = shape.iter().try_fold(size_of::<T>(), |bytes, &n| bytes.checked_mul(n));
    let most = usize::try_from(dataset.storage_size()).unwrap_or(usize::MAX);
    if declared.is_none_or(|bytes| bytes > most.saturating_mul(DEFLATE)) {
        return Err(format!("{name}: shape {shape:?} does not fit in {most} stored bytes").into());
    }
    Ok(Array { shape, values: dataset.read_raw()? })
}

/// An error of the library.
pub(super) fn hdf5_error(path: &Path, error: hdf5::Error) -> ExchangeError {
    ExchangeError::Hdf5 { path: path.into(), reason: error.to_string() }
}
