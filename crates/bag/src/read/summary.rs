//! Reads the index of a file from its summary section.

use std::{io, sync::Arc};

use mcap::{
    MAGIC,
    records::{ChunkIndex, Record, Statistics, op},
};

use super::{
    block::{Block, BlockKind},
    index::{ChannelKey, FileIndex},
    records::{RecordHeader, Records, SIZE_LIMIT, Step, compression},
};
use crate::format::parse;

impl FileIndex {
    /// Reads the summary section at byte `start`; `false` when it is incomplete or contradicts itself or the
    /// file. Statistics and chunk indexes are optional in MCAP, and messages may be outside chunks.
    pub(super) fn read_summary(&mut self, records: &mut Records, start: u64) -> io::Result<bool> {
        let (mut statistics, mut chunks) = (None, Vec::new());
        while let Step::Record(header) = records.step()? {
            if header.opcode == op::FOOTER {
                break;
            }
            if !matches!(header.opcode, op::SCHEMA | op::CHANNEL | op::STATISTICS | op::CHUNK_INDEX)
                || header.length > SIZE_LIMIT
            {
                continue;
            }
            let body = records.read(&header)?;
            match parse::record(header.opcode, &body) {
                Ok(Record::Statistics(found)) => statistics = Some(found),
                Ok(Record::ChunkIndex(chunk)) => chunks.push(chunk),
                // An id with two contents: the data section tells which messages are whose.
                Ok(record) if matches!(self.declared.declare(&record), Ok(None)) => {}
                _ => return Ok(false),
            }
        }
        let channels = self.declared.channels.iter();
        self.channels = channels.map(|(&id, of)| (id.into(), Arc::clone(of))).collect();
        chunks.sort_by_key(|chunk: &ChunkIndex| chunk.chunk_start_offset);
        let Some(auxiliary) = between_chunks(&chunks, records, start)? else { return Ok(false) };
        self.auxiliary = auxiliary;
        let Some(statistics) = statistics else { return Ok(false) };
        Ok(self.add_chunks(&statistics, &chunks)
            && self.is_confirmed(&statistics, &chunks, records)?)
    }

    /// Adds the chunks; `false` when statistics and chunk indexes disagree.
    fn add_chunks(&mut self, statistics: &Statistics, chunks: &[ChunkIndex]) -> bool {
        let counts = &statistics.channel_message_counts;
        let complete = chunks.len() == statistics.chunk_count as usize
            && self.channels.len() == statistics.channel_count as usize
            && counts.keys().all(|channel| self.declared.channels.contains_key(channel))
            && counts.values().sum::<u64>() == statistics.message_count
            && (!chunks.is_empty() || statistics.message_count == 0);
        if !complete {
            return false;
        }
        for chunk in chunks {
            let (position, length) = (chunk.chunk_start_offset, chunk.chunk_length);
            if position.checked_add(length).is_none_or(|end| end > self.size) {
                return false;
            }
            self.compressions.insert(compression(&chunk.compression).to_owned());
            self.blocks.push(Block {
                file: self.number,
                position,
                length,
                kind: BlockKind::Chunk,
                first: chunk.message_start_time,
                last: chunk.message_end_time,
                switches: Vec::new(),
                channels: channels_of(chunk),
            });
        }
        self.declared_messages = Some(statistics.message_count);
        self.counts = counts.iter().map(|(&id, &messages)| (id.into(), messages)).collect();
        self.times = (statistics.message_count > 0)
            .then_some((statistics.message_start_time, statistics.message_end_time));
        self.summarized = true;
        true
    }
}

/// The channels that have a message index behind the chunk; `None` for writers that write none.
fn channels_of(chunk: &ChunkIndex) -> Option<Box<[ChannelKey]>> {
    let offsets = &chunk.message_index_offsets;
    (!offsets.is_empty()).then(|| offsets.keys().map(|&id| id.into()).collect())
}

/// The attachments and metadata records between the chunks. `None` when there are messages outside chunks, or
/// when the chunk indexes do not describe the file.
fn between_chunks(
    chunks: &[ChunkIndex],
    records: &mut Records,
    summary_start: u64,
) -> io::Result<Option<Vec<RecordHeader>>> {
    let mut auxiliary = Vec::new();
    records.position = MAGIC.len() as u64;
    let ends = chunks.iter().map(|chunk| {
        let ChunkIndex { chunk_length, message_index_length, .. } = chunk;
        let end = chunk.chunk_start_offset.checked_add(*chunk_length);
        (chunk.chunk_start_offset, end.and_then(|end| end.checked_add(*message_index_length)))
    });
    for (start, end) in ends.chain([(summary_start, Some(summary_start))]) {
        while records.position < start {
            let Step::Record(header) = records.step()? else { return Ok(None) };
            match header.opcode {
                op::ATTACHMENT | op::METADATA => auxiliary.push(header),
                0 | op::CHUNK | op::MESSAGE => return Ok(None),
                _ => {}
            }
        }
        match end {
            Some(end) if records.position == start => records.position = end,
            _ => return Ok(None),
        }
    }
    Ok(Some(auxiliary))
}
