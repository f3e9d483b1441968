//! The records of an MCAP file, one after the other, without their contents.
//!
//! A record is one byte of opcode, eight bytes of length, and so many bytes of body (MCAP
//! specification, "Records").

use std::{
    fs::File,
    io::{self, BufReader, Read, Seek, SeekFrom},
};

use mcap::{MAGIC, records::op};

use super::{error::BagError, resync::Searched};

/// Opcode and length.
pub(super) const HEADER_SIZE: u64 = 9;

/// No record has this opcode: bytes that were never written, most likely.
pub(super) const NO_RECORD: u8 = 0;

/// Body of the footer: start of the summary, start of its offsets, checksum.
const FOOTER_BODY: u64 = 20;

/// Body of a chunk before the name of its compression: two times, size, checksum, length of the
/// name.
const CHUNK_FIXED: usize = 8 + 8 + 8 + 4 + 4;

/// Longer names of compressions are not looked at.
const COMPRESSION_NAME_LIMIT: usize = 64;

/// Longest body, and largest chunk, that is read into memory (bytes).
pub(super) const SIZE_LIMIT: u64 = 1 << 30;

/// A record's place in the file.
#[derive(Clone, Copy, Debug)]
pub(super) struct RecordHeader {
    /// Where it starts (bytes).
    pub(super) position: u64,
    pub(super) opcode: u8,
    /// Length of the body (bytes), as claimed.
    pub(super) length: u64,
}

impl RecordHeader {
    /// Where the body starts.
    pub(super) fn body(&self) -> u64 {
        self.position + HEADER_SIZE
    }

    /// Where the next record starts.
    pub(super) fn end(&self) -> u64 {
        self.body().saturating_add(self.length)
    }
}

/// What the walk through a file met.
pub(super) enum Step {
    /// A record that is there with its whole body.
    Record(RecordHeader),
    /// A record whose header is there, but not its whole body.
    CutBody(RecordHeader),
    /// Less than a record's header before the end of the file.
    CutHeader,
    /// The end of the file, just after a record.
    End,
}

/// Walks through the records of a file.
pub(super) struct Records {
    file: BufReader<File>,
    pub(super) size: u64,
    /// Where the next record starts.
    pub(super) position: u64,
    pub(super) searched: Searched,
}

impl Records {
    /// Starts at a byte position of a file of `size` bytes.
    pub(super) fn new(file: File, size: u64, position: u64) -> Self {
        Self { file: BufReader::new(file), size, position, searched: Searched::default() }
    }

    /// The next record's place; its body is passed over, unless [`Records::read`] is called for it.
    pub(super) fn step(&mut self) -> io::Result<Step> {
        let left = self.size.saturating_sub(self.position);
        if left == 0 {
            return Ok(Step::End);
        }
        if left < HEADER_SIZE {
            return Ok(Step::CutHeader);
        }
        let mut header = [0; HEADER_SIZE as usize];
        self.read_at(self.position, &mut header)?;
        let [opcode, length @ ..] = header;
        let length = u64::from_le_bytes(length);
        let record = RecordHeader { position: self.position, opcode, length };
        if record.length > left - HEADER_SIZE {
            return Ok(Step::CutBody(record));
        }
        self.position = record.end();
        Ok(Step::Record(record))
    }

    /// The body of a record that is there whole.
    pub(super) fn read(&mut self, record: &RecordHeader) -> io::Result<Vec<u8>> {
        let mut body = vec![0; record.length as usize];
        self.read_at(record.body(), &mut body)?;
        Ok(body)
    }

    /// What a chunk states about itself, if so much of it is there.
    pub(super) fn chunk_header(&mut self, chunk: &RecordHeader) -> io::Result<Option<ChunkHeader>> {
        let available = self.size.saturating_sub(chunk.body()).min(chunk.length);
        let mut start =
            vec![0; available.min((CHUNK_FIXED + COMPRESSION_NAME_LIMIT) as u64) as usize];
        match self.read_at(chunk.body(), &mut start) {
            Ok(()) => Ok(ChunkHeader::parse(&start)),
            Err(error) if BagError::is_unreadable(&error) => Ok(None),
            Err(error) => Err(error),
        }
    }

