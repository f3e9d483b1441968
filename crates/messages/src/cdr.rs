//! Encodes and decodes CDR with the 4-byte encapsulation header of ROS 2
//! (OMG DDSI-RTPS 2.5, 10.2: `00 01` is plain CDR, little-endian; two option bytes follow).

use cdr_encoding::{from_bytes, to_vec_with_size_hint, to_writer};
use serde::{Serialize, de::DeserializeOwned};

/// Little-endian plain CDR.
pub const HEADER: [u8; 4] = [0, 1, 0, 0];

/// Padding that CDR may append to reach a multiple of 4 bytes.
pub(crate) const MAX_PADDING: usize = 3;

/// Why encoding cannot fail.
const REPRESENTABLE: &str =
    "messages consist of numbers, strings and sequences, which CDR can represent";

/// Bytes that are not a message of the expected type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the message of each variant says what its fields are")]
pub enum CdrError {
    /// The encapsulation header is not that of plain CDR; `found` holds the first bytes, at most four.
    #[error(
        "CDR header: found {found:02x?}, expected [00, 01, 00, 00] (plain CDR, little-endian) or [00, 00, 00, 00] (big-endian)"
    )]
    Header { found: Vec<u8> },
    /// The body of `length` bytes does not hold the fields of the message.
    #[error("CDR body of {length} bytes is not a {type_name}: {reason}")]
    Body { type_name: &'static str, length: usize, reason: String },
    /// Bytes follow the message.
    #[error("CDR body: found {found} bytes, expected {expected} for this {type_name}")]
    Trailing { type_name: &'static str, found: usize, expected: usize },
}

/// Encodes a message as little-endian CDR with its header.
///
/// # Panics
/// Never for the messages of this crate, which CDR can represent.
pub fn encode<M: Serialize>(message: &M) -> Vec<u8> {
    let body =
        to_vec_with_size_hint::<M, byteorder::LittleEndian>(message, 256).expect(REPRESENTABLE);
    [HEADER.as_slice(), &body].concat()
}

/// Decodes a message of either byte order.
///
/// Memory is bounded by the length of `bytes`, not by the lengths declared in them.
///
/// # Errors
/// [`CdrError`] when the header is unknown, the body is truncated, or bytes follow the message.
pub fn decode<M: DeserializeOwned>(bytes: &[u8]) -> Result<M, CdrError> {
    let header = || CdrError::Header { found: bytes[..bytes.len().min(4)].to_vec() };
    let (head, body) = bytes.split_at_checked(HEADER.len()).ok_or_else(header)?;
    let decoded = match head {
        [0, 1, ..] => from_bytes::<M, byteorder::LittleEndian>(body),
        [0, 0, ..] => from_bytes::<M, byteorder::BigEndian>(body),
        _ => return Err(header()),
    };
    let type_name = short_name::<M>();
    let (message, used) = decoded.map_err(|error| CdrError::Body {
        type_name,
        length: body.len(),
        reason: error.to_string(),
    })?;
    if body.len() > used + MAX_PADDING {
        return Err(CdrError::Trailing { type_name, found: body.len(), expected: used });
    }
    Ok(message)
}

/// The stream id of an undecoded `ParticleFrame`.
pub fn stream_of_frame(bytes: &[u8]) -> Option<u64> {
    place_of_frame(bytes).map(|(stream, _)| stream)
}

/// Stream id and sequence number of an undecoded `ParticleFrame`: the fields after the header, which ends with a string.
pub fn place_of_frame(bytes: &[u8]) -> Option<(u64, u64)> {
    /// Position of the string, after seconds and nanoseconds (bytes).
    const STRING: usize = 8;
    let (head, body) = bytes.split_at_checked(HEADER.len())?;
    let little = head[1] == 1;
    let length = *body.get(STRING..)?.first_chunk::<4>()?;
    let length = if little { u32::from_le_bytes(length) } else { u32::from_be_bytes(length) };
    let begin = (STRING + 4).checked_add(length as usize)?.checked_next_multiple_of(8)?;
    let (numbers, _) = body.get(begin..)?.as_chunks::<8>();
    let number = |bytes: &[u8; 8]| {
        if little { u64::from_le_bytes(*bytes) } else { u64::from_be_bytes(*bytes) }
    };
    Some((number(numbers.first()?), number(numbers.get(1)?)))
}

/// As [`encode`], into `bytes`, whose memory is reused.
pub fn encode_into<M: Serialize>(message: &M, bytes: &mut Vec<u8>) {
    bytes.clear();
    bytes.extend(HEADER);
    to_writer::<M, byteorder::LittleEndian, _>(&mut *bytes, message).expect(REPRESENTABLE);
}

fn short_name<M>() -> &'static str {
    let path = std::any::type_name::<M>();
    path.rsplit("::").next().unwrap_or(path)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{
        Header, ParticleFrame, Point, Pose, PoseStamped, Quaternion, RosString, TFMessage, Time,
        Transform, TransformStamped, Vector3,
    };

    /// Written with rosbags 0.11.9: `typestore.serialize_cdr(String("eddy"), "std_msgs/msg/String")`.
    const STRING_EDDY: [u8; 13] = [0, 1, 0, 0, 5, 0, 0, 0, b'e', b'd', b'd', b'y', 0];

    #[test]
    fn a_string_has_the_bytes_that_rosbags_writes() {
        assert_eq!(encode(&RosString { data: "eddy".into() }), STRING_EDDY);
    }

    #[test]
    fn poses_and_transforms_have_the_bytes_that_rosbags_writes() {
        let header = Header { stamp: Time { sec: 1, nanosec: 2 }, frame_id: "world".into() };
        let orientation = Quaternion { x: 0.0, y: 0.0, z: 0.6, w: 0.8 };
        let pose = Pose { position: Point { x: 0.5, y: 0.25, z: 0.0 }, orientation };
        let translation = Vector3 { x: 0.5, y: 0.25, z: 0.0 };
        let transform = TransformStamped {
            header: header.clone(),
            child_frame_id: "cup".into(),
            transform: Transform { translation, rotation: orientation },
        };
        let numbers = [0.5f64, 0.25, 0.0, 0.0, 0.0, 0.6, 0.8].map(f64::to_le_bytes).concat();
        // `typestore.serialize_cdr` of rosbags 0.11.9; both end with the same seven numbers.
        let head = b"\0\x01\0\0\x01\0\0\0\x02\0\0\0\x06\0\0\0world\0\0\0\0\0\0\0";
        let stamped = PoseStamped { header, pose };
        assert_eq!(encode(&stamped), [&head[..], &numbers].concat());
        let head = b"\0\x01\0\0\x01\0\0\0\x01\0\0\0\x02\0\0\0\x06\0\0\0world\0\0\0\x04\0\0\0cup\0";
        let message = TFMessage { transforms: vec![transform] };
        let bytes = [&head[..], &numbers].concat();
        assert_eq!(encode(&message), bytes);
        assert_eq!(decode::<TFMessage>(&bytes), Ok(message));
    }

    #[test]
    fn both_byte_orders_are_read() {
        let big = [0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 2];
        assert_eq!(decode::<Time>(&big), Ok(Time { sec: 1, nanosec: 2 }));
    }

    #[test]
    fn a_declared_length_of_four_billion_particles_is_rejected_without_allocating() {
        let mut bytes = encode(&ParticleFrame::default());
        let material = bytes.len() - 4;
        bytes[material..].fill(0xff);
        let error = decode::<ParticleFrame>(&bytes).unwrap_err();
        assert!(error.to_string().contains("is not a ParticleFrame"), "{error}");
    }

    #[test]
    fn bytes_after_a_message_are_rejected() {
        let mut bytes = encode(&RosString { data: "eddy".into() });
        bytes.extend([0; 8]);
        assert!(matches!(decode::<RosString>(&bytes), Err(CdrError::Trailing { .. })));
    }

    proptest! {
        #[test]
        fn frames_come_back_as_they_went(
            stream: u64, sequence: u64, sec: i32, nanosec in 0u32..1_000_000_000,
            frame_id in "[a-z/_]{0,12}", dt: f32,
            position in prop::collection::vec(any::<f32>(), 0..40),
            material in prop::collection::vec(any::<u8>(), 0..20),
        ) {
            let message = ParticleFrame {
                header: Header { stamp: Time { sec, nanosec }, frame_id },
                stream, sequence, dt,
                lower: vec![0.0, 0.0], upper: vec![1.0, 1.0],
                velocity: position.iter().map(|x| -x).collect(),
                position, material,
            };
            // NaN differs from itself: compare bytes.
            let bytes = encode(&message);
            prop_assert_eq!(place_of_frame(&bytes), Some((stream, message.sequence)));
            let mut again = vec![7; 3];
            encode_into(&message, &mut again);
            prop_assert_eq!(&again, &bytes);
            prop_assert_eq!(encode(&decode::<ParticleFrame>(&bytes).unwrap()), bytes);
        }

        #[test]
        fn the_decoder_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let _ = decode::<ParticleFrame>(&bytes);
            let _ = stream_of_frame(&bytes);
        }

        #[test]
        fn every_truncation_is_rejected(cut in 0usize..100) {
            let message = ParticleFrame {
                position: vec![0.5; 8], velocity: vec![0.0; 8], material: vec![0; 4],
                ..ParticleFrame::default()
            };
            let bytes = encode(&message);
            prop_assume!(cut < bytes.len());
            prop_assert!(decode::<ParticleFrame>(&bytes[..cut]).is_err());
        }
    }
}
