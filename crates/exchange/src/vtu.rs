//! VTK unstructured grids, one `.vtu` per frame, and a `.pvd` collection per stream to open in ParaView. Every
//! particle is a vertex with the properties of `point_data`.
//!
//! Format: "VTK XML Formats" (docs.vtk.org), inline base64 with 64-bit headers.

use std::{fmt::Write as _, fs, path::Path};

use base64::{Engine, engine::general_purpose::STANDARD};

use super::{
    error::ExchangeError,
    fields::strain_components,
    point_data::{self, PointArray, Values},
    streams::{Progress, Streams},
};
use eddy_frames::{Frame, spatial};

/// Cell type of a vertex (`vtkCellType.h`).
pub(super) const VERTEX: u8 = 1;

/// Writes `stream_0007.pvd`, `stream_0007/000000.vtu` and so on into the directory.
pub(super) fn write<const D: usize>(
    streams: &Streams<D>,
    truth: Option<&Streams<D>>,
    directory: &Path,
    progress: &mut Progress<'_>,
) -> Result<(), ExchangeError> {
    for track in streams.tracks() {
        let name = track.name();
        let folder = directory.join(&name);
        fs::create_dir(&folder).map_err(ExchangeError::io(&folder, "creating the directory"))?;
        let mut collection = header("Collection");
        collection.push_str("  <Collection>\n");
        let mut number = 0;
        point_data::read(streams, track, truth, progress, |frame, arrays| {
            let path = folder.join(format!("{number:06}.vtu"));
            let time = frame.stamp.seconds();
            line(
                &mut collection,
                format_args!(
                    "    <DataSet timestep=\"{time}\" part=\"0\" file=\"{name}/{number:06}.vtu\"/>"
                ),
            );
            number += 1;
            fs::write(&path, grid(frame, arrays)).map_err(ExchangeError::io(&path, "writing"))
        })?;
        collection.push_str("  </Collection>\n</VTKFile>\n");
        let path = directory.join(format!("{name}.pvd"));
        fs::write(&path, collection).map_err(ExchangeError::io(&path, "writing"))?;
    }
    Ok(())
}

/// One frame as the text of a `.vtu` file.
fn grid<const D: usize>(frame: &Frame<D>, arrays: &[PointArray]) -> String {
    let particles = frame.len();
    let count = particles as i64;
    let mut text = header("UnstructuredGrid");
    text.push_str("  <UnstructuredGrid>\n    <FieldData>\n");
    array(
        &mut text,
        "TimeValue",
        "Float64",
        "NumberOfTuples=\"1\"",
        [frame.stamp.seconds().to_le_bytes()],
    );
    text.push_str("    </FieldData>\n");
    line(
        &mut text,
        format_args!("    <Piece NumberOfPoints=\"{particles}\" NumberOfCells=\"{particles}\">"),
    );
    text.push_str("    <Points>\n");
    let position: Vec<_> = frame.position.iter().copied().map(spatial).collect();
    floats(&mut text, "Points", VECTOR, position.as_flattened());
    let tensor = tensor_attributes(strain_components::<D>());
    text.push_str("    </Points>\n    <PointData Scalars=\"material\" Vectors=\"velocity\">\n");
    for PointArray { name, values } in arrays {
        match values {
            Values::Byte(values) => {
                array(&mut text, name, "UInt8", "", values.iter().map(|&x| [x]))
            }
            Values::Scalar(values) => floats(&mut text, name, "", values),
            Values::Vector(values) => floats(&mut text, name, VECTOR, values.as_flattened()),
            Values::Tensor(values) => floats(&mut text, name, &tensor, values),
        }
    }
    text.push_str("    </PointData>\n    <Cells>\n");
    array(&mut text, "connectivity", "Int64", "", (0..count).map(i64::to_le_bytes));
    array(&mut text, "offsets", "Int64", "", (1..=count).map(i64::to_le_bytes));
    array(&mut text, "types", "UInt8", "", (0..count).map(|_| [VERTEX]));
    text.push_str("    </Cells>\n    </Piece>\n  </UnstructuredGrid>\n</VTKFile>\n");
    text
}

/// Attribute of arrays with three numbers per particle.
const VECTOR: &str = "NumberOfComponents=\"3\"";

/// Attributes of a symmetric tensor with these components.
fn tensor_attributes(components: &[(&str, [usize; 2])]) -> String {
    let mut attributes = format!("NumberOfComponents=\"{}\"", components.len());
    for (number, (name, _)) in components.iter().enumerate() {
        write!(attributes, " ComponentName{number}=\"{name}\"").expect("a String takes it");
    }
    attributes
}

fn header(kind: &str) -> String {
    format!(
        "<?xml version=\"1.0\"?>\n<VTKFile type=\"{kind}\" version=\"1.0\" \
         byte_order=\"LittleEndian\" header_type=\"UInt64\">\n"
    )
}

fn line(text: &mut String, line: std::fmt::Arguments<'_>) {
    writeln!(text, "{line}").expect("writing to a String does not fail");
}

fn floats(text: &mut String, name: &str, extent: &str, values: &[f32]) {
    array(text, name, "Float32", extent, values.iter().map(|x| x.to_le_bytes()));
}

/// Appends an array: its length in bytes and its bytes, in base64.
fn array<const SIZE: usize>(
    text: &mut String,
    name: &str,
    number: &str,
    extent: &str,
    values: impl IntoIterator<Item = [u8; SIZE]>,
) {
    let mut bytes = vec![0; size_of::<u64>()];
    for value in values {
        bytes.extend_from_slice(&value);
    }
    let length = (bytes.len() - size_of::<u64>()) as u64;
    bytes[..size_of::<u64>()].copy_from_slice(&length.to_le_bytes());
    let encoded = STANDARD.encode(&bytes);
    line(
        text,
        format_args!(
            "      <DataArray type=\"{number}\" Name=\"{name}\" {extent} format=\"binary\">\
             {encoded}</DataArray>"
        ),
    );
}
