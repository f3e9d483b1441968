//! Walks through a whole file to index it: for files without a summary, and to see how a file ends.

use std::collections::BTreeMap;

use mcap::{
    MAGIC, parse_record,
    records::{ChunkIndex, Record, op},
};

use super::{
    error::BagError,
    index::{Builder, Damage, FileIndex},
    layout,
    record::{RecordHeader, Records, SIZE_LIMIT, Step},
    segment::{Kind, Segment, described, wanted_record},
};

/// No record has this opcode: bytes that were never written, most likely.
const NO_RECORD: u8 = 0;

/// A run of messages outside chunks ends at this size (bytes), so that reading stays bounded.
const LOOSE_RUN: u64 = 1 << 20;

impl Builder {
    /// Reads the whole file once. Chunks are opened to see what is in them.
    pub(super) fn by_walking(mut self, mut records: Records) -> Result<FileIndex, BagError> {
        let failed = BagError::io(self.index.path.clone(), "reading");
        let ended = self.walk(&mut records);
        match ended {
            Ok(None) => {}
            Ok(Some(expected)) => {
                let (size, messages) = (self.index.size, self.index.messages());
                let truncated = Damage::Truncated { size, messages, expected };
                self.index.damage.get_or_insert(truncated);
            }
            Err(WalkError::Io(error)) => return Err(failed(error)),
            Err(WalkError::Bag(error)) => return Err(error),
        }
        Ok(self.index)
    }

    /// Walks to the end. Gives what should have come when the file ends too early.
    fn walk(&mut self, records: &mut Records) -> Result<Option<String>, WalkError> {
        if self.index.size < MAGIC.len() as u64 {
            return Ok(Some("the rest of the 8 bytes that start an MCAP file".into()));
        }
        let mut in_summary = false;
        loop {
            let header = match records.step()? {
                Step::Record(header) => header,
                Step::CutBody(header) if !in_summary && self.reads_on(&header, records)? => {
                    continue;
                }
                Step::CutBody(header) => {
                    if header.opcode == op::CHUNK {
                        self.chunk(&header, Kind::CutChunk, records)?;
                    }
                    let start = header.position;
                    return Ok(Some(format!("{} from byte {start}", described(&header))));
                }
                Step::CutHeader => return Ok(Some("a record's header of 9 bytes".into())),
                // What is still being written ends after any whole record.
                Step::End if !in_summary && layout::is_active(&self.index.path) => return Ok(None),
                Step::End => return Ok(Some("the data end record and the footer".into())),
            };
            match header.opcode {
                NO_RECORD if !in_summary => {
                    if self.reads_on(&header, records)? {
                        continue;
                    }
                    return Ok(Some(format!("a record from byte {}", header.position)));
                }
                op::FOOTER => {
                    let rest = self.index.size - header.end();
                    let expected = "the 8 bytes that end an MCAP file";
                    return Ok((rest < MAGIC.len() as u64).then(|| expected.into()));
                }
                op::DATA_END => in_summary = true,
                _ if in_summary => {}
                op::CHUNK => self.chunk(&header, Kind::Chunk, records)?,
                op::MESSAGE_INDEX => self.message_index(&header, records)?,
                op::SCHEMA | op::CHANNEL | op::MESSAGE => self.loose(&header, records)?,
                op::ATTACHMENT => self.index.extras.0 += 1,
                op::METADATA => self.index.extras.1 += 1,
                _ => {}
            }
            if !in_summary {
                self.index.data_end = header.end();
            }
        }
    }

    /// Looks for a chunk after a record that cannot be one, and goes on there.
    fn reads_on(
        &mut self,
        header: &RecordHeader,
        records: &mut Records,
    ) -> Result<bool, WalkError> {
        let found = records.go_to_chunk(header.position + 1)?;
        if found {
            let (found, expected) = (described(header), "a record within the file".into());
            let damage = Damage::Corrupt { position: header.position, found, expected };
            self.index.damage.get_or_insert(damage);
        }
        Ok(found)
    }

