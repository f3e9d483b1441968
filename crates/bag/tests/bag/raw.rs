//! MCAP files byte by byte: what they say twice, said differently.

use std::{collections::BTreeMap, io::Cursor};

use binrw::BinWrite;
use mcap::records::{ChunkIndex, Statistics, op};

/// A record: its opcode, its start and the bytes of its body.
pub struct Place {
    pub opcode: u8,
    pub start: usize,
    pub body: std::ops::Range<usize>,
}

/// The records of a file up to its footer, without those in chunks.
pub fn places(bytes: &[u8]) -> Vec<Place> {
    let (mut places, mut start) = (Vec::new(), 8);
    while start + 9 <= bytes.len() {
        let opcode = bytes[start];
        let length = number(bytes, start + 1) as usize;
        places.push(Place { opcode, start, body: start + 9..start + 9 + length });
        if opcode == op::FOOTER {
            break;
        }
        start += 9 + length;
    }
    places
}

/// The body of record `which` with this opcode, from 0.
pub fn body(bytes: &[u8], opcode: u8, which: usize) -> std::ops::Range<usize> {
    let mut found = places(bytes).into_iter().filter(|place| place.opcode == opcode);
    found.nth(which).unwrap().body
}

pub fn number(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap())
}

/// The file with another number at this byte, and without checksums of its sections.
pub fn with_number(bytes: &[u8], at: usize, value: u64) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    bytes[at..at + 8].copy_from_slice(&value.to_le_bytes());
    let footer = body(&bytes, op::FOOTER, 0);
    bytes[footer.end - 4..footer.end].fill(0);
    let end = body(&bytes, op::DATA_END, 0);
    bytes[end].fill(0);
    bytes
}

/// The records of the data section of a file, without its header.
pub fn data_section(bytes: &[u8]) -> &[u8] {
    let header = body(bytes, op::HEADER, 0);
    let end = places(bytes).into_iter().find(|place| place.opcode == op::DATA_END).unwrap();
    &bytes[header.end..end.start]
}

/// A file of these records, without a summary section.
pub fn file(records: &[&[u8]]) -> Vec<u8> {
    let header = record(op::HEADER, &[0; 8]);
    let ends = [record(op::DATA_END, &[0; 4]), record(op::FOOTER, &[0; 20])].concat();
    [&b"\x89MCAP0\r\n"[..], &header, &records.concat(), &ends, b"\x89MCAP0\r\n"].concat()
}

/// A file of these records with a summary section that describes its chunks, and repeats the `declared` schemas and channels.
pub fn summarized(records: &[&[u8]], declared: &[u8], counts: &[(u16, u64)]) -> Vec<u8> {
    let bytes = file(records);
    let mut chunks: Vec<ChunkIndex> = Vec::new();
    for place in places(&bytes) {
        let body = &bytes[place.body.clone()];
        if place.opcode == op::CHUNK {
            let name = u32::from_le_bytes(body[28..32].try_into().unwrap()) as usize;
            chunks.push(ChunkIndex {
                message_start_time: number(body, 0),
                message_end_time: number(body, 8),
                chunk_start_offset: place.start as u64,
                chunk_length: (place.body.end - place.start) as u64,
                message_index_offsets: BTreeMap::new(),
                message_index_length: 0,
                compression: String::from_utf8(body[32..32 + name].to_vec()).unwrap(),
                compressed_size: number(body, 32 + name),
                uncompressed_size: number(body, 16),
            });
        } else if let (op::MESSAGE_INDEX, Some(chunk)) = (place.opcode, chunks.last_mut()) {
            let channel = u16::from_le_bytes(body[..2].try_into().unwrap());
            chunk.message_index_offsets.insert(channel, place.start as u64);
            chunk.message_index_length += (place.body.end - place.start) as u64;
        }
    }
    let statistics = Statistics {
        message_count: counts.iter().map(|(_, messages)| messages).sum(),
        schema_count: 1,
        channel_count: counts.len() as u32,
        attachment_count: 0,
        metadata_count: 0,
        chunk_count: chunks.len() as u32,
        message_start_time: chunks.iter().map(|chunk| chunk.message_start_time).min().unwrap(),
        message_end_time: chunks.iter().map(|chunk| chunk.message_end_time).max().unwrap(),
        channel_message_counts: counts.iter().copied().collect(),
    };
    let start = places(&bytes).into_iter().find(|place| place.opcode == op::FOOTER).unwrap().start;
    let indexes = chunks.iter().map(|chunk| record(op::CHUNK_INDEX, &written(chunk)));
    let indexes: Vec<u8> = indexes.flatten().collect();
    let statistics = record(op::STATISTICS, &written(&statistics));
    let footer = record(op::FOOTER, &[&(start as u64).to_le_bytes()[..], &[0; 12]].concat());
    [&bytes[..start], declared, &statistics, &indexes, &footer, b"\x89MCAP0\r\n"].concat()
}

pub fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat()
}

/// A channel without a schema.
pub fn channel(id: u16, topic: &str) -> Vec<u8> {
    let text = |text: &str| [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat();
    let body = [&id.to_le_bytes()[..], &[0, 0], &text(topic), &text("json"), &[0; 4]].concat();
    record(op::CHANNEL, &body)
}

pub fn message(channel: u16, time: u64, data: &[u8]) -> Vec<u8> {
    let (number, time) = (1_u32.to_le_bytes(), time.to_le_bytes());
    record(op::MESSAGE, &[&channel.to_le_bytes()[..], &number, &time, &time, data].concat())
}

/// A chunk with its message indexes.
pub fn chunk(compression: &str, records: &[Vec<u8>]) -> Vec<u8> {
    let (mut content, mut entries) = (Vec::new(), BTreeMap::<u16, Vec<u8>>::new());
    let mut times = Vec::new();
    for record in records {
        if record[0] == op::MESSAGE {
            let channel = u16::from_le_bytes(record[9..11].try_into().unwrap());
            let time = number(record, 15);
            times.push(time);
            let entry = [time.to_le_bytes(), (content.len() as u64).to_le_bytes()].concat();
            entries.entry(channel).or_default().extend(entry);
        }
        content.extend_from_slice(record);
    }
    let ends = [times.iter().min(), times.iter().max()].map(|time| time.unwrap().to_le_bytes());
    let size = (content.len() as u64).to_le_bytes();
    let name = [&(compression.len() as u32).to_le_bytes()[..], compression.as_bytes()].concat();
    let body = [&ends.concat()[..], &size, &[0; 4], &name, &size, &content].concat();
    let mut bytes = record(op::CHUNK, &body);
    for (channel, entries) in entries {
        let length = (entries.len() as u32).to_le_bytes();
        let body = [&channel.to_le_bytes()[..], &length, &entries].concat();
        bytes.extend(record(op::MESSAGE_INDEX, &body));
    }
    bytes
}

fn written<R: for<'a> BinWrite<Args<'a> = ()>>(record: &R) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    record.write_le(&mut bytes).unwrap();
    bytes.into_inner()
}
