//! Serializer and deserializer for RustDDS that pass CDR bytes unchanged.

use std::convert::Infallible;

use ros2_client::dds::rustdds::{
    RepresentationIdentifier,
    bytes::Bytes,
    no_key::{Decode, DefaultDecoder, DeserializerAdapter, SerializerAdapter},
};

use eddy_messages::cdr::HEADER;

/// The CDR of a message without its header, which RustDDS writes.
pub(super) struct Body(Bytes);

impl Body {
    /// The body of a message with its header; `None` unless it is plain little-endian CDR, the only representation that a
    /// writer of RustDDS announces. A message without bytes, not even a header, has an empty body.
    pub(super) fn of(message: Vec<u8>) -> Option<Self> {
        let message = Bytes::from(message);
        if message.is_empty() {
            return Some(Self(message));
        }
        (message.len() >= HEADER.len() && message[..2] == HEADER[..2])
            .then(|| Self(message.slice(HEADER.len()..)))
    }
}

/// Writes a [`Body`] and reads a message with its header, unchanged.
pub(super) struct PassThrough;

impl SerializerAdapter<Body> for PassThrough {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(body: &Body) -> Result<Bytes, Infallible> {
        Ok(body.0.clone())
    }
}

/// All representations; the subscriber rejects and counts those that it cannot decode.
const REPRESENTATIONS: [(RepresentationIdentifier, [u8; 2]); 10] = [
    (RepresentationIdentifier::CDR_BE, [0, 0x00]),
    (RepresentationIdentifier::CDR_LE, [0, 0x01]),
    (RepresentationIdentifier::PL_CDR_BE, [0, 0x02]),
    (RepresentationIdentifier::PL_CDR_LE, [0, 0x03]),
    (RepresentationIdentifier::CDR2_BE, [0, 0x10]),
    (RepresentationIdentifier::CDR2_LE, [0, 0x11]),
    (RepresentationIdentifier::PL_CDR2_BE, [0, 0x12]),
    (RepresentationIdentifier::PL_CDR2_LE, [0, 0x13]),
    (RepresentationIdentifier::D_CDR_BE, [0, 0x14]),
    (RepresentationIdentifier::D_CDR_LE, [0, 0x15]),
];

static IDENTIFIERS: [RepresentationIdentifier; REPRESENTATIONS.len()] = {
    let mut identifiers = [RepresentationIdentifier::CDR_LE; REPRESENTATIONS.len()];
    let mut index = 0;
    while index < REPRESENTATIONS.len() {
        identifiers[index] = REPRESENTATIONS[index].0;
        index += 1;
    }
    identifiers
};

impl DeserializerAdapter<Vec<u8>> for PassThrough {
    type Error = Infallible;
    type Decoded = Vec<u8>;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &IDENTIFIERS
    }

    fn transform_decoded(message: Vec<u8>) -> Vec<u8> {
        message
    }
}

impl DefaultDecoder<Vec<u8>> for PassThrough {
    type Decoder = WithHeader;
    const DECODER: WithHeader = WithHeader;
}

/// Decodes to the message with its header.
#[derive(Clone)]
pub(super) struct WithHeader;

impl Decode<'_, Vec<u8>> for WithHeader {
    type Error = Infallible;

    fn decode_bytes(
        self,
        body: &[u8],
        representation: RepresentationIdentifier,
    ) -> Result<Vec<u8>, Infallible> {
        let known = REPRESENTATIONS.iter().find(|(identifier, _)| *identifier == representation);
        // RustDDS rejects all other identifiers.
        let [high, low] = known.map_or([0xff, 0xff], |(_, bytes)| *bytes);
        Ok([[high, low, 0, 0].as_slice(), body].concat())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_is_unchanged() {
        let message = [&HEADER[..], &[1, 2, 3]].concat();
        let body = PassThrough::to_bytes(&Body::of(message.clone()).unwrap()).unwrap();
        let read: Vec<u8> = PassThrough::from_bytes(&body, PassThrough::output_encoding()).unwrap();
        assert_eq!(read, message);
    }

    #[test]
    fn only_plain_little_endian_cdr_is_sent() {
        assert!(PassThrough::to_bytes(&Body::of(Vec::new()).unwrap()).unwrap().is_empty());
        for message in [vec![0, 1, 0], vec![0, 0, 0, 0, 7], vec![0, 3, 0, 0]] {
            assert!(Body::of(message.clone()).is_none(), "{message:02x?}");
        }
    }
}
