//! Blocks of the data section: a chunk, or consecutive messages outside chunks. Decompressed and checked.

use std::{collections::BTreeMap, io, path::Path};

use eddy_storage::{File, Prefetched};
use mcap::{
    McapError, McapResult,
    records::{Record, op},
    sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions},
};

use super::{
    index::ChannelKey,
    records::{self, ChunkHeader, HEADER_SIZE, RecordHeader, SIZE_LIMIT},
};
use crate::{error::BagError, format::parse};

/// Form of a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BlockKind {
    /// A complete chunk record.
    Chunk,
    /// A chunk record that the end of the file truncates.
    TruncatedChunk,
    /// Schemas, channels and messages outside chunks.
    Unchunked,
}

/// From record `from` of a block on, counted over its schemas, channels and messages, messages of the channel `id` belong to
/// `key`: the file declares the id again, with another content.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Switch {
    pub(super) from: usize,
    pub(super) id: u16,
    pub(super) key: ChannelKey,
}

/// The channels that the ids of messages stand for while a block is read.
pub(super) struct ChannelKeys<'b> {
    switches: &'b [Switch],
    record: usize,
    switched: BTreeMap<u16, ChannelKey>,
}

impl<'b> ChannelKeys<'b> {
    pub(super) fn of(block: &'b Block) -> Self {
        Self { switches: &block.switches, record: 0, switched: BTreeMap::new() }
    }

    /// Goes on to the next schema, channel or message.
    pub(super) fn next_record(&mut self) {
        while let Some((Switch { from, id, key }, rest)) = self.switches.split_first()
            && *from <= self.record
        {
            self.switched.insert(*id, *key);
            self.switches = rest;
        }
        self.record += 1;
    }

    /// The channel of messages with this id.
    pub(super) fn key(&self, id: u16) -> ChannelKey {
        self.switched.get(&id).copied().unwrap_or(id.into())
    }
}

/// A block that holds messages.
#[derive(Clone, Debug)]
pub(crate) struct Block {
    /// Index of the file in the bag.
    pub(super) file: usize,
    /// Start (bytes).
    pub(super) position: u64,
    /// Length (bytes).
    pub(super) length: u64,
    pub(super) kind: BlockKind,
    /// Smallest log time (ns).
    pub(super) first: u64,
    /// Largest log time (ns).
    pub(super) last: u64,
    /// Ids that stand for another channel than the first one declared with them; in the order of `from`.
    pub(super) switches: Vec<Switch>,
    /// Channels of its messages; `None` if unknown.
    pub(super) channels: Option<Box<[ChannelKey]>>,
}

impl Block {
    /// A complete chunk, whose times are not known.
    pub(crate) fn of_chunk(header: &RecordHeader) -> Self {
        let (position, length) = (header.position, header.end() - header.position);
        let (kind, switches) = (BlockKind::Chunk, Vec::new());
        Self { file: 0, position, length, kind, first: 0, last: 0, switches, channels: None }
    }

    /// Begins to fetch the block from a store; `None` for a file on disk, and for a block that is too large to be read.
    pub(super) fn prefetch(&self, file: &File) -> Option<Prefetched> {
        (self.length <= SIZE_LIMIT).then(|| file.prefetch(self.position, self.length)).flatten()
    }

