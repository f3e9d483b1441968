//! Confirms what a summary section says of the messages, without reading them.
//!
//! A reader that believes wrong times of a chunk leaves out its messages without a word. The message indexes behind the chunks
//! state the time of each message once more; they are a small part of a file. Where the two disagree, or there are no message
//! indexes, the file is scanned.

use std::{
    collections::{BTreeMap, VecDeque},
    io,
};

use eddy_storage::Prefetched;
use mcap::records::{ChunkIndex, Record, Statistics, op};

use super::{
    block::read_front,
    index::{FileIndex, Times, widen},
    records::{HEADER_SIZE, Records, SIZE_LIMIT},
};

/// Message indexes of a bag in a store that are fetched at the same time.
const PREFETCHED: usize = 32;

/// What the message indexes of a chunk say.
#[derive(Default)]
struct Indexed {
    /// Messages of each channel.
    counts: BTreeMap<u16, u64>,
    /// `None` without messages.
    times: Option<Times>,
    /// Place of the first message in the decompressed chunk (bytes).
    first: Option<u64>,
}

impl FileIndex {
    /// Whether message indexes, chunk indexes and statistics agree, and the schemas and channels at the front of the chunks are
    /// those of the summary section.
    pub(super) fn is_confirmed(
        &self,
        statistics: &Statistics,
        chunks: &[ChunkIndex],
        records: &mut Records,
    ) -> io::Result<bool> {
        let (mut counts, mut times) = (BTreeMap::new(), None);
        let mut fetched: VecDeque<Option<Prefetched>> = VecDeque::new();
        let mut fetching = chunks.iter();
        for chunk in chunks {
            fetched.extend(
                fetching.by_ref().take(PREFETCHED - fetched.len()).map(|chunk| {
                    self.file.prefetch(index_start(chunk), chunk.message_index_length)
                }),
            );
            if chunk.message_index_length > SIZE_LIMIT {
                return Ok(false);
            }
            let bytes = match fetched.pop_front().flatten() {
                Some(bytes) => bytes.wait()?,
                None => {
                    let mut bytes = vec![0; chunk.message_index_length as usize];
                    records.read_at(index_start(chunk), &mut bytes)?;
                    bytes
                }
            };
            let Some(indexed) = Indexed::parse(&bytes) else { return Ok(false) };
            let stated = (chunk.message_start_time, chunk.message_end_time);
            if indexed.times.is_some_and(|times| times != stated) {
                return Ok(false);
            }
            let is_listed = |id| chunk.message_index_offsets.contains_key(id);
            if !indexed.counts.keys().all(is_listed) {
                return Ok(false);
            }
            times = indexed.times.map_or(times, |of_chunk| Some(widen(times, of_chunk)));
            for (channel, messages) in indexed.counts {
                *counts.entry(channel).or_insert(0) += messages;
            }
            if let Some(first) = indexed.first.filter(|first| *first > 0) {
                let place = (chunk.chunk_start_offset, chunk.chunk_length);
                let known = |record: Record<'_>| self.declared.check(&record);
                if !read_front(&self.file, place, first, known)? {
                    return Ok(false);
                }
            }
        }
        let stated =
            statistics.channel_message_counts.iter().filter(|(_, messages)| **messages > 0);
        let of_statistics = (statistics.message_start_time, statistics.message_end_time);
        Ok(counts.iter().eq(stated) && times.is_none_or(|times| times == of_statistics))
    }
}

fn index_start(chunk: &ChunkIndex) -> u64 {
    chunk.chunk_start_offset.saturating_add(chunk.chunk_length)
}

impl Indexed {
    /// Parses the message indexes of a chunk; `None` where they are something else.
    fn parse(mut bytes: &[u8]) -> Option<Self> {
        let mut indexed = Self::default();
        while !bytes.is_empty() {
            let (header, rest) = bytes.split_first_chunk::<{ HEADER_SIZE as usize }>()?;
            let [opcode, length @ ..] = *header;
            let length = usize::try_from(u64::from_le_bytes(length)).ok()?;
            let (body, rest) = rest.split_at_checked(length)?;
            bytes = rest;
            if opcode != op::MESSAGE_INDEX {
                return None;
            }
            let (channel, body) = body.split_first_chunk()?;
            let (length, entries) = body.split_first_chunk()?;
            let (entries, rest) = entries.as_chunks::<16>();
            if entries.len() * 16 != u32::from_le_bytes(*length) as usize || !rest.is_empty() {
                return None;
            }
            let messages = indexed.counts.entry(u16::from_le_bytes(*channel)).or_insert(0);
            *messages += entries.len() as u64;
            for entry in entries {
                let (time, offset) = (entry.first_chunk()?, entry.last_chunk()?);
                let (time, offset) = (u64::from_le_bytes(*time), u64::from_le_bytes(*offset));
                indexed.times = Some(widen(indexed.times, (time, time)));
                indexed.first = Some(indexed.first.map_or(offset, |first| first.min(offset)));
            }
        }
        indexed.counts.retain(|_, messages| *messages > 0);
        Some(indexed)
    }
}
