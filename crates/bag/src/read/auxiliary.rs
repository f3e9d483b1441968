//! Attachments and metadata records: what a file holds beside messages.

use std::{
    collections::{BTreeMap, HashSet},
    path::Path,
};

use eddy_storage::File;
use mcap::{
    Attachment,
    records::{AttachmentIndex, Metadata, MetadataIndex, Record, op},
};

use super::{
    block::{describe, read_error},
    records::{RecordHeader, SIZE_LIMIT},
};
use crate::{
    error::BagError,
    format::{
        description::{self, Description},
        parse,
    },
};

/// An attachment or a metadata record.
#[derive(Debug)]
pub(crate) enum AuxiliaryRecord {
    Attachment(Attachment<'static>),
    Metadata(Metadata),
}

impl AuxiliaryRecord {
    /// Reads the record at this position of `file`, which is at `path`.
    ///
    /// # Errors
    /// [`BagError::Io`]; [`BagError::Corrupt`] when the record is damaged.
    pub(crate) fn read(path: &Path, file: &File, header: &RecordHeader) -> Result<Self, BagError> {
        let corrupt = |found: String, expected: &str| BagError::Corrupt {
            path: path.into(),
            position: header.position,
            found,
            expected: expected.into(),
        };
        if header.length > SIZE_LIMIT {
            return Err(corrupt(describe(header), "at most 1 GiB"));
        }
        let body = file.read(header.body(), header.length);
        let body = body.map_err(|error| read_error(path, header.body(), error))?;
        Self::parse(header.opcode, &body).map_err(|found| corrupt(found, "a valid record"))
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
            Err(error) => Err(format!("unreadable bytes ({error})")),
        }
    }

    /// Whether it describes the recording rather than the file it is in, and should be copied with the bag.
    pub(crate) fn describes_recording(&self) -> bool {
        !matches!(self, Self::Metadata(metadata) if metadata.name == description::RECORD)
    }

    /// Its index record for the summary section.
    pub(crate) fn index(&self, header: &RecordHeader) -> AuxiliaryIndex {
        let (offset, length) = (header.position, header.end() - header.position);
        match self {
            Self::Attachment(attachment) => AuxiliaryIndex::Attachment(AttachmentIndex {
                offset,
                length,
                log_time: attachment.log_time,
                create_time: attachment.create_time,
                data_size: attachment.data.len() as u64,
                name: attachment.name.clone(),
                media_type: attachment.media_type.clone(),
            }),
            Self::Metadata(Metadata { name, .. }) => {
                AuxiliaryIndex::Metadata(MetadataIndex { offset, length, name: name.clone() })
            }
        }
    }
}

/// Longest metadata record of rosbag2 that is read (bytes).
const DESCRIPTION_LIMIT: u64 = 16 << 20;

/// What the metadata records of rosbag2 say of the recording, the last one first: rosbag2 appends a new one for each change.
pub(super) fn description(file: &File, records: &[RecordHeader]) -> Description {
    let name_length = description::RECORD.len();
    let start = [&(name_length as u32).to_le_bytes()[..], description::RECORD.as_bytes()].concat();
    let mut found = Description::default();
    for header in records.iter().rev().filter(|header| header.opcode == op::METADATA) {
        if !(start.len() as u64..DESCRIPTION_LIMIT).contains(&header.length) {
            continue;
        }
        let is_description = |file: &File| file.read(header.body(), start.len() as u64);
        // What cannot be read says nothing here; copying it is an error.
        if is_description(file).is_ok_and(|name| name == start)
            && let Ok(body) = file.read(header.body(), header.length)
            && let Ok(AuxiliaryRecord::Metadata(metadata)) =
                AuxiliaryRecord::parse(header.opcode, &body)
        {
            found = found.or(&Description::of_record(&metadata.metadata));
        }
    }
    found
}

/// Index record of an attachment or a metadata record.
pub(crate) enum AuxiliaryIndex {
    Attachment(AttachmentIndex),
    Metadata(MetadataIndex),
}

/// The records that were written, so that none is written twice.
#[derive(Default)]
pub(crate) struct Written(HashSet<Key>);

/// Records with equal keys are equal.
#[derive(PartialEq, Eq, Hash)]
enum Key {
    Attachment { name: String, media_type: String, times: [u64; 2], length: usize, crc: u32 },
    Metadata(String, BTreeMap<String, String>),
}

impl Written {
    /// Whether the record was not there yet.
    pub(crate) fn insert(&mut self, record: &AuxiliaryRecord) -> bool {
        self.0.insert(match record {
            AuxiliaryRecord::Attachment(attachment) => Key::Attachment {
                name: attachment.name.clone(),
                media_type: attachment.media_type.clone(),
                times: [attachment.log_time, attachment.create_time],
                length: attachment.data.len(),
                crc: crc32fast::hash(&attachment.data),
            },
            AuxiliaryRecord::Metadata(metadata) => {
                Key::Metadata(metadata.name.clone(), metadata.metadata.clone())
            }
        })
    }
}
