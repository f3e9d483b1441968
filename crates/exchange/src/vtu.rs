//! VTK unstructured grids, one `.vtu` per frame, and a `.pvd` collection per stream to open in ParaView. Every
//! particle is a vertex with the properties of `point_data`. Tools are polygons in a `.vtp` beside each frame, the second
//! part of the collection.
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
use eddy_bag::{BagReader, RecordedTools};
use eddy_frames::{Domain, Frame, spatial, tool::ToolFrame};

/// Cell type of a vertex (`vtkCellType.h`).
pub(super) const VERTEX: u8 = 1;

/// Writes `stream_0007.pvd`, `stream_0007/000000.vtu` and so on into the directory, and `stream_0007/000000.vtp` for
/// frames with tools.
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
        let tools = BagReader::open(&track.bag)?.tools(streams.topic())?.remove(&track.stream);
        let plane = Domain {
            lower: [track.domain.lower[0], track.domain.lower[1]],
            upper: [track.domain.upper[0], track.domain.upper[1]],
        };
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
            fs::write(&path, grid(frame, arrays)).map_err(ExchangeError::io(&path, "writing"))?;
            if let Some(tools) = &tools
                && let Some(at) = tools.frames.get(&frame.sequence)
            {
                let path = path.with_extension("vtp");
                line(
                    &mut collection,
                    format_args!(
                        "    <DataSet timestep=\"{time}\" part=\"1\" file=\"{name}/{number:06}.vtp\"/>"
                    ),
                );
                let polygons = polygons(tools, at, plane);
                fs::write(&path, polygons).map_err(ExchangeError::io(&path, "writing"))?;
            }
            number += 1;
            Ok(())
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

/// The tools at one frame as the text of a `.vtp` file: a polygon for each convex part, with what its tool does.
fn polygons(RecordedTools { tools, .. }: &RecordedTools, at: &ToolFrame, domain: Domain) -> String {
    let (mut points, mut ends) = (Vec::new(), Vec::new());
    let (mut index, mut velocity, mut spin) = (Vec::new(), Vec::new(), Vec::new());
    let (mut force, mut torque) = (Vec::new(), Vec::new());
    for (number, (tool, state)) in tools.tools.iter().zip(&at.states).enumerate() {
        for part in tool.shape.posed(state.pose) {
            points.extend(part.polygon(domain).into_iter().map(spatial));
            ends.push((points.len() as i64).to_le_bytes());
            index.push([number as u8]);
            velocity.push(spatial(state.velocity));
            spin.push(state.spin);
            let wrench = at.wrenches.get(number);
            let [x, y] = wrench.map_or([f32::NAN; 2], |known| known.force.map(|x| x as f32));
            force.push([x, y, 0.0]);
            torque.push(wrench.map_or(f32::NAN, |known| known.torque as f32));
        }
    }
    let (corners, parts) = (points.len(), ends.len());
    let mut text = header("PolyData");
    line(
        &mut text,
        format_args!(
            "  <PolyData>\n    <Piece NumberOfPoints=\"{corners}\" NumberOfVerts=\"0\" \
             NumberOfLines=\"0\" NumberOfStrips=\"0\" NumberOfPolys=\"{parts}\">\n    <Points>"
        ),
    );
    floats(&mut text, "Points", VECTOR, points.as_flattened());
    text.push_str("    </Points>\n    <CellData Scalars=\"tool\" Vectors=\"force\">\n");
    array(&mut text, "tool", "UInt8", "", index);
    floats(&mut text, "velocity", VECTOR, velocity.as_flattened());
    floats(&mut text, "spin", "", &spin);
    floats(&mut text, "force", VECTOR, force.as_flattened());
    floats(&mut text, "torque", "", &torque);
    text.push_str("    </CellData>\n    <Polys>\n");
    array(&mut text, "connectivity", "Int64", "", (0..corners as i64).map(i64::to_le_bytes));
    array(&mut text, "offsets", "Int64", "", ends);
    text.push_str("    </Polys>\n    </Piece>\n  </PolyData>\n</VTKFile>\n");
    text
}

/// Attribute of arrays with three numbers per particle or polygon.
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

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_frames::{
        Stamp,
        tool::{Contact, Outline, Pose, Tool, ToolState, Tools, Wrench},
    };

    /// The bytes of an array.
    fn bytes(text: &str, name: &str) -> Vec<u8> {
        let (_, after) = text.split_once(&format!("Name=\"{name}\"")).unwrap();
        let (_, encoded) = after.split_once("format=\"binary\">").unwrap();
        STANDARD.decode(encoded.split('<').next().unwrap()).unwrap()[8..].to_vec()
    }

    fn numbers(text: &str, name: &str) -> Vec<f32> {
        let bytes = bytes(text, name);
        bytes.chunks(4).map(|x| f32::from_le_bytes(x.try_into().unwrap())).collect()
    }

    #[test]
    fn tools_are_polygons_where_they_are_with_the_force_on_them() {
        let shape = Outline::Rectangle { size: [0.5, 0.25] };
        let tool = Tool { name: "blade".into(), shape, contact: Contact::Slip };
        let tools = Tools { stream: 3, tools: vec![tool] };
        let recorded = RecordedTools { tools, frames: Default::default() };
        let pose = Pose { position: [0.5, 0.5], angle: 0.0 };
        let states = vec![ToolState { pose, velocity: [1.0, -2.0], spin: 0.5 }];
        let wrenches = vec![Wrench { force: [3.0, 4.0], torque: -0.25 }];
        let mut at = ToolFrame { stream: 3, sequence: 0, stamp: Stamp(0), states, wrenches };
        let domain = Domain { lower: [0.0; 2], upper: [1.0; 2] };
        let text = polygons(&recorded, &at, domain);
        assert!(text.contains("NumberOfPoints=\"4\"") && text.contains("NumberOfPolys=\"1\""));
        let points = numbers(&text, "Points");
        let mut corners: Vec<_> = points.chunks(3).map(|x| [x[0], x[1], x[2]]).collect();
        corners.sort_by(|a, b| a.partial_cmp(b).unwrap());
        let expected = [[0.25, 0.375], [0.25, 0.625], [0.75, 0.375], [0.75, 0.625]];
        assert_eq!(corners, expected.map(spatial));
        assert_eq!(bytes(&text, "tool"), [0]);
        assert_eq!(bytes(&text, "offsets"), 4_i64.to_le_bytes());
        assert_eq!(numbers(&text, "velocity"), [1.0, -2.0, 0.0]);
        assert_eq!(numbers(&text, "spin"), [0.5]);
        assert_eq!(numbers(&text, "force"), [3.0, 4.0, 0.0]);
        assert_eq!(numbers(&text, "torque"), [-0.25]);
        at.wrenches.clear();
        assert!(numbers(&polygons(&recorded, &at, domain), "torque")[0].is_nan(), "unknown");
    }
}
