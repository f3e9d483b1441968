//! A frame as `sensor_msgs/msg/PointCloud2`, for RViz, Foxglove and Rerun, and properties of its particles as another.
//!
//! A point of a frame of two dimensions has 24 bytes: `x y z vx vy` as `float32`, `material` as `uint8` in byte 20, three bytes of padding.
//! `z` is 0. One of three has 28: `vz` follows `vy`.

use super::{Header, PointCloud2, PointField, cdr};
use eddy_frames::{Frame, spatial};

/// Coordinates of a point.
const COORDINATES: [&str; 3] = ["x", "y", "z"];
/// Components of its velocity, as many as the frame has dimensions.
const VELOCITIES: [&str; 3] = ["vx", "vy", "vz"];

/// Length of a point of a frame of so many dimensions (bytes): the material is padded.
pub const fn point_step(dimension: usize) -> usize {
    size_of::<f32>() * (COORDINATES.len() + dimension + 1)
}

/// `datatype` of a [`PointField`].
const UINT8: u8 = 2;
const FLOAT32: u8 = 7;

/// Bytes of the message from the length of the point data on, without points: the length and `is_dense`.
const TAIL: usize = size_of::<u32>() + size_of::<bool>();

/// Encodes a frame as the CDR bytes of a point cloud. The points are written into the message without an encoder.
pub fn to_cdr<const D: usize>(frame: &Frame<D>) -> Vec<u8> {
    let without_points = cdr::encode(&PointCloud2 { is_dense: true, ..description(frame) });
    let (head, tail) = without_points.split_at(without_points.len() - TAIL);
    let length = frame.len() * point_step(D);
    let mut bytes = Vec::with_capacity(without_points.len() + length);
    bytes.extend_from_slice(head);
    bytes.extend_from_slice(&(length as u32).to_le_bytes());
    for ((position, velocity), material) in
        frame.position.iter().zip(&frame.velocity).zip(&frame.material)
    {
        let mut point = [0; point_step(3)];
        let mut numbers = [0.0; 6];
        numbers[..3].copy_from_slice(&spatial(*position));
        numbers[3..3 + D].copy_from_slice(velocity);
        for (place, number) in point.chunks_exact_mut(size_of::<f32>()).zip(numbers) {
            place.copy_from_slice(&number.to_le_bytes());
        }
        point[point_step(D) - size_of::<f32>()] = *material as u8;
        bytes.extend_from_slice(&point[..point_step(D)]);
    }
    bytes.push(tail[TAIL - 1]);
    bytes
}

/// Encodes properties of the particles of a frame, by name, as the CDR bytes of a point cloud: `x y z` and the properties
/// as `float32`. Each has a number per particle.
pub fn properties_to_cdr<const D: usize>(
    frame: &Frame<D>,
    properties: &[(&str, &[f32])],
) -> Vec<u8> {
    let names = COORDINATES.into_iter().chain(properties.iter().map(|(name, _)| *name));
    let fields = names.zip((0..).step_by(size_of::<f32>()));
    let fields: Vec<PointField> =
        fields.map(|(name, offset)| field(name, offset, FLOAT32)).collect();
    let step = fields.len() * size_of::<f32>();
    let mut data = Vec::with_capacity(frame.len() * step);
    for (particle, position) in frame.position.iter().enumerate() {
        let values = properties.iter().map(|(_, values)| values[particle]);
        let numbers = spatial(*position).into_iter().chain(values);
        data.extend(numbers.flat_map(f32::to_le_bytes));
    }
    cdr::encode(&PointCloud2 {
        fields,
        point_step: step as u32,
        row_step: (frame.len() * step) as u32,
        data,
        is_dense: true,
        ..description(frame)
    })
}

/// The numbers of a `float32` field of a point cloud, one per point; `None` if there is no such field, or the data is
/// shorter than described.
pub fn property(cloud: &PointCloud2, name: &str) -> Option<Vec<f32>> {
    let field =
        cloud.fields.iter().find(|field| field.name == name && field.datatype == FLOAT32)?;
    let (step, offset) = (cloud.point_step as usize, field.offset as usize);
    let points = (cloud.width as usize).checked_mul(cloud.height as usize)?;
    let fits = offset.checked_add(size_of::<f32>()).is_some_and(|end| end <= step);
    if cloud.is_bigendian || !fits || points.checked_mul(step)? > cloud.data.len() {
        return None;
    }
    let number = |point: &[u8]| {
        let bytes = point[offset..].first_chunk().copied().unwrap_or_default();
        f32::from_le_bytes(bytes)
    };
    Some(cloud.data.chunks_exact(step).take(points).map(number).collect())
}

fn field(name: &str, offset: u32, datatype: u8) -> PointField {
    PointField { name: name.to_owned(), offset, datatype, count: 1 }
}