    pub(super) fn read_at(&mut self, position: u64, into: &mut [u8]) -> io::Result<()> {
        let here = self.file.stream_position()?;
        match i64::try_from(i128::from(position) - i128::from(here)) {
            Ok(offset) => self.file.seek_relative(offset)?,
            Err(_) => drop(self.file.seek(SeekFrom::Start(position))?),
        }
        self.file.read_exact(into)
    }
}

/// What a chunk states about itself.
pub(super) struct ChunkHeader {
    /// Size of the records before compression (bytes).
    pub(super) uncompressed: u64,
    /// Empty for none.
    pub(super) compression: String,
    /// CRC-32 of the records before compression; 0 if there is none.
    pub(super) crc: u32,
    /// Where the records start in the body.
    pub(super) records: usize,
    /// Their size after compression (bytes).
    pub(super) compressed: u64,
}

impl ChunkHeader {
    /// How long the chunk's body is by what it states about itself (bytes).
    pub(super) fn length(&self) -> Option<u64> {
        self.compressed.checked_add(self.records as u64)
    }

    /// The header at the start of a chunk's body, if it is there whole.
    pub(super) fn parse(body: &[u8]) -> Option<Self> {
        let number = |at: usize| body.get(at..at + 4)?.try_into().ok().map(u32::from_le_bytes);
        let long = |at: usize| body.get(at..at + 8)?.try_into().ok().map(u64::from_le_bytes);
        let uncompressed = long(16)?;
        let (crc, name_length) = (number(24)?, number(28)? as usize);
        if name_length > COMPRESSION_NAME_LIMIT {
            return None;
        }
        let name_end = CHUNK_FIXED + name_length;
        let compression = String::from_utf8(body.get(CHUNK_FIXED..name_end)?.to_vec()).ok()?;
        let (compressed, records) = (long(name_end)?, name_end + 8);
        Some(Self { uncompressed, compression, crc, records, compressed })
    }
}

/// Where the summary of a finished file starts; `None` if the file does not end as a finished one,
/// or has no summary.
pub(super) fn summary_start(file: &mut File, size: u64) -> io::Result<Option<u64>> {
    let footer_size = HEADER_SIZE + FOOTER_BODY + MAGIC.len() as u64;
    if size < MAGIC.len() as u64 + footer_size {
        return Ok(None);
    }
    file.seek(SeekFrom::Start(size - footer_size))?;
    let mut footer = vec![0; footer_size as usize];
    file.read_exact(&mut footer)?;
    let [opcode, footer @ ..] = footer.as_slice() else { return Ok(None) };
    let (length, footer) = footer.split_at(8);
    let (start, _) = footer.split_at(8);
    let whole =
        *opcode == op::FOOTER && length == FOOTER_BODY.to_le_bytes() && footer.ends_with(MAGIC);
    let start = start.try_into().map(u64::from_le_bytes).unwrap_or_default();
    let plausible = start >= MAGIC.len() as u64 && start < size - footer_size;
    Ok((whole && plausible).then_some(start))
}

/// What a record is, for messages.
pub(super) fn name(opcode: u8) -> String {
    let name = match opcode {
        op::HEADER => "header",
        op::FOOTER => "footer",
        op::SCHEMA => "schema",
        op::CHANNEL => "channel",
        op::MESSAGE => "message",
        op::CHUNK => "chunk",
        op::MESSAGE_INDEX => "message index",
        op::CHUNK_INDEX => "chunk index",
        op::ATTACHMENT => "attachment",
        op::METADATA => "metadata record",
        op::STATISTICS => "statistics",
        op::DATA_END => "data end",
        other => return format!("record with opcode {other:#04x}"),
    };
    name.to_owned()
}
