//! Writes the end of a file whose writer could not: data end, summary, footer.
//!
//! The chunks stay where they are; the summary is made from what a walk through the file found.

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

use super::{
    channel::Schema,
    error::BagError,
    extra::{Extra, ExtraIndex},
    index::FileIndex,
    record::{HEADER_SIZE, RecordHeader},
};

/// Room that `metadata.yaml` and the directory may need beside the summary (bytes).
const ELBOW_ROOM: usize = 64 << 10;

/// Whether the last chunks of a file may go to make room for its summary.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Chunks {
    Stay,
    MakeRoom,
}

/// Ends the file, of which `index` tells what a walk through it found, after its last whole record. When the
/// disk has no room for the summary, the last chunks make some, if they may. Gives what the file then holds.
///
/// # Errors
/// [`BagError::Io`]; what was whole before is whole after it.
pub(super) fn end_file(
    path: &Path,
    mut index: FileIndex,
    chunks: Chunks,
) -> Result<FileIndex, BagError> {
    let failed = |reason| BagError::Io { path: path.into(), action: "ending the file", reason };
    let extras = index.extras.iter().map(|header| Ok((*header, Extra::read(path, header)?)));
    let extras: Vec<_> = extras
        .map(|extra| extra.map(|(header, extra)| (header, extra.index(&header))))
        .collect::<Result<_, BagError>>()?;
    let mut file = OpenOptions::new().read(true).write(true).open(path).map_err(failed)?;
    // What a cut chunk still has is not in the file any more then.
    let mut data_end = index.data_end;
    loop {
        index.cut_back(data_end);
        let end = ending(&index, &extras);
        file.set_len(data_end).map_err(failed)?;
        match append(&mut file, data_end, &end) {
            Ok(()) => {
                index.size += end.len() as u64;
                return Ok(index);
            }
            Err(error)
                if chunks == Chunks::MakeRoom
                    && BagError::is_out_of_room(&error)
                    && !index.chunks.is_empty() =>
            {
                data_end = without_chunks(&index, (end.len() + ELBOW_ROOM) as u64);
            }
            Err(error) => return Err(failed(error)),
        }
    }
}

/// Where the data end when chunks from their end have given so many bytes.
fn without_chunks(index: &FileIndex, bytes: u64) -> u64 {
    let mut starts = index.chunks.iter().map(|chunk| chunk.chunk_start_offset);
    let first = starts.next().unwrap_or(index.data_end);
    starts.rev().find(|start| index.data_end - start >= bytes).unwrap_or(first)
}

/// Writes `bytes` there, if there is also some room for what is written after it.
fn append(file: &mut File, at: u64, bytes: &[u8]) -> std::io::Result<()> {
    file.seek(SeekFrom::Start(at))?;
    file.write_all(bytes)?;
    file.write_all(&[0; ELBOW_ROOM])?;
    file.set_len(at + bytes.len() as u64)?;
    file.sync_all()
}

/// Data end, summary, footer and magic of a file with this index.
fn ending(index: &FileIndex, extras: &[(RecordHeader, ExtraIndex)]) -> Vec<u8> {
    let mut end = Vec::new();
    // No checksum over the data section, which is read again nowhere here; each chunk has its own.
    record(&mut end, op::DATA_END, &DataEnd { data_section_crc: 0 });
    let summary_start = index.data_end + end.len() as u64;
    for (&id, schema) in &index.schemas {
        schema_record(&mut end, id, schema);
    }
    for (&id, channel) in &index.channels {
        let known = |(_, schema): &(_, &std::sync::Arc<Schema>)| {
            channel.schema.as_ref().is_some_and(|wanted| wanted == *schema)
        };
        let record_of_channel = records::Channel {
            id,
            schema_id: index.schemas.iter().find(known).map_or(0, |(&id, _)| id),
            topic: channel.topic.clone(),
            message_encoding: channel.encoding.clone(),
            metadata: channel.metadata.clone(),
        };
        record(&mut end, op::CHANNEL, &record_of_channel);
    }
    let attachments = index.extras.iter().filter(|extra| extra.opcode == op::ATTACHMENT).count();
    let (message_start_time, message_end_time) = index.times.unwrap_or_default();
    let statistics = Statistics {
        message_count: index.messages(),
        schema_count: index.schemas.len() as u16,
        channel_count: index.channels.len() as u32,
        attachment_count: attachments as u32,
        metadata_count: (index.extras.len() - attachments) as u32,
        chunk_count: index.chunks.len() as u32,
        message_start_time,
        message_end_time,
        channel_message_counts: index.counts.clone(),
    };
    record(&mut end, op::STATISTICS, &statistics);
    for chunk in &index.chunks {
        record(&mut end, op::CHUNK_INDEX, chunk);
    }
    for (_, extra) in extras.iter().filter(|(header, _)| header.position < index.data_end) {
        match extra {
            ExtraIndex::Attachment(index) => record(&mut end, op::ATTACHMENT_INDEX, index),
            ExtraIndex::Metadata(index) => record(&mut end, op::METADATA_INDEX, index),
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
    body.write_le(&mut cursor).expect("a vector takes whatever is written");
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
        .expect("a vector takes whatever is written");
    into.extend_from_slice(&schema.data);
    close(into, start);
}

fn header(into: &mut Vec<u8>, opcode: u8) {
    into.push(opcode);
    into.extend_from_slice(&[0; 8]);
}

/// Fills in the length of the record that starts there and ends here.
fn close(bytes: &mut [u8], start: usize) {
    let body = start + HEADER_SIZE as usize;
    let length = (bytes.len() - body) as u64;
    bytes[start + 1..body].copy_from_slice(&length.to_le_bytes());
}
