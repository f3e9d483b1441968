//! Walks through a whole file to index it: for files without a summary, and to see how a file ends.

use std::collections::BTreeMap;

use mcap::{
    MAGIC,
    records::{ChunkIndex, Record, op},
};

use super::{
    error::BagError,
    index::{Builder, Damage, FileIndex, Piece, WATCHED, Watch, widened},
    layout, parse,
    record::{NO_RECORD, RecordHeader, Records, SIZE_LIMIT, Step},
    segment::{Kind, Segment, described, unreadable, wanted_record},
};

/// Length of a data end record (bytes): a checksum.
const DATA_END_LENGTH: u64 = 4;

/// A run of messages outside chunks ends at this size (bytes), so that reading stays bounded.
const LOOSE_RUN: u64 = 1 << 20;

impl Builder {
    /// Reads the whole file once. Chunks are opened to see what is in them.
    pub(super) fn by_walking(
        mut self,
        mut records: Records,
        watch: &mut Watch<'_>,
    ) -> Result<FileIndex, BagError> {
        let failed = BagError::io(self.index.path.clone(), "reading");
        let mut watched = 0;
        let ended = self.walk(&mut records, watch, &mut watched);
        match ended {
            Ok(None) => {}
            Ok(Some(expected)) => {
                let (size, messages) = (self.index.size, self.index.messages());
                self.index.damage.add(Damage::Truncated { size, messages, expected });
            }
            Err(WalkError::Io(error)) => return Err(failed(error)),
            Err(WalkError::Bag(error)) => return Err(error),
        }
        if !watch(self.index.size.saturating_sub(watched)) {
            return Err(BagError::Interrupted { path: self.index.path });
        }
        Ok(self.index)
    }

    /// Walks to the end; who watches knows of the first `watched` bytes. Gives what should have come when the
    /// file ends too early.
    fn walk(
        &mut self,
        records: &mut Records,
        watch: &mut Watch<'_>,
        watched: &mut u64,
    ) -> Result<Option<String>, WalkError> {
        if self.index.size < MAGIC.len() as u64 {
            return Ok(Some("the rest of the 8 bytes that start an MCAP file".into()));
        }
        let mut in_summary = false;
        loop {
            let passed = records.position - *watched;
            if passed >= WATCHED {
                *watched = records.position;
                if !watch(passed) {
                    let path = self.index.path.clone();
                    return Err(WalkError::Bag(BagError::Interrupted { path }));
                }
            }
            let header = match records.step() {
                Ok(Step::Record(header) | Step::CutBody(header)) if !in_summary => {
                    match self.settled(header, records)? {
                        Some(header) => header,
                        None => continue,
                    }
                }
                Ok(Step::Record(header) | Step::CutBody(header)) => header,
                Ok(Step::CutHeader) => return Ok(Some("a record's header of 9 bytes".into())),
                // What is still being written ends after any whole record.
                Ok(Step::End) if !in_summary && layout::is_active(&self.index.path) => {
                    return Ok(None);
                }
                Ok(Step::End) => return Ok(Some("the data end record and the footer".into())),
                Err(error) if BagError::is_unreadable(&error) => {
                    let position = records.position;
                    self.damaged(position, unreadable(&error), "a record".into());
                    if in_summary || !records.go_to_message(position + 1, &self.index.channels)? {
                        return Ok(Some(format!("a record from byte {position}")));
                    }
                    continue;
                }
                Err(error) => return Err(error.into()),
            };
            if header.end() > self.index.size {
                if header.opcode == op::CHUNK && !in_summary {
                    self.chunk(&header, Kind::CutChunk, records)?;
                }
                let start = header.position;
                return Ok(Some(format!("{} from byte {start}", described(&header))));
            }
            match header.opcode {
                NO_RECORD if !in_summary => {
                    return Ok(Some(format!("a record from byte {}", header.position)));
                }
                op::FOOTER => {
                    let rest = self.index.size - header.end();
                    if rest > MAGIC.len() as u64 {
                        // A wrong byte has made it a footer, and hides what follows.
                        let expected = "one at the end of the file".to_owned();
                        self.damaged(header.position, described(&header), expected);
                    }
                    let expected = "the 8 bytes that end an MCAP file";
                    return Ok((rest < MAGIC.len() as u64).then(|| expected.into()));
                }
                op::DATA_END => {
                    if header.length != DATA_END_LENGTH {
                        let expected = format!("{DATA_END_LENGTH} bytes");
                        self.damaged(header.position, described(&header), expected);
                    }
                    in_summary = true;
                }
                op::STATISTICS if in_summary => self.statistics(&header, records)?,
                _ if in_summary => {}
                op::CHUNK => self.chunk(&header, Kind::Chunk, records)?,
                op::MESSAGE_INDEX => self.message_index(&header, records)?,
                op::SCHEMA | op::CHANNEL | op::MESSAGE => self.loose(&header, records)?,
                op::ATTACHMENT | op::METADATA => self.index.extras.push(header),
                _ => {}
            }
            if !in_summary {
                self.index.data_end = header.end();
            }
        }
    }

