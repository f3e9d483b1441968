//! Indexes a file by a scan of all its records: for files without a usable summary section.

use std::{
    collections::{BTreeMap, btree_map::Entry},
    sync::Arc,
};

use mcap::{
    MAGIC,
    records::{self, ChunkIndex, Record, op},
};

use super::{
    block::{Block, BlockKind, Switch, describe, unknown_channel, unreadable, wanted_record},
    index::{
        BlockContents, ChannelKey, Damage, Declarations, FileIndex, PROGRESS_STEP, Progress, Times,
        add_counts, widen,
    },
    records::{ChunkHeader, NO_RECORD, RecordHeader, Records, SIZE_LIMIT, Step},
    statements::{LastChunk, ONE_CONTENT, Statements},
};
use crate::{
    error::BagError,
    format::{channel::Channel, layout, parse},
};

/// Body of a data end record: a checksum (bytes).
const DATA_END_LENGTH: u64 = 4;

/// Size (bytes) after which a block of messages outside chunks ends, to bound the memory of a reader.
const UNCHUNKED_BLOCK: u64 = 1 << 20;

impl FileIndex {
    /// Reads the whole file once, with the contents of its chunks. Channels that its data section lacks, as the place of their
    /// declaration may be damaged, are those of the `summary`.
    pub(super) fn scan_records(
        mut self,
        mut records: Records,
        summary: Declarations,
        progress: &mut Progress<'_>,
    ) -> Result<Self, BagError> {
        let failed = BagError::io(self.path.clone(), "reading");
        let mut reported = 0;
        self.scanned = true;
        let mut scan = Scan { summary, ..Scan::default() };
        let end = self.scan_to_end(&mut records, &mut scan, progress, &mut reported);
        for (&id, channel) in &scan.summary.channels {
            if let Entry::Vacant(declared) = self.declared.channels.entry(id) {
                declared.insert(Arc::clone(channel));
                self.channels.insert(id.into(), Arc::clone(channel));
            }
        }
        match end {
            // Statements about what is damaged cannot be compared.
            Ok(None) if self.damage.iter().next().is_none() => scan.statements.end(&mut self),
            Ok(None) => {}
            Ok(Some(expected)) => {
                let (size, messages) = (self.size, self.messages());
                self.damage.push(Damage::Truncated { size, messages, expected });
            }
            Err(ScanError::Io(error)) => return Err(failed(error)),
            Err(ScanError::Bag(error)) => return Err(error),
        }
        if !progress(self.size.saturating_sub(reported)) {
            return Err(BagError::Interrupted { path: self.path });
        }
        Ok(self)
    }

    /// Scans to the end; `reported` bytes were reported to `progress`. Returns what is missing if the file is
    /// truncated.
    fn scan_to_end(
        &mut self,
        records: &mut Records,
        scan: &mut Scan,
        progress: &mut Progress<'_>,
        reported: &mut u64,
    ) -> Result<Option<String>, ScanError> {
        if self.size < MAGIC.len() as u64 {
            return Ok(Some("the rest of the 8 bytes that start an MCAP file".into()));
        }
        let mut in_summary = false;
        loop {
            let read = records.position - *reported;
            if read >= PROGRESS_STEP {
                *reported = records.position;
                if !progress(read) {
                    let path = self.path.clone();
                    return Err(ScanError::Bag(BagError::Interrupted { path }));
                }
            }
            let header = match self.next_header(records, scan, in_summary)? {
                Next::Record(header) => header,
                Next::Skipped => continue,
                Next::End { missing } => return Ok(missing),
            };
            if header.end() > self.size {
                if header.opcode == op::CHUNK && !in_summary {
                    self.chunk(&header, BlockKind::TruncatedChunk, records, scan)?;
                }
                let start = header.position;
                return Ok(Some(format!("{} from byte {start}", describe(&header))));
            }
            if header.opcode != op::MESSAGE_INDEX {
                scan.statements.end_chunk(self);
            }
            match header.opcode {
                NO_RECORD if !in_summary => {
                    return Ok(Some(format!("a record from byte {}", header.position)));
                }
                op::FOOTER => {
                    return Ok(self.footer(&header));
                }
                op::DATA_END => {
                    if header.length != DATA_END_LENGTH {
                        let expected = format!("{DATA_END_LENGTH} bytes");
                        self.add_damage(header.position, describe(&header), expected);
                    }
                    in_summary = true;
                }
                opcode if in_summary && Statements::takes(opcode) => {
                    self.summary_record(&header, records, scan)?
                }
                _ if in_summary => {}
                op::CHUNK => self.chunk(&header, BlockKind::Chunk, records, scan)?,
                op::MESSAGE_INDEX => self.message_index(&header, records, scan)?,
                op::SCHEMA | op::CHANNEL | op::MESSAGE => {
                    self.unchunked_record(&header, records, scan)?
                }
                op::ATTACHMENT | op::METADATA => self.auxiliary.push(header),
                _ => {}
            }
            if !in_summary {
                self.data_end = header.end();
            }
        }
    }