    fn chunk(
        &mut self,
        header: &RecordHeader,
        kind: Kind,
        records: &mut Records,
    ) -> Result<(), WalkError> {
        let stated = records.chunk_header(header)?;
        if let Some(stated) = &stated {
            self.index.compressions.insert(stated.compression.clone());
        }
        let end = header.end().min(self.index.size);
        let segment = Segment {
            file: self.number,
            position: header.position,
            length: end - header.position,
            kind,
            first: 0,
            last: 0,
        };
        let path = self.index.path.clone();
        let (mut counts, mut times) = (BTreeMap::new(), None);
        let outcome = segment.read(&path, |record| match record {
            Record::Message { header, .. } => {
                if !self.index.channels.contains_key(&header.channel_id) {
                    return Err(unknown_channel(header.channel_id));
                }
                *counts.entry(header.channel_id).or_insert(0) += 1;
                times = Some(widened(times, header.log_time));
                Ok(())
            }
            other => self.declare(&other),
        });
        match outcome {
            Ok(()) => {}
            Err(BagError::Corrupt { position, found, expected, .. }) => {
                // The chunks after it may be whole: go on, and remember the first fault.
                self.index.damage.get_or_insert(Damage::Corrupt { position, found, expected });
                return Ok(());
            }
            Err(error) => return Err(error.into()),
        }
        if let Some(stated) = stated.filter(|_| kind == Kind::Chunk) {
            let (message_start_time, message_end_time) = times.unwrap_or_default();
            self.index.chunks.push(ChunkIndex {
                message_start_time,
                message_end_time,
                chunk_start_offset: header.position,
                chunk_length: segment.length,
                message_index_offsets: BTreeMap::new(),
                message_index_length: 0,
                compressed_size: header.length.saturating_sub(stated.records as u64),
                uncompressed_size: stated.uncompressed,
                compression: stated.compression,
            });
        }
        if let Some((first, last)) = times {
            self.index.segments.push(Segment { first, last, ..segment });
            self.count(counts, (first, last));
        }
        Ok(())
    }

    /// Notes where the chunk before it keeps the index of one of its channels.
    fn message_index(
        &mut self,
        header: &RecordHeader,
        records: &mut Records,
    ) -> Result<(), WalkError> {
        let Some(chunk) = self.index.chunks.last_mut() else { return Ok(()) };
        let indexed = chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length;
        if header.position != indexed || header.length > SIZE_LIMIT {
            return Ok(());
        }
        let body = records.read(header)?;
        if let Ok(Record::MessageIndex(index)) = parse_record(header.opcode, &body) {
            chunk.message_index_offsets.insert(index.channel_id, header.position);
            chunk.message_index_length += header.end() - header.position;
        }
        Ok(())
    }

    fn loose(&mut self, header: &RecordHeader, records: &mut Records) -> Result<(), WalkError> {
        if header.length > SIZE_LIMIT {
            let found = described(header);
            let expected = "at most 1 GiB".into();
            let damage = Damage::Corrupt { position: header.position, found, expected };
            self.index.damage.get_or_insert(damage);
            return Ok(());
        }
        let body = records.read(header)?;
        let parsed = wanted_record(header.opcode, &body).map_err(|error| error.to_string());
        let outcome = match parsed {
            Ok(Some(Record::Message { header: message, .. })) => {
                if self.index.channels.contains_key(&message.channel_id) {
                    self.loose_message(header, message.log_time);
                    self.count(
                        BTreeMap::from([(message.channel_id, 1)]),
                        (message.log_time, message.log_time),
                    );
                    Ok(())
                } else {
                    Err(unknown_channel(message.channel_id))
                }
            }
            Ok(Some(other)) => self.declare(&other),
            Ok(None) => Ok(()),
            Err(reason) => Err(reason),
        };
        if let Err(found) = outcome {
            let expected = "a record that fits those before it".into();
            let damage = Damage::Corrupt { position: header.position, found, expected };
            self.index.damage.get_or_insert(damage);
        }
        Ok(())
    }

    /// Adds a message outside chunks to the run before it, if it follows it without a gap.
    fn loose_message(&mut self, header: &RecordHeader, time: u64) {
        let length = header.end() - header.position;
        if let Some(run) = self.index.segments.last_mut()
            && run.kind == Kind::Loose
            && run.position + run.length == header.position
            && run.length < LOOSE_RUN
        {
            run.length += length;
            (run.first, run.last) = widened(Some((run.first, run.last)), time);
            return;
        }
        self.index.segments.push(Segment {
            file: self.number,
            position: header.position,
            length,
            kind: Kind::Loose,
            first: time,
            last: time,
        });
    }

    fn count(&mut self, counts: BTreeMap<u16, u64>, (first, last): (u64, u64)) {
        for (channel, messages) in counts {
            *self.index.counts.entry(channel).or_insert(0) += messages;
        }
        let times = widened(self.index.times, first);
        self.index.times = Some(widened(Some(times), last));
    }
}

/// Why a walk had to stop.
enum WalkError {
    Io(std::io::Error),
    Bag(BagError),
}

impl From<std::io::Error> for WalkError {
    fn from(error: std::io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<BagError> for WalkError {
    fn from(error: BagError) -> Self {
        Self::Bag(error)
    }
}

pub(super) fn unknown_channel(channel: u16) -> String {
    format!("a message of channel {channel}, which is unknown")
}

fn widened(times: Option<(u64, u64)>, time: u64) -> (u64, u64) {
    times.map_or((time, time), |(first, last)| (first.min(time), last.max(time)))
}