    /// The record with the length that it has. Nothing follows where a damaged length says that the next
    /// one starts: then a chunk says its length once more; after other records the next chunk or message
    /// is looked for, and there is `None` when there is one.
    fn settled(
        &mut self,
        header: RecordHeader,
        records: &mut Records,
    ) -> Result<Option<RecordHeader>, WalkError> {
        if header.opcode == op::FOOTER {
            return Ok(Some(header));
        }
        if header.opcode == op::CHUNK
            && let Some(length) = records.chunk_header(&header)?.and_then(|chunk| chunk.length())
            && length != header.length
        {
            let restated = RecordHeader { length, ..header };
            if records.goes_on_at(restated.end())? {
                self.damaged(header.position, described(&header), format!("{length} bytes"));
                records.position = restated.end();
                return Ok(Some(restated));
            }
        }
        if header.opcode != NO_RECORD && records.goes_on_at(header.end())? {
            return Ok(Some(header));
        }
        let goes_on = match header.opcode {
            // Nothing vouches for the messages in a chunk but its checksum.
            op::CHUNK => records.go_to_chunk(header.position + 1)?,
            _ => records.go_to_message(header.position + 1, &self.index.channels)?,
        };
        if goes_on {
            let expected = "a record that another one follows".into();
            self.damaged(header.position, described(&header), expected);
        }
        Ok((!goes_on).then_some(header))
    }

    fn damaged(&mut self, position: u64, found: String, expected: String) {
        self.index.damage.add(Damage::Corrupt { position, found, expected });
    }

    fn statistics(
        &mut self,
        header: &RecordHeader,
        records: &mut Records,
    ) -> Result<(), WalkError> {
        if header.length <= SIZE_LIMIT
            && let Ok(Record::Statistics(found)) =
                parse::record(header.opcode, &records.read(header)?)
        {
            self.index.stated = Some(found.message_count);
        }
        Ok(())
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
                times = Some(widened(times, (header.log_time, header.log_time)));
                Ok(())
            }
            other => self.declare(&other),
        });
        match outcome {
            Ok(()) => {}
            Err(BagError::Corrupt { position, found, expected, .. }) => {
                // The chunks after it may be whole: go on.
                self.damaged(position, found, expected);
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
            self.count(Piece { position: header.position, counts, times: (first, last) });
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
        let body = match records.read(header) {
            // Only an index: the messages are in the chunk.
            Err(error) if BagError::is_unreadable(&error) => return Ok(()),
            body => body?,
        };
        if let Ok(Record::MessageIndex(index)) = parse::record(header.opcode, &body) {
            chunk.message_index_offsets.insert(index.channel_id, header.position);
            chunk.message_index_length += header.end() - header.position;
        }
        Ok(())
    }

    fn loose(&mut self, header: &RecordHeader, records: &mut Records) -> Result<(), WalkError> {
        if header.length > SIZE_LIMIT {
            self.damaged(header.position, described(header), "at most 1 GiB".into());
            return Ok(());
        }
        let body = match records.read(header) {
            Ok(body) => body,
            Err(error) if BagError::is_unreadable(&error) => {
                self.damaged(header.position, unreadable(&error), described(header));
                return Ok(());
            }
            Err(error) => return Err(error.into()),
        };
        let parsed = wanted_record(header.opcode, &body).map_err(|error| error.to_string());
        let outcome = match parsed {
            Ok(Some(Record::Message { header: message, .. })) => {
                if self.index.channels.contains_key(&message.channel_id) {
                    self.loose_message(header, message.log_time);
                    let (counts, time) = ([(message.channel_id, 1)].into(), message.log_time);
                    self.count(Piece { position: header.position, counts, times: (time, time) });
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
            self.damaged(header.position, found, expected);
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
            (run.first, run.last) = widened(Some((run.first, run.last)), (time, time));
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

    /// Counts what a piece holds. Loose messages make one piece for each run of theirs.
    fn count(&mut self, piece: Piece) {
        for (channel, messages) in &piece.counts {
            *self.index.counts.entry(*channel).or_insert(0) += messages;
        }
        self.index.times = Some(widened(self.index.times, piece.times));
        let run = self.index.segments.last().map(|run| (run.kind, run.position));
        match (run, self.index.pieces.last_mut()) {
            (Some((Kind::Loose, start)), Some(last)) if last.position >= start => {
                for (channel, messages) in piece.counts {
                    *last.counts.entry(channel).or_insert(0) += messages;
                }
                last.times = widened(Some(last.times), piece.times);
            }
            _ => self.index.pieces.push(piece),
        }
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