    /// The header of the next record, with its true length.
    fn next_header(
        &mut self,
        records: &mut Records,
        scan: &mut Scan,
        in_summary: bool,
    ) -> Result<Next, ScanError> {
        let missing = match records.step() {
            Ok(Step::Record(header) | Step::TruncatedBody(header)) if in_summary => {
                return Ok(Next::Record(header));
            }
            Ok(Step::Record(header) | Step::TruncatedBody(header)) => {
                let header = self.with_true_length(header, records, scan)?;
                return Ok(header.map_or(Next::Skipped, Next::Record));
            }
            Ok(Step::TruncatedHeader) => "a record header of 9 bytes".into(),
            // A file that is still being written may end after any complete record.
            Ok(Step::End) if !in_summary && layout::is_active(&self.path) => {
                return Ok(Next::End { missing: None });
            }
            Ok(Step::End) => "the data end record and the footer".into(),
            Err(error) if BagError::is_unreadable(&error) => {
                let position = records.position;
                self.add_damage(position, unreadable(&error), "a record".into());
                if !in_summary && records.seek_message(position + 1, &self.known_channels(scan))? {
                    return Ok(Next::Skipped);
                }
                format!("a record from byte {position}")
            }
            Err(error) => return Err(error.into()),
        };
        Ok(Next::End { missing: Some(missing) })
    }

    /// Ends the scan at the footer. Returns what is missing after it.
    fn footer(&mut self, header: &RecordHeader) -> Option<String> {
        let rest = self.size - header.end();
        if rest > MAGIC.len() as u64 {
            // A damaged opcode: the record is not a footer and hides what follows.
            let expected = "no footer before the end of the file".to_owned();
            self.add_damage(header.position, describe(header), expected);
        }
        (rest < MAGIC.len() as u64).then(|| "the 8 bytes that end an MCAP file".into())
    }

    /// Checks the length of a record by what follows it. Where no record follows, the length is damaged: a chunk
    /// repeats it in its own fields; after other records the scan continues at the next chunk or message, and the
    /// result is `None` if there is one.
    fn with_true_length(
        &mut self,
        header: RecordHeader,
        records: &mut Records,
        scan: &Scan,
    ) -> Result<Option<RecordHeader>, ScanError> {
        if header.opcode == op::FOOTER {
            return Ok(Some(header));
        }
        if header.opcode == op::CHUNK
            && let Some(length) = records.chunk_header(&header)?.and_then(|chunk| chunk.length())
            && length != header.length
        {
            let corrected = RecordHeader { length, ..header };
            if records.may_continue_at(corrected.end())? {
                self.add_damage(header.position, describe(&header), format!("{length} bytes"));
                records.position = corrected.end();
                return Ok(Some(corrected));
            }
        }
        if header.opcode != NO_RECORD && records.may_continue_at(header.end())? {
            return Ok(Some(header));
        }
        let continues = match header.opcode {
            // Messages in a chunk are protected by its checksum only.
            op::CHUNK => records.seek_chunk(header.position + 1)?,
            _ => records.seek_message(header.position + 1, &self.known_channels(scan))?,
        };
        if continues {
            let expected = "a length that ends at the next record".into();
            self.add_damage(header.position, describe(&header), expected);
        }
        Ok((!continues).then_some(header))
    }

