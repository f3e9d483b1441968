//! Copies a file with message indexes, and times of its chunks, that are those of its messages.

use std::{
    collections::BTreeMap,
    fs::{self, File},
    io::{self, BufWriter, Read as _, Seek as _, SeekFrom, Write},
    path::Path,
};

use mcap::{
    MAGIC,
    records::{Record, op},
};

use crate::{
    error::BagError,
    read::{
        block::Block,
        index::{PROGRESS_STEP, Progress, Times, widen},
        records::{ChunkHeader, HEADER_SIZE, RecordHeader, Records, SIZE_LIMIT, Step},
    },
};

/// By the id of their channel, the time and place of each message in a chunk (ns, bytes).
type Entries = BTreeMap<u16, Vec<(u64, u64)>>;

/// Copies the data section of an undamaged file to a new one at `copy`, with new message indexes and times of the chunks. The other
/// records stay as they are. `progress` is called with the number of bytes copied since the last call.
pub(super) fn copy_with_indexes(
    file: &Path,
    copy: &Path,
    progress: &mut Progress<'_>,
) -> Result<(), BagError> {
    let failed = |reason| BagError::Io { path: copy.into(), action: "copying the file", reason };
    let open = BagError::io(file, "opening the file");
    let source = eddy_storage::File::open(file).map_err(open)?;
    let mut bytes = File::open(file).map_err(failed)?;
    let target = File::create(copy).map_err(failed)?;
    target.set_permissions(fs::metadata(file).map_err(failed)?.permissions()).map_err(failed)?;
    let mut target = BufWriter::new(target);
    target.write_all(MAGIC).map_err(failed)?;
    let reader = source.reader().map_err(failed)?;
    let mut records = Records::new(reader, source.size(), MAGIC.len() as u64);
    let mut reported = 0;
    while let Step::Record(header) = records.step().map_err(failed)? {
        match header.opcode {
            op::DATA_END | op::FOOTER => break,
            op::MESSAGE_INDEX => {}
            op::CHUNK => copy_chunk(file, &source, &header, &mut target)?,
            _ => copy_record(&mut bytes, &header, &mut target).map_err(failed)?,
        }
        let copied = header.end() - reported;
        if copied >= PROGRESS_STEP {
            reported = header.end();
            if !progress(copied) {
                return Err(BagError::Interrupted { path: file.into() });
            }
        }
    }
    target.flush().map_err(failed)?;
    match progress(source.size() - reported) {
        true => Ok(()),
        false => Err(BagError::Interrupted { path: file.into() }),
    }
}

fn copy_record(from: &mut File, header: &RecordHeader, into: &mut impl Write) -> io::Result<()> {
    from.seek(SeekFrom::Start(header.position))?;
    io::copy(&mut from.take(HEADER_SIZE + header.length), into).map(drop)
}

fn copy_chunk(
    path: &Path,
    file: &eddy_storage::File,
    header: &RecordHeader,
    into: &mut impl Write,
) -> Result<(), BagError> {
    let failed = |reason| BagError::Io { path: path.into(), action: "copying the file", reason };
    let corrupt = |expected: &str| BagError::Corrupt {
        path: path.into(),
        position: header.position,
        found: format!("a chunk of {} bytes", header.length),
        expected: expected.to_owned(),
    };
    if header.length > SIZE_LIMIT {
        return Err(corrupt("at most 1 GiB"));
    }
    let (mut entries, mut times) = (Entries::new(), None);
    let block = Block::of_chunk(header);
    block.read(path, file, None, |place, record| {
        if let Record::Message { header, .. } = record {
            entries.entry(header.channel_id).or_default().push((header.log_time, place));
            times = Some(widen(times, (header.log_time, header.log_time)));
        }
        Ok(())
    })?;
    let body = file.read(header.body(), header.length).map_err(failed)?;
    let fields = ChunkHeader::parse(&body).ok_or_else(|| corrupt("the fields of a chunk"))?;
    let content = body.get(fields.records..).unwrap_or_default();
    write_chunk(&fields, times.unwrap_or_default(), content, into)
        .and_then(|()| write_indexes(&entries, into))
        .map_err(failed)
}

fn write_chunk(
    fields: &ChunkHeader,
    (first, last): Times,
    content: &[u8],
    into: &mut impl Write,
) -> io::Result<()> {
    let ChunkHeader { uncompressed, compression, crc, .. } = fields;
    let name = [&(compression.len() as u32).to_le_bytes()[..], compression.as_bytes()].concat();
    let times = [first.to_le_bytes(), last.to_le_bytes()].concat();
    let (size, length) = (uncompressed.to_le_bytes(), (content.len() as u64).to_le_bytes());
    let fields = [&times[..], &size, &crc.to_le_bytes(), &name, &length].concat();
    record(op::CHUNK, &[&fields, content], into)
}

fn write_indexes(entries: &Entries, into: &mut impl Write) -> io::Result<()> {
    for (channel, entries) in entries {
        let entries: Vec<u8> = entries
            .iter()
            .flat_map(|(time, place)| [time.to_le_bytes(), place.to_le_bytes()].concat())
            .collect();
        let length = (entries.len() as u32).to_le_bytes();
        record(op::MESSAGE_INDEX, &[&channel.to_le_bytes(), &length, &entries], into)?;
    }
    Ok(())
}

fn record(opcode: u8, body: &[&[u8]], into: &mut impl Write) -> io::Result<()> {
    let length: usize = body.iter().map(|part| part.len()).sum();
    into.write_all(&[opcode])?;
    into.write_all(&(length as u64).to_le_bytes())?;
    body.iter().try_for_each(|part| into.write_all(part))
}