    /// Calls `on_record` for every schema, channel and message of the block in `file`, which is at `path`, with its place in the
    /// decompressed block (bytes). The bytes of the block are those that were `prefetched`, if any.
    ///
    /// The checksum of a complete chunk is checked before its first record. Of a truncated chunk the records
    /// before the end of the file are read; its truncation is not an error here.
    ///
    /// # Errors
    /// [`BagError::Io`]; [`BagError::Corrupt`] when the block is damaged, or when `on_record` returns the
    /// reason why it rejects a record.
    pub(crate) fn read(
        &self,
        path: &Path,
        file: &File,
        prefetched: Option<Prefetched>,
        on_record: impl FnMut(u64, Record<'_>) -> Result<(), String>,
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
        let bytes = match prefetched {
            Some(bytes) => bytes.wait(),
            None => file.read(self.position, self.length),
        };
        let bytes = bytes.map_err(|error| read_error(path, self.position, error))?;
        let outcome = match self.kind {
            BlockKind::Unchunked => read_records(&bytes, ALL, on_record),
            BlockKind::Chunk => read_chunk(&bytes, on_record),
            BlockKind::TruncatedChunk => {
                return read_truncated_chunk(bytes, on_record).map_err(corrupt);
            }
        };
        outcome.map_err(|fault| corrupt(fault.found_and_expected()))
    }
}

/// Why the bytes from `position` on could not be read: [`BagError::Corrupt`] when it is the disk, [`BagError::Io`] for other
/// errors.
pub(super) fn read_error(path: &Path, position: u64, error: io::Error) -> BagError {
    if BagError::is_unreadable(&error) {
        let (found, expected) = (unreadable(&error), "readable bytes".into());
        BagError::Corrupt { path: path.into(), position, found, expected }
    } else {
        BagError::io(path, "reading")(error)
    }
}

/// Describes bytes that the disk cannot read, for error messages.
pub(super) fn unreadable(error: &io::Error) -> String {
    format!("bytes that the disk cannot read ({error})")
}

/// Largest expansion of a byte: zstd fills a block of 128 KiB from four bytes, a byte in LZ4 adds 255 to a
/// length. Checked because memory for the declared size is allocated before a chunk is decompressed.
const ZSTD_EXPANSION: u64 = 1 << 15;
const LZ4_EXPANSION: u64 = 1 << 8;

/// Largest content of `compressed` bytes of a chunk (bytes).
fn largest_content(header: &ChunkHeader, compressed: u64) -> u64 {
    let factor = if header.compression == "lz4" { LZ4_EXPANSION } else { ZSTD_EXPANSION };
    compressed.saturating_mul(factor)
}

/// Checks the declared size of a chunk's content against its compressed size (bytes).
fn check_declared_size(header: &ChunkHeader, compressed: u64) -> Result<(), Fault> {
    let uncompressed = header.uncompressed;
    if uncompressed > largest_content(header, compressed) {
        return Err(Fault::DeclaredSize { compressed, uncompressed });
    }
    Ok(())
}

/// Why the records of a block cannot all be read.
enum Fault {
    /// The bytes are not records, or do not match their checksum.
    Mcap(McapError),
    /// A record is rejected.
    Record(String),
    /// The compression cannot achieve the declared sizes (bytes).
    DeclaredSize { compressed: u64, uncompressed: u64 },
}

impl Fault {
    fn found_and_expected(self) -> (String, &'static str) {
        match self {
            Self::Record(found) => (found, "a record consistent with the records before it"),
            Self::DeclaredSize { compressed, uncompressed } => (
                format!(
                    "a chunk of {compressed} bytes that declares {uncompressed} bytes of content"
                ),
                "a size that its compression can achieve",
            ),
            Self::Mcap(McapError::BadChunkCrc { saved, calculated }) => (
                format!("checksum {calculated:08x} in a chunk with checksum {saved:08x}"),
                "equal checksums",
            ),
            Self::Mcap(McapError::UnsupportedCompression(name)) => {
                (format!("compression `{name}`"), "zstd, lz4 or none")
            }
            Self::Mcap(error) => (format!("unreadable bytes ({error})"), "complete MCAP records"),
        }
    }
}

impl From<McapError> for Fault {
    fn from(error: McapError) -> Self {
        Self::Mcap(error)
    }
}

/// For `until`: to the end.
const ALL: u64 = u64::MAX;

fn read_chunk(
    bytes: &[u8],
    on_record: impl FnMut(u64, Record<'_>) -> Result<(), String>,
) -> Result<(), Fault> {
    match bytes.get(HEADER_SIZE as usize..).and_then(ChunkHeader::parse) {
        // In place, without the copies that mcap's reader makes.
        Some(header) if header.compression.is_empty() => {
            let records = bytes.get(HEADER_SIZE as usize + header.records..).unwrap_or_default();
            let (saved, calculated) = (header.crc, crc32fast::hash(records));
            if saved != 0 && saved != calculated {
                return Err(McapError::BadChunkCrc { saved, calculated }.into());
            }
            read_records(records, ALL, on_record)
        }
        Some(header) => {
            check_declared_size(&header, bytes.len() as u64)?;
            read_compressed(bytes, header.uncompressed, ALL, on_record)
        }
        None => read_compressed(bytes, 0, ALL, on_record),
    }
}

/// Calls `on_record` for the records in `bytes` that start before byte `until`, with all lengths checked.
fn read_records(
    bytes: &[u8],
    until: u64,
    mut on_record: impl FnMut(u64, Record<'_>) -> Result<(), String>,
) -> Result<(), Fault> {
    let mut left = bytes;
    while let Some((&opcode, rest)) = left.split_first() {
        let offset = (bytes.len() - left.len()) as u64;
        if offset >= until {
            break;
        }
        let (length, rest) = rest.split_first_chunk().ok_or(McapError::UnexpectedEof)?;
        let length = usize::try_from(u64::from_le_bytes(*length)).unwrap_or(usize::MAX);
        let (body, rest) = rest.split_at_checked(length).ok_or(McapError::UnexpectedEof)?;
        if let Some(record) = wanted_record(opcode, body)? {
            on_record(offset, record).map_err(Fault::Record)?;
        }
        left = rest;
    }
    Ok(())
}

fn read_truncated_chunk(
    mut bytes: Vec<u8>,
    mut on_record: impl FnMut(u64, Record<'_>) -> Result<(), String>,
) -> Result<(), (String, &'static str)> {
    let body = HEADER_SIZE as usize;
    let Some(header) = bytes.get(body..).and_then(ChunkHeader::parse) else { return Ok(()) };
    let records = body + header.records;
    if bytes.len() <= records {
        return Ok(());
    }
    let outcome = if header.compression.is_empty() {
        read_records(&bytes[records..], ALL, on_record)
    } else {
        // Its fields describe the complete chunk. Changed to the bytes that are left, and without a checksum,
        // it is read up to the end of the file.
        let (length, compressed) = ((bytes.len() - body) as u64, (bytes.len() - records) as u64);
        let uncompressed = header.uncompressed.min(largest_content(&header, compressed));
        bytes[1..body].copy_from_slice(&length.to_le_bytes());
        bytes[body + 16..body + 24].copy_from_slice(&uncompressed.to_le_bytes());
        bytes[body + 24..body + 28].fill(0);
        bytes[records - 8..records].copy_from_slice(&compressed.to_le_bytes());
        check_declared_size(&header, header.compressed)
            .and_then(|()| read_compressed(&bytes, uncompressed, ALL, &mut on_record))
    };
    match outcome {
        Err(fault @ (Fault::Record(_) | Fault::DeclaredSize { .. })) => {
            Err(fault.found_and_expected())
        }
        // A truncated chunk ends in a truncated record.
        Err(Fault::Mcap(_)) | Ok(()) => Ok(()),
    }
}

/// Runs mcap's reader over a chunk that declares `uncompressed` bytes of content, for the records that start before byte `until`
/// of the content. The reader allocates the declared length of a record, which is limited to that of the content. The checksum
/// is checked where the whole chunk is read.
fn read_compressed(
    bytes: &[u8],
    uncompressed: u64,
    until: u64,
    mut on_record: impl FnMut(u64, Record<'_>) -> Result<(), String>,
) -> Result<(), Fault> {
    let longest = uncompressed.max(bytes.len() as u64).min(SIZE_LIMIT);
    let mut reader = LinearReader::new_with_options(
        LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(until == ALL)
            .with_record_length_limit(longest as usize),
    );
    let (mut rest, mut offset) = (bytes, 0);
    while offset < until
        && let Some(event) = reader.next_event()
    {
        match event? {
            LinearReadEvent::ReadRequest(wanted) => {
                let (next, after) = rest.split_at(wanted.min(rest.len()));
                reader.insert(next.len()).copy_from_slice(next);
                reader.notify_read(next.len());
                rest = after;
            }
            LinearReadEvent::Record { opcode, data } => {
                if let Some(record) = wanted_record(opcode, data)? {
                    on_record(offset, record).map_err(Fault::Record)?;
                }
                offset += HEADER_SIZE + data.len() as u64;
            }
        }
    }
    Ok(())
}

/// Bytes of a chunk beyond the content that is wanted from its front: the fields before the content, and the rest of a block of
/// the compression.
const FRONT_RESERVE: u64 = 256 << 10;

/// Calls `on_record` for the schemas, channels and messages that start before byte `until` of the content of the chunk at byte
/// `position` of a file, without reading the rest of the chunk, of `length` bytes. `false` when they cannot be read, or a record is
/// rejected.
pub(super) fn read_front(
    file: &File,
    (position, length): (u64, u64),
    until: u64,
    mut on_record: impl FnMut(Record<'_>) -> Result<(), String>,
) -> io::Result<bool> {
    let wanted = length.min(until.saturating_add(FRONT_RESERVE)).min(SIZE_LIMIT);
    let bytes = file.read(position, wanted)?;
    let Some(header) = bytes.get(HEADER_SIZE as usize..).and_then(ChunkHeader::parse) else {
        return Ok(false);
    };
    let on_record = |_, record: Record<'_>| on_record(record);
    let outcome = if header.compression.is_empty() {
        let records = bytes.get(HEADER_SIZE as usize + header.records..).unwrap_or_default();
        read_records(records, until, on_record)
    } else {
        let content = header.uncompressed;
        check_declared_size(&header, header.compressed)
            .and_then(|()| read_compressed(&bytes, content, until, on_record))
    };
    Ok(outcome.is_ok())
}

/// Parses a schema, channel or message; `None` for other records.
pub(super) fn wanted_record(opcode: u8, body: &[u8]) -> McapResult<Option<Record<'_>>> {
    match opcode {
        op::SCHEMA | op::CHANNEL | op::MESSAGE => parse::record(opcode, body).map(Some),
        _ => Ok(None),
    }
}

/// Describes a record for error messages: `a chunk of 12 bytes`.
pub(super) fn describe(header: &RecordHeader) -> String {
    format!("a {} of {} bytes", records::name(header.opcode), header.length)
}

/// Describes a message that no channel was declared for, for error messages.
pub(super) fn unknown_channel(channel: u16) -> String {
    format!("a message of channel {channel}, which is not declared")
}