    /// The channels that messages may have.
    fn known_channels(&self, scan: &Scan) -> BTreeMap<u16, Arc<Channel>> {
        let mut known = scan.summary.channels.clone();
        known.extend(self.declared.channels.iter().map(|(&id, of)| (id, Arc::clone(of))));
        known
    }

    fn summary_record(
        &mut self,
        header: &RecordHeader,
        records: &mut Records,
        scan: &mut Scan,
    ) -> Result<(), ScanError> {
        if header.length > SIZE_LIMIT {
            return Ok(());
        }
        let body = records.read(header)?;
        if let Ok(record) = parse::record(header.opcode, &body) {
            if let Record::Statistics(found) = &record {
                self.declared_messages = Some(found.message_count);
            }
            scan.statements.add(header.position, record, self);
        }
        Ok(())
    }

    /// Adds a schema or a channel of the data section at byte `position`. Returns its id and the channel that messages with the id
    /// belong to from here on, if that changes.
    ///
    /// # Errors
    /// The reason why the record is rejected.
    fn declare(
        &mut self,
        position: u64,
        record: &Record<'_>,
        scan: &mut Scan,
    ) -> Result<Option<(u16, ChannelKey)>, String> {
        if let Record::Channel(channel) = record
            && !self.declared.schemas.contains_key(&channel.schema_id)
            && let Some(schema) = scan.summary.schemas.get(&channel.schema_id)
        {
            self.declared.schemas.insert(channel.schema_id, Arc::clone(schema));
        }
        if let Some(before) = self.declared.declare(record)? {
            let found = format!("{before}, declared again with another content");
            self.add_contradiction(position, found, ONE_CONTENT.into());
        }
        let Record::Channel(records::Channel { id, .. }) = record else { return Ok(None) };
        let Some(channel) = self.declared.channels.get(id) else { return Ok(None) };
        let first = ChannelKey::from(*id);
        let key = match self.channels.get(&first) {
            None => first,
            Some(known) if known == channel => first,
            Some(_) => {
                let others = self.channels.range(BEYOND_IDS..);
                let same = others.clone().find(|(_, known)| *known == channel);
                let new = || others.clone().next_back().map_or(BEYOND_IDS, |(last, _)| last + 1);
                same.map_or_else(new, |(key, _)| *key)
            }
        };
        self.channels.entry(key).or_insert_with(|| Arc::clone(channel));
        let before = scan.current.insert(*id, key).unwrap_or(first);
        Ok((before != key).then_some((*id, key)))
    }

    /// The channel that messages with an id belong to here; `None` if it is not declared.
    fn key_of(&mut self, id: u16, scan: &Scan) -> Option<ChannelKey> {
        if let Entry::Vacant(declared) = self.declared.channels.entry(id) {
            let channel = scan.summary.channels.get(&id)?;
            declared.insert(Arc::clone(channel));
            self.channels.insert(id.into(), Arc::clone(channel));
        }
        Some(scan.current.get(&id).copied().unwrap_or(id.into()))
    }

