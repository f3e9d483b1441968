//! Finishes a file whose writer could not: data end, summary section, footer.
//!
//! The chunks stay where they are; the summary section is made from the index of a scan.

use std::{
    fs::{File, OpenOptions},
    io::{Cursor, Seek, SeekFrom, Write},
    path::Path,
};

use binrw::BinWrite;
use byteorder::{LittleEndian, WriteBytesExt as _};
use mcap::{
    MAGIC,
    records::{self, DataEnd, Footer, SchemaHeader, Statistics, op},
};

use crate::{
    error::BagError,
    format::channel::Schema,
    read::{
        auxiliary::{AuxiliaryIndex, AuxiliaryRecord},
        index::FileIndex,
        records::{HEADER_SIZE, RecordHeader},
    },
};

/// Space that is left for `metadata.yaml` and the directory (bytes).
const RESERVE: usize = 64 << 10;

/// What happens when the summary section does not fit on the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum OnFullDisk {
    Fail,
    /// The last chunks are dropped.
    DropChunks,
}

/// Finishes the file with the index of its scan after its last complete record, and returns the index of the
/// finished file.
///
/// # Errors
/// [`BagError::Io`]; complete records stay complete.
pub(crate) fn finish_file(
    path: &Path,
    mut index: FileIndex,
    on_full_disk: OnFullDisk,
) -> Result<FileIndex, BagError> {
    let failed = |reason| BagError::Io { path: path.into(), action: "finishing the file", reason };
    let read = |header: &RecordHeader| {
        Ok((*header, AuxiliaryRecord::read(path, &index.file, header)?.index(header)))
    };
    let auxiliary: Vec<_> = index.auxiliary.iter().map(read).collect::<Result<_, BagError>>()?;
    let mut file = OpenOptions::new().read(true).write(true).open(path).map_err(failed)?;
    // Without the messages of a truncated chunk.
    let mut data_end = index.data_end;
    loop {
        index.truncate(data_end);
        let end = ending(&index, &auxiliary);
        file.set_len(data_end).map_err(failed)?;
        match append(&mut file, data_end, &end) {
            Ok(()) => {
                index.size += end.len() as u64;
                return Ok(index);
            }
            Err(error)
                if on_full_disk == OnFullDisk::DropChunks
                    && BagError::means_disk_full(&error)
                    && !index.chunks.is_empty() =>
            {
                data_end = without_chunks(&index, (end.len() + RESERVE) as u64);
            }
            Err(error) => return Err(failed(error)),
        }
    }
}

/// End of the data section (bytes) without the last chunks of at least `bytes` bytes.
fn without_chunks(index: &FileIndex, bytes: u64) -> u64 {
    let mut starts = index.chunks.iter().map(|chunk| chunk.chunk_start_offset);
    let first = starts.next().unwrap_or(index.data_end);
    starts.rev().find(|start| index.data_end - start >= bytes).unwrap_or(first)
}

/// Writes `bytes` at byte `at`, if the disk has also space for the reserve.
fn append(file: &mut File, at: u64, bytes: &[u8]) -> std::io::Result<()> {
    file.seek(SeekFrom::Start(at))?;
    file.write_all(bytes)?;
    file.write_all(&[0; RESERVE])?;
    file.set_len(at + bytes.len() as u64)?;
    file.sync_all()
}

/// Data end, summary section, footer and magic of a file with this index.
fn ending(index: &FileIndex, auxiliary: &[(RecordHeader, AuxiliaryIndex)]) -> Vec<u8> {
    let mut end = Vec::new();
    // No checksum of the data section, which would have to be read again; each chunk has its own.
    record(&mut end, op::DATA_END, &DataEnd { data_section_crc: 0 });
    let summary_start = index.data_end + end.len() as u64;
    for (&id, schema) in &index.declared.schemas {
        schema_record(&mut end, id, schema);
    }
    for (&id, channel) in &index.declared.channels {
        let known = |(_, schema): &(_, &std::sync::Arc<Schema>)| {
            channel.schema.as_ref().is_some_and(|wanted| wanted == *schema)
        };
        let record_of_channel = records::Channel {
            id,
            schema_id: index.declared.schemas.iter().find(known).map_or(0, |(&id, _)| id),
            topic: channel.topic.clone(),
            message_encoding: channel.encoding.clone(),
            metadata: channel.metadata.clone(),
        };
        record(&mut end, op::CHANNEL, &record_of_channel);
    }
    let attachments =
        index.auxiliary.iter().filter(|record| record.opcode == op::ATTACHMENT).count();
    let (message_start_time, message_end_time) = index.times.unwrap_or_default();
    // Ids with several contents are rejected before.
    let counts = index
        .counts
        .iter()
        .filter_map(|(&key, &messages)| Some((u16::try_from(key).ok()?, messages)));
    let statistics = Statistics {
        message_count: index.messages(),
        schema_count: index.declared.schemas.len() as u16,
        channel_count: index.declared.channels.len() as u32,
        attachment_count: attachments as u32,
        metadata_count: (index.auxiliary.len() - attachments) as u32,
        chunk_count: index.chunks.len() as u32,
        message_start_time,
        message_end_time,
        channel_message_counts: counts.collect(),
    };
    record(&mut end, op::STATISTICS, &statistics);
    for chunk in &index.chunks {
        record(&mut end, op::CHUNK_INDEX, chunk);
    }
    for (_, found) in auxiliary.iter().filter(|(header, _)| header.position < index.data_end) {
        match found {
            AuxiliaryIndex::Attachment(index) => record(&mut end, op::ATTACHMENT_INDEX, index),
            AuxiliaryIndex::Metadata(index) => record(&mut end, op::METADATA_INDEX, index),
        }
    }
    record(&mut end, op::FOOTER, &Footer { summary_start, ..Footer::default() });
    end.extend_from_slice(MAGIC);
    end
}

fn record<R>(into: &mut Vec<u8>, opcode: u8, body: &R)
where
    R: for<'a> BinWrite<Args<'a> = ()>,
{
    let start = into.len();
    header(into, opcode);
    let mut cursor = Cursor::new(&mut *into);
    cursor.set_position((start + HEADER_SIZE as usize) as u64);
    body.write_le(&mut cursor).expect("writing to a vector does not fail");
    close(into, start);
}

fn schema_record(into: &mut Vec<u8>, id: u16, schema: &Schema) {
    let start = into.len();
    header(into, op::SCHEMA);
    let mut cursor = Cursor::new(&mut *into);
    cursor.set_position((start + HEADER_SIZE as usize) as u64);
    let (name, encoding) = (schema.name.clone(), schema.encoding.clone());
    SchemaHeader { id, name, encoding }
        .write_le(&mut cursor)
        .and_then(|()| Ok(into.write_u32::<LittleEndian>(schema.data.len() as u32)?))
        .expect("writing to a vector does not fail");
    into.extend_from_slice(&schema.data);
    close(into, start);
}

fn header(into: &mut Vec<u8>, opcode: u8) {
    into.push(opcode);
    into.extend_from_slice(&[0; 8]);
}

/// Sets the length of the record from byte `start` to the end.
fn close(bytes: &mut [u8], start: usize) {
    let body = start + HEADER_SIZE as usize;
    let length = (bytes.len() - body) as u64;
    bytes[start + 1..body].copy_from_slice(&length.to_le_bytes());
}
