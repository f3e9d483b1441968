//! Where a damaged file can be read on: at the next chunk or message that is there whole.

use std::{collections::BTreeMap, io, sync::Arc};

use mcap::records::op;

use super::{
    channel::Channel,
    error::BagError,
    record::{ChunkHeader, HEADER_SIZE, NO_RECORD, Records, SIZE_LIMIT},
};

/// How much of the file is looked at at once (bytes).
const BLOCK: u64 = 1 << 20;
/// The most that is needed to tell a chunk: its record's header, and its own with the longest name.
const TELLING: u64 = HEADER_SIZE + 40 + 64;
/// What a disk reads or refuses as a whole (bytes).
const SECTOR: u64 = 4096;
/// Body of a message before its data: channel, number, two times (bytes).
const MESSAGE_FIXED: u64 = 2 + 4 + 8 + 8;
/// Opcodes of the MCAP specification; above [`PRIVATE`] are those of applications.
const SPECIFIED: std::ops::RangeInclusive<u8> = op::HEADER..=op::DATA_END;
const PRIVATE: u8 = 0x80;

/// What was looked for up to the end of the file, and is not there.
#[derive(Default)]
pub(super) struct Searched {
    chunks: bool,
    messages: bool,
}

impl Records {
    /// Whether a record may start there, or the file ends there.
    pub(super) fn goes_on_at(&mut self, position: u64) -> io::Result<bool> {
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
            // The file may end in it.
            opcode if SPECIFIED.contains(&opcode) => fits || length <= SIZE_LIMIT,
            opcode => fits && opcode >= PRIVATE,
        })
    }

    /// Goes to the first whole chunk that starts at `from` or after it. `false` when there is none.
    ///
    /// Bytes are taken for a chunk when they name a known compression and when its three lengths agree:
    /// that of the record, that of its header, and that of its data.
    pub(super) fn go_to_chunk(&mut self, from: u64) -> io::Result<bool> {
        // What one search did not find the next one, which starts behind it, need not look for.
        if self.searched.chunks {
            return Ok(false);
        }
        let found = self.go_to(from, |_, bytes, left| Ok(is_chunk(bytes, left)))?;
        self.searched.chunks = !found;
        Ok(found)
    }

    /// Goes to the first whole chunk, or message of a known channel, that starts at `from` or after it.
    /// `false` when there is none.
    pub(super) fn go_to_message(
        &mut self,
        from: u64,
        channels: &BTreeMap<u16, Arc<Channel>>,
    ) -> io::Result<bool> {
        if self.searched.messages {
            return Ok(false);
        }
        let found = self.go_to(from, |records, bytes, left| {
            if is_chunk(bytes, left) {
                return Ok(true);
            }
            match message_length(bytes, left, channels) {
                Some(length) => records.goes_on_at(records.size - left + length),
                None => Ok(false),
            }
        })?;
        self.searched.messages = !found;
        self.searched.chunks |= !found;
        Ok(found)
    }

    fn go_to(
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

    /// What the file has there; zeros where the disk cannot read.
    fn block(&mut self, start: u64) -> io::Result<Vec<u8>> {
        let mut block = vec![0; (self.size - start).min(BLOCK + TELLING) as usize];
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

/// Whether a chunk starts here that ends within the `left` bytes of the file.
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

/// How long the record is if a message of a known channel starts here that ends within the `left` bytes
/// of the file (bytes).
fn message_length(bytes: &[u8], left: u64, channels: &BTreeMap<u16, Arc<Channel>>) -> Option<u64> {
    let (&op::MESSAGE, rest) = bytes.split_first()? else { return None };
    let (length, body) = rest.split_first_chunk()?;
    let length = u64::from_le_bytes(*length);
    let (channel, _) = body.split_first_chunk()?;
    let fits = (MESSAGE_FIXED..=SIZE_LIMIT.min(left - HEADER_SIZE)).contains(&length);
    let known = channels.contains_key(&u16::from_le_bytes(*channel));
    (fits && known).then_some(HEADER_SIZE + length)
}
