//! Finds where reading a damaged file can continue: at the next complete chunk or message.

use std::{collections::BTreeMap, io, sync::Arc};

use mcap::records::op;

use super::records::{ChunkHeader, HEADER_SIZE, NO_RECORD, Records, SIZE_LIMIT};
use crate::{error::BagError, format::channel::Channel};

/// Bytes that are searched at a time.
const BLOCK: u64 = 1 << 20;
/// Bytes needed to recognise a chunk: the record header and the chunk fields with the longest name.
const LOOKAHEAD: u64 = HEADER_SIZE + 40 + 64;
/// Bytes that a disk reads or fails to read together.
const SECTOR: u64 = 4096;
/// Body of a message before its data: channel, number, two times (bytes).
const MESSAGE_FIXED: u64 = 2 + 4 + 8 + 8;
/// Opcodes of the MCAP specification; from [`PRIVATE`] on they are application-specific.
const SPECIFIED: std::ops::RangeInclusive<u8> = op::HEADER..=op::DATA_END;
const PRIVATE: u8 = 0x80;

impl Records {
    /// Whether a record may start at `position`, or the file ends there.
    pub(super) fn may_continue_at(&mut self, position: u64) -> io::Result<bool> {
        let Some(left) = self.size.checked_sub(position) else { return Ok(false) };
        if left < HEADER_SIZE {
            return Ok(true);
        }
        let mut header = [0; HEADER_SIZE as usize];
        match self.read_at(position, &mut header) {
            Err(error) if BagError::is_unreadable(&error) => return Ok(true),
            read => read?,
        }
        let [opcode, length @ ..] = header;
        let length = u64::from_le_bytes(length);
        let fits = length <= left - HEADER_SIZE;
        Ok(match opcode {
            NO_RECORD => length == 0,
            // The file may be truncated in it.
            opcode if SPECIFIED.contains(&opcode) => fits || length <= SIZE_LIMIT,
            opcode => fits && opcode >= PRIVATE,
        })
    }

    /// Moves to the first complete chunk that starts at or after byte `from`; `false` when there is none.
    ///
    /// A chunk is recognised by a known compression and by lengths that agree: the record's, and the sum
    /// of the chunk's own fields.
    pub(super) fn seek_chunk(&mut self, from: u64) -> io::Result<bool> {
        if self.absent.chunks {
            return Ok(false);
        }
        let found = self.seek(from, |_, bytes, left| Ok(is_chunk(bytes, left)))?;
        self.absent.chunks = !found;
        Ok(found)
    }

    /// Moves to the first complete chunk, or message of a known channel, that starts at or after byte
    /// `from`; `false` when there is none.
    pub(super) fn seek_message(
        &mut self,
        from: u64,
        channels: &BTreeMap<u16, Arc<Channel>>,
    ) -> io::Result<bool> {
        if self.absent.messages {
            return Ok(false);
        }
        let found = self.seek(from, |records, bytes, left| {
            if is_chunk(bytes, left) {
                return Ok(true);
            }
            match message_length(bytes, left, channels) {
                Some(length) => records.may_continue_at(records.size - left + length),
                None => Ok(false),
            }
        })?;
        self.absent.messages = !found;
        self.absent.chunks |= !found;
        Ok(found)
    }

    fn seek(
        &mut self,
        from: u64,
        mut starts: impl FnMut(&mut Self, &[u8], u64) -> io::Result<bool>,
    ) -> io::Result<bool> {
        let mut start = from;
        while start < self.size {
            let block = self.block(start)?;
            for at in 0..block.len().min(BLOCK as usize) {
                if starts(self, &block[at..], self.size - start - at as u64)? {
                    self.position = start + at as u64;
                    return Ok(true);
                }
            }
            start += BLOCK;
        }
        Ok(false)
    }

    /// Reads a block; zeros where the disk cannot read.
    fn block(&mut self, start: u64) -> io::Result<Vec<u8>> {
        let mut block = vec![0; (self.size - start).min(BLOCK + LOOKAHEAD) as usize];
        match self.read_at(start, &mut block) {
            Err(error) if BagError::is_unreadable(&error) => {}
            read => return read.map(|()| block),
        }
        let mut at = 0;
        while at < block.len() {
            let in_sector = SECTOR - (start + at as u64) % SECTOR;
            let end = block.len().min(at + in_sector as usize);
            match self.read_at(start + at as u64, &mut block[at..end]) {
                Err(error) if BagError::is_unreadable(&error) => block[at..end].fill(0),
                read => read?,
            }
            at = end;
        }
        Ok(block)
    }
}

/// Whether `bytes` start with a chunk that ends within the `left` bytes of the file.
fn is_chunk(bytes: &[u8], left: u64) -> bool {
    let Some((&op::CHUNK, rest)) = bytes.split_first() else { return false };
    let Some((length, body)) = rest.split_first_chunk() else { return false };
    let length = u64::from_le_bytes(*length);
    let fits = length <= SIZE_LIMIT && length <= left.saturating_sub(HEADER_SIZE);
    let agrees = |header: ChunkHeader| {
        let known = matches!(header.compression.as_str(), "" | "lz4" | "zstd");
        known && header.length() == Some(length)
    };
    fits && ChunkHeader::parse(body).is_some_and(agrees)
}

/// Length of the record (bytes) if `bytes` start with a message of a known channel that ends within the
/// `left` bytes of the file.
fn message_length(bytes: &[u8], left: u64, channels: &BTreeMap<u16, Arc<Channel>>) -> Option<u64> {
    let (&op::MESSAGE, rest) = bytes.split_first()? else { return None };
    let (length, body) = rest.split_first_chunk()?;
    let length = u64::from_le_bytes(*length);
    let (channel, _) = body.split_first_chunk()?;
    let fits = (MESSAGE_FIXED..=SIZE_LIMIT.min(left - HEADER_SIZE)).contains(&length);
    let known = channels.contains_key(&u16::from_le_bytes(*channel));
    (fits && known).then_some(HEADER_SIZE + length)
}
