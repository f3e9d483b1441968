//! The attachment of rmw_zenoh, exactly 33 bytes with every message
//! (`rmw_zenoh_cpp/src/detail/attachment_helpers.cpp`): sequence number, source time, length of the GID, GID.
//!
//! A C++ peer aborts on an attachment that it cannot parse. Messages with any other attachment, or none, are received.

/// Size of a GID (bytes).
const GID_LENGTH: usize = 16;
/// Size of an attachment (bytes).
pub(super) const LENGTH: usize = 8 + 8 + 1 + GID_LENGTH;

/// Origin of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Attachment {
    /// Sequence number; a publisher starts at 1.
    pub(super) sequence: i64,
    /// Time of publication (ns since the epoch).
    pub(super) source_time: i64,
    /// GID of the publisher.
    pub(super) gid: [u8; GID_LENGTH],
}

impl Attachment {
    pub(crate) fn to_bytes(self) -> [u8; LENGTH] {
        let mut bytes = [0; LENGTH];
        bytes[..8].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.source_time.to_le_bytes());
        bytes[16] = GID_LENGTH as u8;
        bytes[17..].copy_from_slice(&self.gid);
        bytes
    }

    /// Parses an attachment; `None` if it has another form.
    pub(crate) fn parse(bytes: &[u8]) -> Option<Self> {
        let bytes: &[u8; LENGTH] = bytes.try_into().ok()?;
        let (sequence, rest) = bytes.split_first_chunk()?;
        let (source_time, rest) = rest.split_first_chunk()?;
        let (length, gid) = rest.split_first()?;
        (usize::from(*length) == GID_LENGTH).then_some(Self {
            sequence: i64::from_le_bytes(*sequence),
            source_time: i64::from_le_bytes(*source_time),
            gid: gid.try_into().ok()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn an_attachment_has_the_bytes_that_rmw_zenoh_expects() {
        let attachment = Attachment { sequence: 1, source_time: 0x0102, gid: *b"0123456789abcdef" };
        let expected = b"\x01\0\0\0\0\0\0\0\x02\x01\0\0\0\0\0\0\x100123456789abcdef";
        assert_eq!(&attachment.to_bytes(), expected);
    }

    #[test]
    fn other_forms_are_rejected() {
        let mut bytes = Attachment { sequence: 1, source_time: 2, gid: [3; 16] }.to_bytes();
        assert_eq!(Attachment::parse(&bytes[..32]), None);
        assert_eq!(Attachment::parse(&[]), None);
        bytes[16] = 15;
        assert_eq!(Attachment::parse(&bytes), None);
    }

    proptest! {
        #[test]
        fn attachments_come_back_as_they_went(sequence: i64, source_time: i64, gid: [u8; 16]) {
            let attachment = Attachment { sequence, source_time, gid };
            prop_assert_eq!(Attachment::parse(&attachment.to_bytes()), Some(attachment));
        }
    }
}