/// The point cloud without its points.
fn description<const D: usize>(frame: &Frame<D>) -> PointCloud2 {
    let numbers = COORDINATES.iter().chain(&VELOCITIES[..D]).map(|name| (*name, FLOAT32));
    let names = numbers.chain([("material", UINT8)]).zip((0..).step_by(size_of::<f32>()));
    let fields: Vec<_> =
        names.map(|((name, datatype), offset)| field(name, offset, datatype)).collect();
    PointCloud2 {
        header: Header::world(frame.stamp),
        height: 1,
        width: frame.len() as u32,
        fields,
        point_step: point_step(D) as u32,
        row_step: (frame.len() * point_step(D)) as u32,
        ..PointCloud2::default()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use eddy_frames::{Domain, Material, Stamp};

    /// Reads a field of a point according to its description.
    fn read(cloud: &PointCloud2, point: usize, name: &str) -> f32 {
        let field = cloud.fields.iter().find(|field| field.name == name).unwrap();
        let at = point * cloud.point_step as usize + field.offset as usize;
        match field.datatype {
            FLOAT32 => f32::from_le_bytes(cloud.data[at..at + 4].try_into().unwrap()),
            UINT8 => cloud.data[at].into(),
            other => panic!("{name}: found datatype {other}"),
        }
    }

    #[test]
    fn a_cloud_of_three_dimensions_has_a_real_z() {
        let frame = Frame {
            stream: 1,
            sequence: 0,
            stamp: Stamp(0),
            dt: 0.016,
            domain: Domain { lower: [0.0; 3], upper: [1.0; 3] },
            position: vec![[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]],
            velocity: vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
            material: vec![Material::Snow, Material::Rope],
        };
        let cloud: PointCloud2 = cdr::decode(&to_cdr(&frame)).unwrap();
        assert_eq!((cloud.point_step, cloud.data.len()), (28, 56));
        for point in 0..2 {
            let found = ["x", "y", "z", "vx", "vy", "vz"].map(|name| read(&cloud, point, name));
            assert_eq!(found[..3], frame.position[point]);
            assert_eq!(found[3..], frame.velocity[point]);
            assert_eq!(read(&cloud, point, "material"), frame.material[point] as u8 as f32);
        }
        let other: PointCloud2 = cdr::decode(&properties_to_cdr(&frame, &[])).unwrap();
        assert_eq!(property(&other, "z"), Some(vec![0.3, 0.6]));
    }

    proptest! {
        #[test]
        fn a_cloud_has_the_particles_of_the_frame(
            sequence in 0u32..1_000,
            particles in prop::collection::vec((prop::array::uniform4(-1e6f32..1e6), 0usize..4), 1..50),
        ) {
            let frame = Frame {
                stream: 1,
                sequence: sequence.into(),
                stamp: Stamp(0).advance(0.016, sequence),
                dt: 0.016,
                domain: Domain::UNIT,
                position: particles.iter().map(|([x, y, ..], _)| [*x, *y]).collect(),
                velocity: particles.iter().map(|([.., u, v], _)| [*u, *v]).collect(),
                material: particles.iter().map(|(_, m)| Material::ALL[*m]).collect(),
            };
            let cloud: PointCloud2 = cdr::decode(&to_cdr(&frame)).unwrap();
            prop_assert_eq!(&cloud.header, &Header::world(frame.stamp));
            prop_assert_eq!((cloud.height, cloud.width as usize), (1, frame.len()));
            prop_assert_eq!((cloud.point_step, cloud.row_step), (24, 24 * cloud.width));
            prop_assert_eq!(cloud.data.len(), 24 * frame.len());
            prop_assert!(cloud.is_dense && !cloud.is_bigendian);
            let values: Vec<f32> = (0..frame.len()).map(|k| k as f32 - 0.5).collect();
            let other = properties_to_cdr(&frame, &[("a", &values), ("b", &values)]);
            let mut other: PointCloud2 = cdr::decode(&other).unwrap();
            prop_assert_eq!((other.point_step, &other.header), (20, &cloud.header));
            prop_assert_eq!(property(&other, "b"), Some(values));
            let x = frame.position.iter().map(|x| x[0]).collect::<Vec<_>>();
            prop_assert_eq!(property(&other, "x"), Some(x));
            prop_assert_eq!(property(&other, "c"), None);
            prop_assert_eq!(property(&cloud, "material"), None);
            other.data.pop();
            prop_assert_eq!(property(&other, "b"), None);
            for point in 0..frame.len() {
                let found = ["x", "y", "z", "vx", "vy"].map(|name| read(&cloud, point, name));
                let ([x, y], [vx, vy]) = (frame.position[point], frame.velocity[point]);
                prop_assert_eq!(found, [x, y, 0.0, vx, vy]);
                prop_assert_eq!(read(&cloud, point, "material"), frame.material[point] as u8 as f32);
            }
        }
    }
}
