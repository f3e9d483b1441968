//! One piece of a file, a chunk or a run of messages outside chunks, decompressed and checked.

use std::{
    fs::File,
    io::{ErrorKind, Read, Seek, SeekFrom},
    path::Path,
};

use mcap::{
    McapError, McapResult,
    records::{Record, op},
    sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions},
};

use super::{
    error::BagError,
    parse,
    record::{self, ChunkHeader, HEADER_SIZE, SIZE_LIMIT},
};

/// What a piece of a file is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// One chunk record, whole.
    Chunk,
    /// One chunk record that the end of the file cuts.
    CutChunk,
    /// Schemas, channels and messages outside chunks, one after the other.
    Loose,
}

/// A piece of a file that holds messages.
#[derive(Clone, Debug)]
pub(super) struct Segment {
    /// Which of the bag's files.
    pub(super) file: usize,
    /// Where it starts (bytes).
    pub(super) position: u64,
    /// How long it is (bytes).
    pub(super) length: u64,
    pub(super) kind: Kind,
    /// Smallest log time (ns).
    pub(super) first: u64,
    /// Largest log time (ns).
    pub(super) last: u64,
}

impl Segment {
    /// Calls `on_record` with every schema, channel and message in it.
    ///
    /// A whole chunk is checked against its checksum before its first record. Of a cut one, the
    /// records before the cut are read; that it is cut is no error here.
    ///
    /// # Errors
    /// [`BagError::Io`]; [`BagError::Corrupt`] when the bytes are not what they should be, or when
    /// `on_record` says why it cannot use a record.
    pub(super) fn read(
        &self,
        path: &Path,
        on_record: impl FnMut(Record<'_>) -> Result<(), String>,
    ) -> Result<(), BagError> {
        let corrupt = |(found, expected): (String, &str)| BagError::Corrupt {
            path: path.into(),
            position: self.position,
            found,
            expected: expected.into(),
        };
        if self.length > SIZE_LIMIT {
            return Err(corrupt((format!("{} bytes", self.length), "at most 1 GiB")));
        }
        let bytes = read_piece(path, self.position, self.length)?;
        let outcome = match self.kind {
            Kind::Loose => walk(&bytes, on_record),
            Kind::Chunk => read_chunk(&bytes, on_record),
            Kind::CutChunk => return read_cut_chunk(bytes, on_record).map_err(corrupt),
        };
        outcome.map_err(|fault| corrupt(fault.words()))
    }
}

/// So many bytes of a file from there.
///
/// # Errors
/// [`BagError::Corrupt`] when the disk cannot read them, [`BagError::Io`] when the system refuses.
pub(super) fn read_piece(path: &Path, position: u64, length: u64) -> Result<Vec<u8>, BagError> {
    let read = || {
        let mut file = File::open(path)?;
        file.seek(SeekFrom::Start(position))?;
        let mut bytes = Vec::with_capacity(length as usize);
        file.take(length).read_to_end(&mut bytes)?;
        if (bytes.len() as u64) < length {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        Ok(bytes)
    };
    read().map_err(|error: std::io::Error| {
        if BagError::is_unreadable(&error) {
            let (found, expected) = (unreadable(&error), "readable bytes".into());
            BagError::Corrupt { path: path.into(), position, found, expected }
        } else {
            BagError::io(path, "reading")(error)
        }
    })
}

/// For messages about bytes that the disk cannot read.
pub(super) fn unreadable(error: &std::io::Error) -> String {
    format!("bytes that the disk cannot read ({error})")
}

/// What the formats can make of a byte at most: zstd repeats one in a block of 128 KiB by four bytes, LZ4
/// adds 255 to a length by one. Memory is taken for what a chunk claims, before it is decompressed.
const MOST_OF_ZSTD: u64 = 1 << 15;
const MOST_OF_LZ4: u64 = 1 << 8;

/// What so many bytes of a chunk can hold at most (bytes).
fn most_of(header: &ChunkHeader, compressed: u64) -> u64 {
    let factor = if header.compression == "lz4" { MOST_OF_LZ4 } else { MOST_OF_ZSTD };
    compressed.saturating_mul(factor)
}

/// Holds what a chunk claims to contain against its compressed size (bytes).
fn check_claim(header: &ChunkHeader, compressed: u64) -> Result<(), Fault> {
    let uncompressed = header.uncompressed;
    if uncompressed > most_of(header, compressed) {
        return Err(Fault::Claim { compressed, uncompressed });
    }
    Ok(())
}

/// Why the records of a piece could not be read to its end.
enum Fault {
    /// The bytes are no records, or fail their checksum.
    Mcap(McapError),
    /// A record cannot be used, for the reason given.
    Record(String),
    /// No compression makes so few bytes of so many.
    Claim { compressed: u64, uncompressed: u64 },
}

impl Fault {
    /// Found and expected.
    fn words(self) -> (String, &'static str) {
        match self {
            Self::Record(found) => (found, "a record that fits those before it"),
            Self::Claim { compressed, uncompressed } => (
                format!("a chunk of {compressed} bytes that claims to hold {uncompressed}"),
                "a size that its compression can reach",
            ),
            Self::Mcap(McapError::BadChunkCrc { saved, calculated }) => (
                format!("checksum {calculated:08x} where the chunk says {saved:08x}"),
                "equal checksums",
            ),
            Self::Mcap(McapError::UnsupportedCompression(name)) => {
                (format!("compression `{name}`"), "zstd, lz4 or none")
            }
            Self::Mcap(error) => {
                (format!("bytes that cannot be read ({error})"), "whole MCAP records")
            }
        }
    }
}

impl From<McapError> for Fault {
    fn from(error: McapError) -> Self {
        Self::Mcap(error)
    }
}

fn read_chunk(
    bytes: &[u8],
    on_record: impl FnMut(Record<'_>) -> Result<(), String>,
) -> Result<(), Fault> {
    match bytes.get(HEADER_SIZE as usize..).and_then(ChunkHeader::parse) {
        // Where they are, without the copies that MCAP's reader makes.
        Some(header) if header.compression.is_empty() => {
            let records = bytes.get(HEADER_SIZE as usize + header.records..).unwrap_or_default();
            let (saved, calculated) = (header.crc, crc32fast::hash(records));
            // Without a checksum nothing vouches for the lengths in it: they are checked one by one.
            if saved != 0 && saved != calculated {
                return Err(McapError::BadChunkCrc { saved, calculated }.into());
            }
            walk(records, on_record)
        }
        Some(header) => {
            check_claim(&header, bytes.len() as u64)?;
            drive(bytes, header.uncompressed, on_record)
        }
        None => drive(bytes, 0, on_record),
    }
}

/// Gives the records in memory, one after the other.
fn walk(
    mut bytes: &[u8],
    mut on_record: impl FnMut(Record<'_>) -> Result<(), String>,
) -> Result<(), Fault> {
    while let Some((&opcode, rest)) = bytes.split_first() {
        let (length, rest) = rest.split_first_chunk().ok_or(McapError::UnexpectedEof)?;
        let length = usize::try_from(u64::from_le_bytes(*length)).unwrap_or(usize::MAX);
        let (body, rest) = rest.split_at_checked(length).ok_or(McapError::UnexpectedEof)?;
        if let Some(record) = wanted_record(opcode, body)? {
            on_record(record).map_err(Fault::Record)?;
        }
        bytes = rest;
    }
    Ok(())
}

fn read_cut_chunk(
    mut bytes: Vec<u8>,
    mut on_record: impl FnMut(Record<'_>) -> Result<(), String>,
) -> Result<(), (String, &'static str)> {
    let body = HEADER_SIZE as usize;
    let Some(header) = bytes.get(body..).and_then(ChunkHeader::parse) else { return Ok(()) };
    let records = body + header.records;
    if bytes.len() <= records {
        return Ok(());
    }
    let outcome = if header.compression.is_empty() {
        walk(&bytes[records..], on_record)
    } else {
        // What it claims was of all its bytes. It now claims what is there, and no checksum, so that it is
        // read up to the cut.
        let (length, compressed) = ((bytes.len() - body) as u64, (bytes.len() - records) as u64);
        let uncompressed = header.uncompressed.min(most_of(&header, compressed));
        bytes[1..body].copy_from_slice(&length.to_le_bytes());
        bytes[body + 16..body + 24].copy_from_slice(&uncompressed.to_le_bytes());
        bytes[body + 24..body + 28].fill(0);
        bytes[records - 8..records].copy_from_slice(&compressed.to_le_bytes());
        check_claim(&header, header.compressed)
            .and_then(|()| drive(&bytes, uncompressed, &mut on_record))
    };
    match outcome {
        Err(fault @ (Fault::Record(_) | Fault::Claim { .. })) => Err(fault.words()),
        // Bytes that end too early are what a cut is.
        Err(Fault::Mcap(_)) | Ok(()) => Ok(()),
    }
}

/// Runs MCAP's reader over a compressed chunk of so much content (bytes). It takes memory for as much as a record
/// says it is long: none is longer than the content.
fn drive(
    bytes: &[u8],
    uncompressed: u64,
    mut on_record: impl FnMut(Record<'_>) -> Result<(), String>,
) -> Result<(), Fault> {
    let longest = uncompressed.max(bytes.len() as u64).min(SIZE_LIMIT);
    let mut reader = LinearReader::new_with_options(
        LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_record_length_limit(longest as usize),
    );
    let mut rest = bytes;
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(wanted) => {
                let (next, after) = rest.split_at(wanted.min(rest.len()));
                reader.insert(next.len()).copy_from_slice(next);
                reader.notify_read(next.len());
                rest = after;
            }
            LinearReadEvent::Record { opcode, data } => {
                if let Some(record) = wanted_record(opcode, data)? {
                    on_record(record).map_err(Fault::Record)?;
                }
            }
        }
    }
    Ok(())
}

/// The record, if it is one of the three kinds that count here.
pub(super) fn wanted_record(opcode: u8, body: &[u8]) -> McapResult<Option<Record<'_>>> {
    match opcode {
        op::SCHEMA | op::CHANNEL | op::MESSAGE => parse::record(opcode, body).map(Some),
        _ => Ok(None),
    }
}

/// For messages about records: `a chunk of 12 bytes`.
pub(super) fn described(header: &record::RecordHeader) -> String {
    format!("a {} of {} bytes", record::name(header.opcode), header.length)
}