    fn chunk(
        &mut self,
        header: &RecordHeader,
        kind: BlockKind,
        records: &mut Records,
        scan: &mut Scan,
    ) -> Result<(), ScanError> {
        let fields = records.chunk_header(header)?;
        if let Some(fields) = &fields {
            self.compressions.insert(fields.compression.clone());
        }
        let (position, end) = (header.position, header.end().min(self.size));
        let block = Block {
            file: self.number,
            position: header.position,
            length: end - header.position,
            kind,
            first: 0,
            last: 0,
            switches: Vec::new(),
            channels: None,
        };
        let (path, file) = (self.path.clone(), self.file.clone());
        let (mut counts, mut times) = (BTreeMap::new(), None);
        let (mut switches, mut number) = (scan.switches(), 0);
        let stated = fields.as_ref().map(|fields| fields.times).unwrap_or_default();
        let mut chunk = LastChunk::new(header.position, stated);
        let outcome = block.read(&path, &file, None, |place, record| {
            number += 1;
            match record {
                Record::Message { header, .. } => {
                    let id = header.channel_id;
                    let key = self.key_of(id, scan).ok_or_else(|| unknown_channel(id))?;
                    *counts.entry(key).or_insert(0) += 1;
                    times = Some(widen(times, (header.log_time, header.log_time)));
                    chunk.add_message(id, header.log_time, place);
                }
                other => {
                    let switched = self.declare(position, &other, scan)?;
                    switches.extend(switched.map(|(id, key)| Switch { from: number, id, key }));
                }
            }
            Ok(())
        });
        match outcome {
            Ok(()) => {}
            Err(BagError::Corrupt { position, found, expected, .. }) => {
                // Later chunks may be intact.
                self.add_damage(position, found, expected);
                return Ok(());
            }
            Err(error) => return Err(error.into()),
        }
        if let Some(fields) = fields.filter(|_| kind == BlockKind::Chunk) {
            self.chunks.push(chunk_index(&block, header, fields, times.unwrap_or_default()));
        }
        if kind == BlockKind::Chunk {
            scan.statements.begin_chunk(chunk);
        }
        if let Some((first, last)) = times {
            let channels = Some(counts.keys().copied().collect());
            self.blocks.push(Block { first, last, switches, channels, ..block });
            self.count(BlockContents { position: header.position, counts, times: (first, last) });
        }
        Ok(())
    }

    /// Adds a message index to the chunk before it.
    fn message_index(
        &mut self,
        header: &RecordHeader,
        records: &mut Records,
        scan: &mut Scan,
    ) -> Result<(), ScanError> {
        let Some(chunk) = self.chunks.last_mut() else { return Ok(()) };
        let indexed = chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length;
        if header.position != indexed || header.length > SIZE_LIMIT {
            return Ok(());
        }
        let body = match records.read(header) {
            // Not needed to read the messages.
            Err(error) if BagError::is_unreadable(&error) => return Ok(()),
            body => body?,
        };
        if let Ok(Record::MessageIndex(index)) = parse::record(header.opcode, &body) {
            scan.statements.index(&index);
            chunk.message_index_offsets.insert(index.channel_id, header.position);
            chunk.message_index_length += header.end() - header.position;
        }
        Ok(())
    }

    fn unchunked_record(
        &mut self,
        header: &RecordHeader,
        records: &mut Records,
        scan: &mut Scan,
    ) -> Result<(), ScanError> {
        if header.length > SIZE_LIMIT {
            self.add_damage(header.position, describe(header), "at most 1 GiB".into());
            return Ok(());
        }
        let body = match records.read(header) {
            Ok(body) => body,
            Err(error) if BagError::is_unreadable(&error) => {
                self.add_damage(header.position, unreadable(&error), describe(header));
                return Ok(());
            }
            Err(error) => return Err(error.into()),
        };
        let parsed = wanted_record(header.opcode, &body).map_err(|error| error.to_string());
        let outcome = match parsed {
            Ok(Some(Record::Message { header: message, .. })) => {
                let id = message.channel_id;
                if let Some(key) = self.key_of(id, scan) {
                    self.add_unchunked_message(header, message.log_time, scan);
                    scan.statements.count(id, 1);
                    let (counts, time) = ([(key, 1)].into(), message.log_time);
                    self.count(BlockContents {
                        position: header.position,
                        counts,
                        times: (time, time),
                    });
                    Ok(())
                } else {
                    Err(unknown_channel(id))
                }
            }
            // Ends the block of messages before it.
            Ok(Some(other)) => self.declare(header.position, &other, scan).map(drop),
            Ok(None) => Ok(()),
            Err(reason) => Err(reason),
        };
        if let Err(found) = outcome {
            let expected = "a record consistent with the records before it".into();
            self.add_damage(header.position, found, expected);
        }
        Ok(())
    }

