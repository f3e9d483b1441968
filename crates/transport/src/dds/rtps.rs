//! RTPS messages of one `DATA` submessage, for what RustDDS does not send in a form that others understand.

/// Protocol version and vendor of RustDDS.
const VERSION: [u8; 2] = [2, 4];
const VENDOR: [u8; 2] = [0x01, 0x12];
/// Submessage `DATA` (RTPS 2.5, 9.4.5.3) and its flags: little-endian, with inline QoS, with a payload.
const DATA: u8 = 0x15;
const LITTLE_ENDIAN: u8 = 0b001;
const INLINE_QOS: u8 = 0b010;
const PAYLOAD: u8 = 0b100;
/// Bytes from after this field to the inline QoS: reader, writer, sequence number.
const TO_INLINE_QOS: u16 = 16;
/// End of the inline QoS (9.6.4).
const PID_SENTINEL: u16 = 0x0001;

/// Entities of a message: the participant that sends it, and the reader and writer that it concerns.
pub(super) struct Endpoints {
    pub(super) prefix: [u8; 12],
    pub(super) reader: [u8; 4],
    pub(super) writer: [u8; 4],
}

/// A parameter of the inline QoS; the length of its value is a multiple of four.
pub(super) fn parameter(id: u16, value: &[u8]) -> Vec<u8> {
    let length = value.len() as u16;
    [&id.to_le_bytes()[..], &length.to_le_bytes(), value].concat()
}

/// A sequence number: its high half first.
pub(super) fn sequence_number(number: i64) -> [u8; 8] {
    let mut bytes = [0; 8];
    bytes[..4].copy_from_slice(&((number >> 32) as i32).to_le_bytes());
    bytes[4..].copy_from_slice(&(number as u32).to_le_bytes());
    bytes
}

/// `payload`: CDR with its header; empty if there is none. `None` if the submessage is longer than its length field can tell.
pub(super) fn message(
    endpoints: &Endpoints,
    sequence: i64,
    inline_qos: &[Vec<u8>],
    payload: &[u8],
) -> Option<Vec<u8>> {
    let extra_flags = [0, 0];
    let data = [
        &extra_flags[..],
        &TO_INLINE_QOS.to_le_bytes(),
        &endpoints.reader,
        &endpoints.writer,
        &sequence_number(sequence),
        &inline_qos.concat(),
        &parameter(PID_SENTINEL, &[]),
        payload,
    ]
    .concat();
    let length = u16::try_from(data.len()).ok()?.to_le_bytes();
    let flags = LITTLE_ENDIAN | INLINE_QOS | if payload.is_empty() { 0 } else { PAYLOAD };
    let header = [b"RTPS", &VERSION[..], &VENDOR, &endpoints.prefix, &[DATA, flags], &length];
    Some([&header.concat()[..], &data].concat())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sequence_number_has_its_high_half_first() {
        assert_eq!(sequence_number(0x1_0203_0405), [1, 0, 0, 0, 5, 4, 3, 2]);
    }

    #[test]
    fn a_message_of_more_than_64_kib_is_not_made() {
        let endpoints = Endpoints { prefix: [0; 12], reader: [0; 4], writer: [0; 4] };
        assert!(message(&endpoints, 1, &[], &[0; 65_000]).is_some());
        assert!(message(&endpoints, 1, &[], &[0; 65_536]).is_none());
    }
}
