//! Messages as the bytes they are: RustDDS asks for an encoder and a decoder, and gets none.

use std::convert::Infallible;

use ros2_client::dds::rustdds::{
    RepresentationIdentifier,
    bytes::Bytes,
    no_key::{Decode, DefaultDecoder, DeserializerAdapter, SerializerAdapter},
};

use eddy_messages::cdr::HEADER;

/// A message's CDR, without the header, which RustDDS writes itself.
pub(super) struct Body(Bytes);

impl Body {
    /// The body of a message with its header. `None` unless it is plain little-endian CDR, the
    /// only form that a writer of RustDDS announces.
    pub(super) fn of(message: Vec<u8>) -> Option<Self> {
        let message = Bytes::from(message);
        (message.len() >= HEADER.len() && message[..2] == HEADER[..2])
            .then(|| Self(message.slice(HEADER.len()..)))
    }
}

/// Writes a [`Body`] as it is, reads a message with its header as it came.
pub(super) struct AsItIs;

impl SerializerAdapter<Body> for AsItIs {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(body: &Body) -> Result<Bytes, Infallible> {
        Ok(body.0.clone())
    }
}

/// Every form of payload: which of them can be used is for the receiver to judge, and to count.
const FORMS: [(RepresentationIdentifier, [u8; 2]); 10] = [
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

static IDENTIFIERS: [RepresentationIdentifier; FORMS.len()] = {
    let mut identifiers = [RepresentationIdentifier::CDR_LE; FORMS.len()];
    let mut form = 0;
    while form < FORMS.len() {
        identifiers[form] = FORMS[form].0;
        form += 1;
    }
    identifiers
};

impl DeserializerAdapter<Vec<u8>> for AsItIs {
    type Error = Infallible;
    type Decoded = Vec<u8>;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &IDENTIFIERS
    }

    fn transform_decoded(message: Vec<u8>) -> Vec<u8> {
        message
    }
}

impl DefaultDecoder<Vec<u8>> for AsItIs {
    type Decoder = Whole;
    const DECODER: Whole = Whole;
}

/// Gives a message back with its header.
#[derive(Clone)]
pub(super) struct Whole;

impl Decode<'_, Vec<u8>> for Whole {
    type Error = Infallible;

    fn decode_bytes(
        self,
        body: &[u8],
        form: RepresentationIdentifier,
    ) -> Result<Vec<u8>, Infallible> {
        let known = FORMS.iter().find(|(identifier, _)| *identifier == form);
        // The identifier is one of those above, or RustDDS had refused the message.
        let [high, low] = known.map_or([0xff, 0xff], |(_, bytes)| *bytes);
        Ok([[high, low, 0, 0].as_slice(), body].concat())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_comes_out_as_it_went_in() {
        let message = [&HEADER[..], &[1, 2, 3]].concat();
        let body = AsItIs::to_bytes(&Body::of(message.clone()).unwrap()).unwrap();
        let read: Vec<u8> = AsItIs::from_bytes(&body, AsItIs::output_encoding()).unwrap();
        assert_eq!(read, message);
    }

    #[test]
    fn only_plain_little_endian_cdr_is_sent() {
        for message in [vec![], vec![0, 1, 0], vec![0, 0, 0, 0, 7], vec![0, 3, 0, 0]] {
            assert!(Body::of(message.clone()).is_none(), "{message:02x?}");
        }
    }
}