    /// Adds a message outside chunks to the block before it if that ends where the message starts.
    fn add_unchunked_message(&mut self, header: &RecordHeader, time: u64, scan: &Scan) {
        let length = header.end() - header.position;
        if let Some(block) = self.blocks.last_mut()
            && block.kind == BlockKind::Unchunked
            && block.position + block.length == header.position
            && block.length < UNCHUNKED_BLOCK
        {
            block.length += length;
            (block.first, block.last) = widen(Some((block.first, block.last)), (time, time));
            return;
        }
        self.blocks.push(Block {
            file: self.number,
            position: header.position,
            length,
            kind: BlockKind::Unchunked,
            first: time,
            last: time,
            switches: scan.switches(),
            channels: None,
        });
    }

    /// Adds the contents of the last block, or of the last message in it.
    fn count(&mut self, added: BlockContents) {
        add_counts(&mut self.counts, &added.counts);
        self.times = Some(widen(self.times, added.times));
        let block = self.blocks.last().map(|block| (block.kind, block.position));
        match (block, self.contents.last_mut()) {
            (Some((BlockKind::Unchunked, start)), Some(last)) if last.position >= start => {
                add_counts(&mut last.counts, &added.counts);
                last.times = widen(Some(last.times), added.times);
            }
            _ => self.contents.push(added),
        }
    }
}

/// What the scan finds at its position.
enum Next {
    Record(RecordHeader),
    /// Something damaged; the scan continues behind it.
    Skipped,
    /// The end, before which something may be missing.
    End {
        missing: Option<String>,
    },
}

/// The index of the chunk in `block`, without its message indexes, which follow it.
fn chunk_index(
    block: &Block,
    header: &RecordHeader,
    fields: ChunkHeader,
    (message_start_time, message_end_time): Times,
) -> ChunkIndex {
    ChunkIndex {
        message_start_time,
        message_end_time,
        chunk_start_offset: block.position,
        chunk_length: block.length,
        message_index_offsets: BTreeMap::new(),
        message_index_length: 0,
        compressed_size: header.length.saturating_sub(fields.records as u64),
        uncompressed_size: fields.uncompressed,
        compression: fields.compression,
    }
}

/// First key of the contents beyond the first one of an id.
const BEYOND_IDS: ChannelKey = 1 << 16;

/// What is known while a file is scanned, beside its index.
#[derive(Default)]
struct Scan {
    /// Schemas and channels of the summary section.
    summary: Declarations,
    /// The channels that ids stand for, once they are declared.
    current: BTreeMap<u16, ChannelKey>,
    statements: Statements,
}

impl Scan {
    /// The switches at the start of a block: ids that stand for another channel than their first.
    fn switches(&self) -> Vec<Switch> {
        let switched = self.current.iter().filter(|(id, key)| ChannelKey::from(**id) != **key);
        switched.map(|(&id, &key)| Switch { from: 0, id, key }).collect()
    }
}

/// Why a scan stopped.
enum ScanError {
    Io(std::io::Error),
    Bag(BagError),
}

impl From<std::io::Error> for ScanError {
    fn from(error: std::io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<BagError> for ScanError {
    fn from(error: BagError) -> Self {
        Self::Bag(error)
    }
}
