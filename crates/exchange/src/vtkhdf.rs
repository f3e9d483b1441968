//! VTKHDF: all frames of a stream in one `.vtkhdf` file, an unstructured grid that changes over time, for ParaView 5.12
//! and later. Every particle is a vertex with the properties of `point_data`.
//!
//! Arrays of all frames are concatenated; `Steps` has the row at which each frame starts. Frames with the same number of
//! particles share one part, so that only positions and properties are stored for each of them.
//!
//! Format: "VTKHDF File Format", version 2.0 (docs.vtk.org), with temporal data.

use std::path::Path;

use hdf5::{Dataset, File, Group, H5Type, types::FixedAscii};
use ndarray::ArrayView2;

use super::{
    error::ExchangeError,
    fields::strain_components,
    hdf5::{GZIP, hdf5_error},
    point_data::{self, PointArray, Values},
    streams::{Progress, Streams, Track},
    vtu::VERTEX,
};
use eddy_frames::{Frame, spatial};

/// Version of the format.
const VERSION: [i64; 2] = [2, 0];
/// Type of the data set.
const TYPE: &str = "UnstructuredGrid";
type TypeName = FixedAscii<{ TYPE.len() }>;
/// Largest chunk (rows).
const MAX_CHUNK: usize = 1 << 18;

/// Writes one stream.
pub(super) fn write<const D: usize>(
    streams: &Streams<D>,
    track: &Track<D>,
    truth: Option<&Streams<D>>,
    path: &Path,
    progress: &mut Progress<'_>,
) -> Result<(), ExchangeError> {
    let failed = |error| hdf5_error(path, error);
    let file = File::create_excl(path).map_err(failed)?;
    let mut series = Series::create(&file, track.particles()).map_err(failed)?;
    point_data::read(streams, track, truth, progress, |frame, arrays| {
        series.add(frame, arrays).map_err(failed)
    })?;
    series.finish().map_err(failed)?;
    file.close().map_err(failed)
}

/// A series of frames.
struct Series {
    root: Group,
    chunk: usize,
    points: Rows,
    connectivity: Rows,
    offsets: Rows,
    types: Rows,
    point_data: Vec<Rows>,
    /// Particles of each part.
    parts: Vec<i64>,
    steps: Vec<Step>,
}

/// Where a frame is.
struct Step {
    /// Stamp (s).
    time: f64,
    point: i64,
    part: i64,
    cell: i64,
}

impl Series {
    /// An empty series of frames of about `particles` particles.
    fn create(file: &File, particles: usize) -> hdf5::Result<Self> {
        let root = file.create_group("VTKHDF")?;
        root.new_attr::<i64>().shape(VERSION.len()).create("Version")?.write_raw(&VERSION)?;
        let name = TypeName::from_ascii(TYPE).map_err(|error| error.to_string())?;
        root.new_attr::<TypeName>().create("Type")?.write_scalar(&name)?;
        root.create_group("PointData")?;
        let chunk = particles.clamp(1, MAX_CHUNK);
        Ok(Self {
            chunk,
            points: Rows::table(&root, "Points", 3, chunk)?,
            connectivity: Rows::scalars::<i64>(&root, "Connectivity", chunk)?,
            offsets: Rows::scalars::<i64>(&root, "Offsets", chunk)?,
            types: Rows::scalars::<u8>(&root, "Types", chunk)?,
            root,
            point_data: Vec::new(),
            parts: Vec::new(),
            steps: Vec::new(),
        })
    }

