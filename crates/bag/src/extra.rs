//! What a file holds beside messages: attachments and metadata records.

use std::{
    collections::{BTreeMap, HashSet},
    path::Path,
};

use mcap::{
    Attachment,
    records::{AttachmentIndex, Metadata, MetadataIndex, Record},
};

use super::{
    error::BagError,
    parse,
    record::{RecordHeader, SIZE_LIMIT},
    segment::{described, read_piece},
};

/// The metadata record in which rosbag2 repeats `metadata.yaml`. It is about the file that it is in, not
/// about what was recorded.
const ABOUT_THE_FILE: &str = "rosbag2";

/// An attachment or a metadata record.
#[derive(Debug)]
pub(super) enum Extra {
    Attachment(Attachment<'static>),
    Metadata(Metadata),
}

impl Extra {
    /// Reads the one whose record lies there.
    ///
    /// # Errors
    /// [`BagError::Io`]; [`BagError::Corrupt`] when the bytes are not what they should be.
    pub(super) fn read(path: &Path, header: &RecordHeader) -> Result<Self, BagError> {
        let corrupt = |found: String, expected: &str| BagError::Corrupt {
            path: path.into(),
            position: header.position,
            found,
            expected: expected.into(),
        };
        if header.length > SIZE_LIMIT {
            return Err(corrupt(described(header), "at most 1 GiB"));
        }
        let body = read_piece(path, header.body(), header.length)?;
        Self::parse(header.opcode, &body).map_err(|found| corrupt(found, "a whole record"))
    }

    fn parse(opcode: u8, body: &[u8]) -> Result<Self, String> {
        match parse::record(opcode, body) {
            Ok(Record::Attachment { header, data, .. }) => Ok(Self::Attachment(Attachment {
                log_time: header.log_time,
                create_time: header.create_time,
                name: header.name,
                media_type: header.media_type,
                data: data.into_owned().into(),
            })),
            Ok(Record::Metadata(metadata)) => Ok(Self::Metadata(metadata)),
            Ok(_) => Err(format!("a record with opcode {opcode:#04x}")),
            Err(error) => Err(format!("bytes that cannot be read ({error})")),
        }
    }

    /// Whether it is worth keeping in another file.
    pub(super) fn is_about_what_was_recorded(&self) -> bool {
        !matches!(self, Self::Metadata(metadata) if metadata.name == ABOUT_THE_FILE)
    }

    /// What a summary says about it.
    pub(super) fn index(&self, header: &RecordHeader) -> ExtraIndex {
        let (offset, length) = (header.position, header.end() - header.position);
        match self {
            Self::Attachment(attachment) => ExtraIndex::Attachment(AttachmentIndex {
                offset,
                length,
                log_time: attachment.log_time,
                create_time: attachment.create_time,
                data_size: attachment.data.len() as u64,
                name: attachment.name.clone(),
                media_type: attachment.media_type.clone(),
            }),
            Self::Metadata(Metadata { name, .. }) => {
                ExtraIndex::Metadata(MetadataIndex { offset, length, name: name.clone() })
            }
        }
    }
}

/// What a summary says about an attachment or a metadata record.
pub(super) enum ExtraIndex {
    Attachment(AttachmentIndex),
    Metadata(MetadataIndex),
}

/// Knows those that were written, so that none is written twice.
#[derive(Default)]
pub(super) struct Written(HashSet<Key>);

/// What makes two of them one.
#[derive(PartialEq, Eq, Hash)]
enum Key {
    Attachment { name: String, media_type: String, times: [u64; 2], length: usize, crc: u32 },
    Metadata(String, BTreeMap<String, String>),
}

impl Written {
    /// Whether it is new.
    pub(super) fn add(&mut self, extra: &Extra) -> bool {
        self.0.insert(match extra {
            Extra::Attachment(attachment) => Key::Attachment {
                name: attachment.name.clone(),
                media_type: attachment.media_type.clone(),
                times: [attachment.log_time, attachment.create_time],
                length: attachment.data.len(),
                crc: crc32fast::hash(&attachment.data),
            },
            Extra::Metadata(metadata) => {
                Key::Metadata(metadata.name.clone(), metadata.metadata.clone())
            }
        })
    }
}
