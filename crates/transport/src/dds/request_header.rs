//! Requests and responses as rmw_cyclonedds has them: their identity is not in the inline QoS, but stands before the body
//! (`rmw_cyclonedds_cpp/src/serdata.hpp`, `cdds_request_header`: a 64-bit id of the client and a 64-bit sequence number).
//!
//! Its length, 16 bytes, is a multiple of every alignment, so that the encoding of what follows does not change.

use ros2_client::dds::rustdds::GUID;

use eddy_messages::cdr::HEADER;

/// First bytes of the GUIDs of Eclipse Cyclone DDS: its vendor id (RTPS 2.5, 9.3.1.5).
const CYCLONE: [u8; 2] = [0x01, 0x10];
const LENGTH: usize = 16;

/// Whether an endpoint is one of Cyclone DDS.
pub(super) fn is_cyclone(endpoint: GUID) -> bool {
    endpoint.to_bytes().starts_with(&CYCLONE)
}

/// Identity of a request and its response.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct RequestHeader([u8; LENGTH]);

impl RequestHeader {
    /// The identity of the only request of a client.
    pub(super) fn of(client: GUID) -> Self {
        let mut bytes = [0; LENGTH];
        // The end of the GUID differs between the clients of a participant.
        bytes[..8].copy_from_slice(&client.to_bytes()[8..]);
        bytes[8] = 1;
        Self(bytes)
    }

    /// The identity and the message without it. `None` if the message is too short.
    pub(super) fn split(message: &[u8]) -> Option<(Self, Vec<u8>)> {
        let (encapsulation, body) = message.split_at_checked(HEADER.len())?;
        let (header, rest) = body.split_first_chunk()?;
        Some((Self(*header), [encapsulation, rest].concat()))
    }

    /// The message with this identity.
    pub(super) fn before(self, message: &[u8]) -> Vec<u8> {
        let (encapsulation, body) = message.split_at(HEADER.len().min(message.len()));
        [encapsulation, &self.0, body].concat()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_identity_stands_between_encapsulation_and_body() {
        let header = RequestHeader::of(GUID::new_participant_guid());
        let message = [&HEADER[..], &[7, 8]].concat();
        let whole = header.before(&message);
        assert_eq!(whole.len(), message.len() + LENGTH);
        assert_eq!(whole[HEADER.len() + 8..][..8], 1u64.to_le_bytes());
        assert_eq!(RequestHeader::split(&whole), Some((header, message)));
        assert_eq!(RequestHeader::split(&whole[..19]), None);
        assert_eq!(RequestHeader::split(&[]), None);
    }
}