    fn add<const D: usize>(&mut self, frame: &Frame<D>, arrays: &[PointArray]) -> hdf5::Result<()> {
        let particles = frame.len() as i64;
        if self.parts.last() != Some(&particles) {
            self.parts.push(particles);
            self.connectivity.append(&(0..particles).collect::<Vec<_>>())?;
            self.offsets.append(&(0..=particles).collect::<Vec<_>>())?;
            self.types.append(&vec![VERTEX; frame.len()])?;
        }
        self.steps.push(Step {
            time: frame.stamp.seconds(),
            point: self.points.count as i64,
            part: self.parts.len() as i64 - 1,
            cell: self.types.count as i64 - particles,
        });
        let position: Vec<_> = frame.position.iter().copied().map(spatial).collect();
        self.points.append_table(position.as_flattened())?;
        if self.point_data.is_empty() {
            let group = self.root.group("PointData")?;
            let create = |PointArray { name, values }: &PointArray| match values {
                Values::Byte(_) => Rows::scalars::<u8>(&group, name, self.chunk),
                Values::Scalar(_) => Rows::scalars::<f32>(&group, name, self.chunk),
                Values::Vector(_) => Rows::table(&group, name, 3, self.chunk),
                Values::Tensor(_) => {
                    Rows::table(&group, name, strain_components::<D>().len(), self.chunk)
                }
            };
            self.point_data = arrays.iter().map(create).collect::<hdf5::Result<_>>()?;
        }
        for (rows, PointArray { values, .. }) in self.point_data.iter_mut().zip(arrays) {
            match values {
                Values::Byte(values) => rows.append(values)?,
                Values::Scalar(values) => rows.append(values)?,
                Values::Vector(values) => rows.append_table(values.as_flattened())?,
                Values::Tensor(values) => rows.append_table(values)?,
            }
        }
        Ok(())
    }

    /// Writes what is known at the end: the parts, and where each frame is.
    fn finish(self) -> hdf5::Result<()> {
        for name in ["NumberOfPoints", "NumberOfCells", "NumberOfConnectivityIds"] {
            write_all(&self.root, name, &self.parts)?;
        }
        let steps = self.root.create_group("Steps")?;
        steps.new_attr::<i64>().create("NSteps")?.write_scalar(&(self.steps.len() as i64))?;
        let of = |value: fn(&Step) -> i64| self.steps.iter().map(value).collect::<Vec<_>>();
        let times: Vec<f64> = self.steps.iter().map(|step| step.time).collect();
        write_all(&steps, "Values", &times)?;
        write_all(&steps, "NumberOfParts", &of(|_| 1))?;
        write_all(&steps, "PartOffsets", &of(|step| step.part))?;
        let (points, cells) = (of(|step| step.point), of(|step| step.cell));
        write_all(&steps, "PointOffsets", &points)?;
        for name in ["CellOffsets", "ConnectivityIdOffsets"] {
            // A column for each topology: an unstructured grid has one.
            let shape = (cells.len(), 1);
            steps.new_dataset::<i64>().shape(shape).create(name)?.write_raw(&cells)?;
        }
        let offsets = steps.create_group("PointDataOffsets")?;
        for rows in &self.point_data {
            let name = rows.dataset.name();
            write_all(&offsets, name.rsplit('/').next().unwrap_or(&name), &points)?;
        }
        Ok(())
    }
}

fn write_all<T: H5Type>(group: &Group, name: &str, values: &[T]) -> hdf5::Result<()> {
    group.new_dataset::<T>().shape(values.len()).create(name)?.write_raw(values)
}

/// A dataset that grows, compressed with gzip where the HDF5 library can.
struct Rows {
    dataset: Dataset,
    count: usize,
}

impl Rows {
    /// One value per row.
    fn scalars<T: H5Type>(group: &Group, name: &str, chunk: usize) -> hdf5::Result<Self> {
        let builder = group.new_dataset::<T>().shape(0..).chunk(chunk);
        let builder = if deflates() { builder.shuffle().deflate(GZIP) } else { builder };
        Ok(Self { dataset: builder.create(name)?, count: 0 })
    }

    /// Numbers in columns.
    fn table(group: &Group, name: &str, columns: usize, chunk: usize) -> hdf5::Result<Self> {
        let builder = group.new_dataset::<f32>().shape((0.., columns)).chunk((chunk, columns));
        let builder = if deflates() { builder.shuffle().deflate(GZIP) } else { builder };
        Ok(Self { dataset: builder.create(name)?, count: 0 })
    }

    fn append<T: H5Type>(&mut self, values: &[T]) -> hdf5::Result<()> {
        let rows = self.count..self.count + values.len();
        self.count = rows.end;
        self.dataset.resize(rows.end)?;
        self.dataset.write_slice(values, rows)
    }

