//! TensorBoard's event files: records of scalars, appended during a run.
//!
//! A file is a sequence of TFRecords, each `u64` length, masked CRC-32C of the length, data, masked
//! CRC-32C of the data, little-endian (`tensorflow/core/lib/io/record_writer.h`). The data is an
//! `Event` in Protocol Buffers' wire format (`tensorboard/compat/proto/event.proto`, `summary.proto`):
//!
//! | message | field | number | wire type |
//! |---|---|---|---|
//! | `Event` | `wall_time` (s since the Unix epoch) | 1 | double |
//! | | `step` | 2 | varint |
//! | | `file_version` | 3 | string |
//! | | `summary` | 5 | `Summary` |
//! | | `session_log` | 7 | `SessionLog` |
//! | `Summary` | `value` | 1 | `Summary.Value` |
//! | `Summary.Value` | `tag` | 1 | string |
//! | | `simple_value` | 2 | float |
//! | `SessionLog` | `status` (`START` = 1) | 1 | varint |

use std::{
    fs::File,
    io::{self, Write as _},
    path::Path,
};

use eddy_frames::Stamp;

/// The version in the first event of a file.
const FILE_VERSION: &str = "brain.Event:2";
/// Added to the rotated checksum.
const MASK: u32 = 0xa282_ead8;
/// `SessionLog.SessionStatus.START`.
const START: u64 = 1;

/// An event file for writing.
pub(super) struct EventFile {
    file: File,
}

impl EventFile {
    /// Creates an event file in `folder`, named after the time `now`: TensorBoard reads files in the order of their names.
    pub(super) fn create(folder: &Path, now: Stamp) -> io::Result<Self> {
        let seconds = now.seconds() as u64;
        let mut number = 0;
        let file = loop {
            let name = format!("events.out.tfevents.{seconds:010}.{number:03}.eddy");
            match File::create_new(folder.join(name)) {
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => number += 1,
                other => break other?,
            }
        };
        let mut events = Self { file };
        let mut version = Vec::new();
        bytes_field(&mut version, 3, FILE_VERSION.as_bytes());
        events.event(now, 0, &version)?;
        Ok(events)
    }

    /// Appends the scalars of a step.
    pub(super) fn scalars(
        &mut self,
        now: Stamp,
        step: u64,
        scalars: &[(&str, f64)],
    ) -> io::Result<()> {
        let mut summary = Vec::new();
        for (tag, scalar) in scalars {
            let mut value = Vec::new();
            bytes_field(&mut value, 1, tag.as_bytes());
            value.push(2 << 3 | 5);
            value.extend((*scalar as f32).to_le_bytes());
            bytes_field(&mut summary, 1, &value);
        }
        let mut event = Vec::new();
        bytes_field(&mut event, 5, &summary);
        self.event(now, step, &event)
    }

    /// Records that the run resumes after `step`, which invalidates the events of later steps.
    pub(super) fn resume_after(&mut self, now: Stamp, step: u64) -> io::Result<()> {
        let mut log = vec![1 << 3];
        varint(&mut log, START);
        let mut event = Vec::new();
        bytes_field(&mut event, 7, &log);
        self.event(now, step + 1, &event)
    }

    fn event(&mut self, now: Stamp, step: u64, rest: &[u8]) -> io::Result<()> {
        let mut event = vec![1 << 3 | 1];
        event.extend(now.seconds().to_le_bytes());
        event.push(2 << 3);
        varint(&mut event, step);
        event.extend(rest);
        self.file.write_all(&record(&event))
    }
}

/// A TFRecord.
fn record(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    let mut record = length.to_vec();
    record.extend(masked(&length).to_le_bytes());
    record.extend(data);
    record.extend(masked(data).to_le_bytes());
    record
}

fn masked(data: &[u8]) -> u32 {
    crc32c::crc32c(data).rotate_right(15).wrapping_add(MASK)
}

/// A field of wire type 2: its length, then its bytes.
fn bytes_field(message: &mut Vec<u8>, number: u8, bytes: &[u8]) {
    message.push(number << 3 | 2);
    varint(message, bytes.len() as u64);
    message.extend(bytes);
}

fn varint(message: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        message.push(value as u8 | 0x80);
        value >>= 7;
    }
    message.push(value as u8);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The output of TensorBoard 2.21.0's `RecordWriter` for the same three events
    /// (`tensorboard.summary.writer.record_writer`, `tensorboard.compat.proto.event_pb2`).
    const GOLDEN: &str = "1b000000000000001a0d9e1309000000000000f83f10ac021a0d627261696e2e4576656e74\
        3a320a8dc5e41b000000000000001a0d9e1309000000000000044010ad022a0d0a0b0a046c6f7373150000803e\
        59b88eed100000000000000095fbfe1809000000000000044010ae023a02080194983a3d";

    #[test]
    fn the_bytes_equal_those_of_tensorboards_writer() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("events");
        let mut events = EventFile { file: File::create(&path).unwrap() };
        let mut version = Vec::new();
        bytes_field(&mut version, 3, FILE_VERSION.as_bytes());
        events.event(Stamp(1_500_000_000), 300, &version).unwrap();
        let later = Stamp(2_500_000_000);
        events.scalars(later, 301, &[("loss", 0.25)]).unwrap();
        events.resume_after(later, 301).unwrap();
        let found: String =
            std::fs::read(&path).unwrap().iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(found, GOLDEN);
    }

    #[test]
    fn a_second_file_of_the_same_second_sorts_later() {
        let folder = tempfile::tempdir().unwrap();
        EventFile::create(folder.path(), Stamp(7_000_000_000)).unwrap();
        EventFile::create(folder.path(), Stamp(7_900_000_000)).unwrap();
        let names = std::fs::read_dir(folder.path()).unwrap();
        let mut names: Vec<_> = names.map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        let expected =
            ["events.out.tfevents.0000000007.000.eddy", "events.out.tfevents.0000000007.001.eddy"];
        assert_eq!(names, expected);
    }
}
