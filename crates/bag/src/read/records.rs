//! Steps through the records of an MCAP file without parsing them, also where the file is damaged.
//!
//! A record is one byte of opcode, eight bytes of length, and the body (MCAP specification, "Records").

use std::io::{self, BufReader, Read, Seek, SeekFrom};

use eddy_storage::Reader;
use mcap::{MAGIC, records::op};

use super::index::Times;
use crate::error::BagError;

/// Size of opcode and length (bytes).
pub(crate) const HEADER_SIZE: u64 = 9;

/// Not an opcode: most likely bytes that were never written.
pub(crate) const NO_RECORD: u8 = 0;

/// Body of the footer: start of the summary, start of the summary offsets, checksum (bytes).
const FOOTER_BODY: u64 = 20;

/// Body of a chunk before the name of its compression: two times, size, checksum, length of the name
/// (bytes).
const CHUNK_FIXED: usize = 8 + 8 + 8 + 4 + 4;

/// Longest name of a compression that is read (bytes).
const COMPRESSION_NAME_LIMIT: usize = 64;

/// Longest body, and largest chunk, that is read into memory (bytes).
pub(crate) const SIZE_LIMIT: u64 = 1 << 30;

/// Position and length of a record.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RecordHeader {
    /// Start of the record (bytes).
    pub(crate) position: u64,
    pub(crate) opcode: u8,
    /// Declared length of the body (bytes).
    pub(crate) length: u64,
}

impl RecordHeader {
    /// Start of the body (bytes).
    pub(crate) fn body(&self) -> u64 {
        self.position + HEADER_SIZE
    }

    /// Start of the next record (bytes).
    pub(crate) fn end(&self) -> u64 {
        self.body().saturating_add(self.length)
    }
}

/// Outcome of [`Records::step`].
pub(crate) enum Step {
    /// A complete record.
    Record(RecordHeader),
    /// A record whose body is truncated.
    TruncatedBody(RecordHeader),
    /// Fewer bytes before the end of the file than a record header has.
    TruncatedHeader,
    /// The end of the file, after a complete record.
    End,
}

/// The records of a file.
pub(crate) struct Records {
    file: BufReader<Reader>,
    pub(super) size: u64,
    /// Start of the next record (bytes).
    pub(super) position: u64,
    /// Searches that reached the end of the file without a match.
    pub(super) absent: Absent,
}

/// Kinds of records that no longer occur before the end of the file.
#[derive(Default)]
pub(crate) struct Absent {
    pub(super) chunks: bool,
    pub(super) messages: bool,
}

impl Records {
    /// Starts at byte `position` of a file of `size` bytes.
    pub(crate) fn new(file: Reader, size: u64, position: u64) -> Self {
        Self { file: BufReader::new(file), size, position, absent: Absent::default() }
    }

    /// Steps over the next record.
    pub(crate) fn step(&mut self) -> io::Result<Step> {
        let left = self.size.saturating_sub(self.position);
        if left == 0 {
            return Ok(Step::End);
        }
        if left < HEADER_SIZE {
            return Ok(Step::TruncatedHeader);
        }
        let mut header = [0; HEADER_SIZE as usize];
        self.read_at(self.position, &mut header)?;
        let [opcode, length @ ..] = header;
        let length = u64::from_le_bytes(length);
        let record = RecordHeader { position: self.position, opcode, length };
        if record.length > left - HEADER_SIZE {
            return Ok(Step::TruncatedBody(record));
        }
        self.position = record.end();
        Ok(Step::Record(record))
    }

    /// Reads the body of a complete record.
    pub(super) fn read(&mut self, record: &RecordHeader) -> io::Result<Vec<u8>> {
        let mut body = vec![0; record.length as usize];
        self.read_at(record.body(), &mut body)?;
        Ok(body)
    }

    /// Reads the fields of a chunk before its records; `None` if they are truncated or unreadable.
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

/// The compression of a chunk by its name in a file. The specification has an empty string for none; some writers put `none`.
pub(super) fn compression(name: &str) -> &str {
    if name == "none" { "" } else { name }
}

/// The fields of a chunk before its records.
pub(crate) struct ChunkHeader {
    /// Log times of the first and the last message, as the chunk states them (ns).
    pub(crate) times: Times,
    /// Size of the records before compression (bytes).
    pub(crate) uncompressed: u64,
    /// Empty for none.
    pub(crate) compression: String,
    /// CRC-32 of the records before compression; 0 if there is none.
    pub(crate) crc: u32,
    /// Start of the records in the body (bytes).
    pub(crate) records: usize,
    /// Size of the records after compression (bytes).
    pub(crate) compressed: u64,
}

impl ChunkHeader {
    /// Length of the chunk's body by these fields (bytes).
    pub(super) fn length(&self) -> Option<u64> {
        self.compressed.checked_add(self.records as u64)
    }

    /// Parses the start of a chunk's body; `None` if it is truncated.
    pub(crate) fn parse(body: &[u8]) -> Option<Self> {
        let number = |at: usize| body.get(at..at + 4)?.try_into().ok().map(u32::from_le_bytes);
        let long = |at: usize| body.get(at..at + 8)?.try_into().ok().map(u64::from_le_bytes);
        let (times, uncompressed) = ((long(0)?, long(8)?), long(16)?);
        let (crc, name_length) = (number(24)?, number(28)? as usize);
        if name_length > COMPRESSION_NAME_LIMIT {
            return None;
        }
        let name_end = CHUNK_FIXED + name_length;
        let name = str::from_utf8(body.get(CHUNK_FIXED..name_end)?).ok()?;
        let compression = compression(name).to_owned();
        let (compressed, records) = (long(name_end)?, name_end + 8);
        Some(Self { times, uncompressed, compression, crc, records, compressed })
    }
}

/// Start of the summary section (bytes); `None` if the file does not end with a footer or has no summary
/// section.
pub(super) fn summary_start(file: &mut Reader, size: u64) -> io::Result<Option<u64>> {
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

/// Name of a record type, for error messages.
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