    fn append_table(&mut self, values: &[f32]) -> hdf5::Result<()> {
        let columns = self.dataset.shape()[1];
        let values = ArrayView2::from_shape((values.len() / columns, columns), values)
            .map_err(|error| error.to_string())?;
        let rows = self.count..self.count + values.nrows();
        self.count = rows.end;
        self.dataset.resize((rows.end, columns))?;
        self.dataset.write_slice(values, (rows, ..))
    }
}

fn deflates() -> bool {
    hdf5::filters::deflate_available()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::FrameSelection;
    use eddy_bag::{BagWriter, WriterOptions};
    use eddy_frames::{Domain, Material, Stamp};
    use eddy_messages::{FrameCdr, Message, ParticleFrame};

    fn frame(sequence: u64, particles: usize) -> Frame {
        Frame {
            stream: 0,
            sequence,
            stamp: Stamp(0).advance(0.016, sequence as u32),
            dt: 0.016,
            domain: Domain::UNIT,
            position: (0..particles).map(|i| [0.1 * i as f32, 0.01 * sequence as f32]).collect(),
            velocity: vec![[1.0, -0.5]; particles],
            material: vec![Material::Snow; particles],
        }
    }

    #[test]
    fn a_file_has_every_frame_and_one_part_for_frames_of_the_same_size() {
        let folder = tempfile::tempdir().unwrap();
        let bag = folder.path().join("bag");
        let mut writer = BagWriter::create(&bag, WriterOptions::default()).unwrap();
        let topic = writer.topic("/particles", ParticleFrame::TYPE).unwrap();
        let frames = [frame(0, 5), frame(1, 5), frame(2, 4), frame(3, 4), frame(4, 5)];
        for frame in &frames {
            writer.write(topic, frame.stamp, frame.stamp, &frame.to_cdr()).unwrap();
        }
        writer.finish().unwrap();
        let selection = FrameSelection {
            bags: vec![bag],
            topic: "/particles".into(),
            ..FrameSelection::default()
        };
        let streams: Streams = Streams::find(&selection, &mut || true).unwrap();
        let path = folder.path().join("series.vtkhdf");
        write(&streams, &streams.tracks()[0], Some(&streams), &path, &mut || true).unwrap();

        let root = File::open(&path).unwrap().group("VTKHDF").unwrap();
        let integers = |name: &str| root.dataset(name).unwrap().read_raw::<i64>().unwrap();
        assert_eq!(root.attr("Version").unwrap().read_raw::<i64>().unwrap(), VERSION);
        assert_eq!(integers("NumberOfPoints"), [5, 4, 5]);
        assert_eq!(integers("NumberOfCells"), [5, 4, 5]);
        assert_eq!(integers("Offsets"), [0, 1, 2, 3, 4, 5, 0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 5]);
        assert_eq!(integers("Connectivity"), [0, 1, 2, 3, 4, 0, 1, 2, 3, 0, 1, 2, 3, 4]);
        assert_eq!(integers("Steps/PartOffsets"), [0, 0, 1, 1, 2]);
        assert_eq!(integers("Steps/CellOffsets"), [0, 0, 5, 5, 9]);
        assert_eq!(integers("Steps/PointOffsets"), [0, 5, 10, 14, 18]);
        assert_eq!(integers("Steps/PointDataOffsets/velocity"), [0, 5, 10, 14, 18]);
        let times = root.dataset("Steps/Values").unwrap().read_raw::<f64>().unwrap();
        assert_eq!(times, frames.each_ref().map(|frame| frame.stamp.seconds()));
        let points = root.dataset("Points").unwrap();
        assert_eq!(points.shape(), [23, 3]);
        let expected =
            frames.iter().flat_map(|frame| &frame.position).flat_map(|&[x, y]| [x, y, 0.0]);
        assert_eq!(points.read_raw::<f32>().unwrap(), expected.collect::<Vec<_>>());
        let errors = root.dataset("PointData/error").unwrap().read_raw::<f32>().unwrap();
        assert_eq!(errors, [0.0; 23], "the truth itself");
    }
}
