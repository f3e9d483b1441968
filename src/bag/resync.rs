//! Where a damaged file can be read on: at the next chunk that is there whole.

use std::io;

use mcap::records::op;

use super::record::{ChunkHeader, HEADER_SIZE, Records, SIZE_LIMIT};

/// How much of the file is looked at at once (bytes).
const BLOCK: u64 = 1 << 20;
/// The most that is needed to tell a chunk: its record's header, and its own with the longest name.
const TELLING: u64 = HEADER_SIZE + 40 + 64;

impl Records {
    /// Goes to the first whole chunk that starts at `from` or after it. `false` when there is none.
    ///
    /// Bytes are taken for a chunk when they name a known compression and when its three lengths agree:
    /// that of the record, that of its header, and that of its data.
    pub(super) fn go_to_chunk(&mut self, from: u64) -> io::Result<bool> {
        let mut start = from;
        while start < self.size {
            let mut block = vec![0; (self.size - start).min(BLOCK + TELLING) as usize];
            self.read_at(start, &mut block)?;
            let candidates = block.len().min(BLOCK as usize);
            let found =
                (0..candidates).find(|&at| is_chunk(&block[at..], self.size - start - at as u64));
            if let Some(at) = found {
                self.position = start + at as u64;
                return Ok(true);
            }
            start += BLOCK;
        }
        Ok(false)
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
        known && header.compressed.checked_add(header.records as u64) == Some(length)
    };
    fits && ChunkHeader::parse(body).is_some_and(agrees)
}
