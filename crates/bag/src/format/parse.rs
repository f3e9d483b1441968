//! Parses the bodies of records with the lengths in them checked first: the parser of the mcap crate (0.26)
//! allocates whatever length a string or list declares, up to 4 GiB, and panics on attachments that are too
//! short. For the same reason its `SummaryReader` and `IndexedReader` are not used on files that may be damaged.

use mcap::{
    McapError, McapResult, parse_record,
    records::{Record, op},
};

/// A field of a record's body, as far as its length is concerned.
#[derive(Clone, Copy)]
enum Field {
    /// A number of bytes.
    Fixed(usize),
    /// A string or list after its length in four bytes.
    Text,
    /// A map of strings after its length in four bytes.
    Texts,
    /// Data after its length in eight bytes.
    Data,
}
use Field::{Data, Fixed, Text, Texts};

/// The fields of the records that are parsed here (MCAP specification, "Records").
fn fields(opcode: u8) -> &'static [Field] {
    match opcode {
        op::HEADER => &[Text, Text],
        op::SCHEMA => &[Fixed(2), Text, Text, Text],
        op::CHANNEL => &[Fixed(4), Text, Text, Texts],
        op::MESSAGE => &[Fixed(22)],
        op::MESSAGE_INDEX => &[Fixed(2), Text],
        op::CHUNK_INDEX => &[Fixed(32), Text, Fixed(8), Text, Fixed(16)],
        op::ATTACHMENT => &[Fixed(16), Text, Text, Data, Fixed(4)],
        op::ATTACHMENT_INDEX => &[Fixed(40), Text, Text],
        op::METADATA_INDEX => &[Fixed(16), Text],
        op::STATISTICS => &[Fixed(42), Text],
        op::METADATA => &[Text, Texts],
        _ => &[],
    }
}

/// Parses the body of a record.
///
/// # Errors
/// Those of mcap's parser; [`McapError::UnexpectedEof`] when a length does not fit the body.
pub(crate) fn record(opcode: u8, body: &[u8]) -> McapResult<Record<'_>> {
    fits(opcode, body).ok_or(McapError::UnexpectedEof)?;
    parse_record(opcode, body)
}

fn fits(opcode: u8, body: &[u8]) -> Option<()> {
    let mut rest = body;
    for field in fields(opcode) {
        match *field {
            Fixed(length) => rest = rest.get(length..)?,
            Text => (_, rest) = text(rest)?,
            Texts => {
                let (mut texts, after) = text(rest)?;
                while !texts.is_empty() {
                    (_, texts) = text(texts)?;
                }
                rest = after;
            }
            Data => {
                let (length, after) = rest.split_first_chunk()?;
                rest = after.get(usize::try_from(u64::from_le_bytes(*length)).ok()?..)?;
            }
        }
    }
    Some(())
}

/// Splits off a string that is preceded by its length.
fn text(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = bytes.split_first_chunk()?;
    rest.split_at_checked(u32::from_le_bytes(*length) as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn attachment() -> Vec<u8> {
        let mut body = [0; 16].to_vec();
        for part in [b"name", b"type"] {
            body.extend_from_slice(&4_u32.to_le_bytes());
            body.extend_from_slice(part);
        }
        body.extend_from_slice(&3_u64.to_le_bytes());
        body.extend_from_slice(b"abc");
        let crc = crc32fast::hash(&body);
        body.extend_from_slice(&crc.to_le_bytes());
        body
    }

    #[test]
    fn truncated_or_changed_attachments_are_rejected() {
        let body = attachment();
        assert!(matches!(record(op::ATTACHMENT, &body), Ok(Record::Attachment { .. })));
        for length in 0..body.len() {
            assert!(record(op::ATTACHMENT, &body[..length]).is_err(), "{length} bytes");
        }
        for position in 0..body.len() {
            let mut flipped = body.clone();
            flipped[position] ^= 0x81;
            assert!(record(op::ATTACHMENT, &flipped).is_err(), "byte {position}");
        }
    }

    #[test]
    fn strings_longer_than_the_record_are_rejected() {
        let metadata = |name: u32, entries: u32, key: u32| {
            let mut body = name.to_le_bytes().to_vec();
            body.extend_from_slice(b"place");
            body.extend_from_slice(&entries.to_le_bytes());
            for text in ["hall", "3"] {
                let length = if text == "hall" { key } else { 1 };
                body.extend_from_slice(&length.to_le_bytes());
                body.extend_from_slice(text.as_bytes());
            }
            record(op::METADATA, &body).is_ok()
        };
        assert!(metadata(5, 13, 4));
        for wrong in [6, 1_000, u32::MAX] {
            assert!(!metadata(wrong, 13, 4) && !metadata(5, wrong, 4) && !metadata(5, 13, wrong));
        }
    }
}
