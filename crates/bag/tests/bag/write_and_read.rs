//! Bags end to end: what is written is read back, also from damaged files.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use eddy_bag::{
    BagError, BagReader, BagWriter, Compression, CopyOptions, Selection, Survey, WriterOptions,
};
use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_messages::{FrameCdr, Message, ParticleFrame, PointCloud2, RosString, cdr, cloud};
use mcap::records::MessageHeader;
use proptest::prelude::*;

use crate::support::{findings, word};

const COMPRESSIONS: [Compression; 3] = [Compression::None, Compression::Lz4, Compression::Zstd];

fn frame(sequence: u64) -> Frame {
    let particle = |i: usize| 0.1 + 0.001 * (i as f32) + 0.0001 * (sequence as f32);
    Frame {
        stream: 4,
        sequence,
        stamp: Stamp(0).advance(0.016, sequence as u32),
        dt: 0.016,
        domain: Domain::UNIT,
        position: (0..50).map(|i| [particle(i), 0.5]).collect(),
        velocity: vec![[0.0, -1.0]; 50],
        material: vec![Material::Jelly; 50],
    }
}

/// A bag of `frames` frames on `/particles`, with small chunks.
fn write_frames(path: &Path, frames: u64, compression: Compression) {
    let options = WriterOptions { compression, chunk_size: 4096, ..WriterOptions::default() };
    let mut bag = BagWriter::create(path, options).unwrap();
    let topic = bag.topic("/particles", ParticleFrame::TYPE).unwrap();
    for frame in (0..frames).map(frame) {
        bag.write(topic, frame.stamp, frame.stamp, &frame.to_cdr()).unwrap();
    }
    bag.finish().unwrap();
}

/// One message as the tests compare them: topic, log time, publish time, data.
type Plain = (String, i64, i64, Vec<u8>);

fn plain(path: &Path) -> Vec<Plain> {
    let messages = BagReader::open(path).unwrap().messages().map(Result::unwrap);
    messages.map(|m| (m.topic.to_string(), m.log_time.0, m.publish_time.0, m.data)).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn messages_come_back_as_they_went_in_the_order_of_their_time(
        messages in prop::collection::vec(
            (0..4usize, 0..5_000i64, 0..5_000i64, prop::collection::vec(any::<u8>(), 0..600)),
            0..120,
        ),
        compression in prop::sample::select(&COMPRESSIONS),
        chunk_size in 1..20_000u64,
        flush_every in 1..50usize,
    ) {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("bag");
        let options = WriterOptions { compression, chunk_size, ..WriterOptions::default() };
        let mut bag = BagWriter::create(&path, options).unwrap();
        for (index, (topic, log, publish, data)) in messages.iter().enumerate() {
            let id = bag.topic(&format!("/topic{topic}"), RosString::TYPE).unwrap();
            bag.write(id, Stamp(*log), Stamp(*publish), data).unwrap();
            if index % flush_every == 0 {
                bag.flush().unwrap();
            }
        }
        bag.finish().unwrap();

        let mut expected: Vec<Plain> = messages
            .into_iter()
            .map(|(topic, log, publish, data)| (format!("/topic{topic}"), log, publish, data))
            .collect();
        let mut found = plain(&path);
        prop_assert!(found.is_sorted_by_key(|message| message.1));
        // The order of messages with equal times depends on their chunks.
        expected.sort();
        found.sort();
        prop_assert_eq!(found, expected);
    }

    #[test]
    fn no_flipped_byte_makes_the_reader_panic(at in 0.0..1.0f64, bit in 0..8u8, kind in 0..3usize) {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("bag");
        write_frames(&path, 12, COMPRESSIONS[kind]);
        let file = path.join("bag_0.mcap");
        let mut bytes = fs::read(&file).unwrap();
        let index = (at * bytes.len() as f64) as usize;
        bytes[index] ^= 1 << bit;
        fs::write(&file, bytes).unwrap();
        if let Ok(bag) = BagReader::open(&path) {
            let mut survey = Survey::of(&bag, |_| ());
            survey.check_files(&bag);
        }
    }
}

#[test]
fn frames_of_three_dimensions_come_back_and_are_refused_where_two_are_expected() {
    let directory = tempfile::tempdir().unwrap();
    let [path, mixed, clouds] = ["bag", "mixed", "clouds"].map(|name| directory.path().join(name));
    let deep = |sequence: u64| {
        let Frame { stream, stamp, dt, position, velocity, material, .. } = frame(sequence);
        let domain = Domain { lower: [0.0; 3], upper: [1.0; 3] };
        let position = position.iter().map(|[x, y]| [*x, *y, 0.25]).collect();
        let velocity = velocity.iter().map(|[x, y]| [*x, *y, 0.5]).collect();
        Frame::<3> { stream, sequence, stamp, dt, domain, position, velocity, material }
    };
    let write = |path: &Path, messages: &[Vec<u8>]| {
        let mut bag = BagWriter::create(path, WriterOptions::default()).unwrap();
        let topic = bag.topic("/particles", ParticleFrame::TYPE).unwrap();
        for (message, number) in messages.iter().zip(0..) {
            bag.write(topic, Stamp(number), Stamp(number), message).unwrap();
        }
        bag.finish().unwrap();
        BagReader::open(path).unwrap()
    };
    let bag = write(&path, &[0, 1, 2].map(|sequence| deep(sequence).to_cdr()));
    assert_eq!(findings(&path), [] as [&str; 0]);
    let found = bag.frames_of::<Frame<3>>("/particles").unwrap().map(Result::unwrap);
    assert_eq!(found.collect::<Vec<_>>(), [0, 1, 2].map(deep));
    let refused = bag.frames("/particles").unwrap().next().unwrap().unwrap_err().to_string();
    assert!(refused.ends_with("lower: found 3 dimensions, expected 2"), "{refused}");
    let (writer, on_message) = (WriterOptions::default(), &mut || true);
    let custom_data = bag.custom_data().clone();
    let options = CopyOptions { writer, custom_data, on_message };
    eddy_bag::clouds(&bag, &clouds, options).unwrap();
    let clouds = BagReader::open(&clouds).unwrap();
    let clouds = clouds.messages_of("/particles/cloud", PointCloud2::TYPE).unwrap();
    for (cloud, sequence) in clouds.zip(0..) {
        assert_eq!(cloud.unwrap().data, cloud::to_cdr(&deep(sequence)));
    }

    write(&mixed, &[frame(0).to_cdr(), deep(1).to_cdr()]);
    let said = "found domain 0 to 1 x 0 to 1 x 0 to 1, expected 0 to 1 x 0 to 1";
    assert!(findings(&mixed)[0].ends_with(said), "{:?}", findings(&mixed));
}

#[test]
fn the_same_calls_give_the_same_bytes() {
    for compression in COMPRESSIONS {
        let directory = tempfile::tempdir().unwrap();
        let files = ["one", "two"].map(|parent| {
            let path = directory.path().join(parent).join("bag");
            write_frames(&path, 20, compression);
            ["bag_0.mcap", "metadata.yaml"].map(|file| fs::read(path.join(file)).unwrap())
        });
        assert!(files[0] == files[1], "{compression:?}");
    }
}

#[test]
fn frames_come_back_without_findings() {
    for compression in COMPRESSIONS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("bag");
        write_frames(&path, 40, compression);
        let bag = BagReader::open(&path).unwrap();
        let frames: Vec<Frame> = bag.frames("/particles").unwrap().map(Result::unwrap).collect();
        assert_eq!(frames, (0..40).map(frame).collect::<Vec<_>>());
        assert_eq!(findings(&path), [""; 0]);
    }
}

#[test]
fn a_bag_dropped_before_its_end_is_readable_under_its_unfinished_name() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("bag");
    let mut bag = BagWriter::create(&path, WriterOptions::default()).unwrap();
    let topic = bag.topic("/words", RosString::TYPE).unwrap();
    bag.write(topic, Stamp(1), Stamp(1), &word("a")).unwrap();
    drop(bag);
    assert!(path.join("bag_0.mcap.active").exists());
    assert_eq!(plain(&path), [("/words".to_owned(), 1, 1, word("a"))]);
    assert!(BagReader::open(&path).unwrap().is_unfinished());
    assert!(findings(&path)[0].contains("found an unfinished file"));
}

#[test]
fn flushed_messages_are_readable_while_the_bag_is_written() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("bag");
    let mut bag = BagWriter::create(&path, WriterOptions::default()).unwrap();
    assert_eq!(plain(&path), []);
    let topic = bag.topic("/words", RosString::TYPE).unwrap();
    bag.write(topic, Stamp(1), Stamp(1), &word("kept")).unwrap();
    bag.flush().unwrap();
    bag.write(topic, Stamp(2), Stamp(2), &word("in memory")).unwrap();
    assert_eq!(plain(&path), [("/words".to_owned(), 1, 1, word("kept"))]);
    // As after SIGKILL: the file is not finished.
    std::mem::forget(bag);
    assert_eq!(plain(&path), [("/words".to_owned(), 1, 1, word("kept"))]);
}

#[test]
fn a_bag_truncated_anywhere_gives_every_complete_message_then_one_error() {
    for compression in COMPRESSIONS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("bag");
        write_frames(&path, 12, compression);
        let whole = fs::read(path.join("bag_0.mcap")).unwrap();
        let cut = directory.path().join("cut.mcap");
        let mut most = 0;
        for length in (0..whole.len()).step_by(13).chain([whole.len() - 1]) {
            fs::write(&cut, &whole[..length]).unwrap();
            let bag = BagReader::open(&cut).unwrap();
            let mut messages: Vec<_> = bag.messages().collect();
            let error = messages.pop().unwrap().unwrap_err();
            let BagError::Truncated { size, messages: counted, .. } = &error else {
                panic!("{length} bytes: {error}");
            };
            assert_eq!((*size, *counted), (length as u64, messages.len() as u64));
            for (sequence, message) in messages.iter().enumerate() {
                let data = &message.as_ref().unwrap().data;
                assert_eq!(*data, frame(sequence as u64).to_cdr(), "{length} bytes");
            }
            assert!(messages.len() >= most, "{length} bytes");
            most = messages.len();
        }
        assert_eq!(most, 12);
    }
}

#[test]
fn the_messages_of_a_truncated_chunk_are_kept() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("bag");
    let options = WriterOptions { compression: Compression::None, ..WriterOptions::default() };
    let mut bag = BagWriter::create(&path, options).unwrap();
    let topic = bag.topic("/particles", ParticleFrame::TYPE).unwrap();
    for time in 0..10 {
        bag.write(topic, Stamp(time), Stamp(time), &frame(time as u64).to_cdr()).unwrap();
    }
    bag.finish().unwrap();
    let whole = fs::read(path.join("bag_0.mcap")).unwrap();
    // All ten messages are in one chunk; this is near its middle.
    let cut = directory.path().join("cut.mcap");
    fs::write(&cut, &whole[..5_000]).unwrap();
    let bag = BagReader::open(&cut).unwrap();
    let frames: Vec<_> = bag.frames("/particles").unwrap().collect();
    assert!((3..7).contains(&frames.len()), "{}", frames.len());
    let message = frames.last().unwrap().as_ref().unwrap_err().to_string();
    let expected = format!(
        "{}: found the end of the file at byte 5000 after {} complete messages, expected a chunk of",
        cut.display(),
        frames.len() - 1
    );
    assert!(message.starts_with(&expected), "{message}");
}

#[test]
fn a_damaged_chunk_is_skipped_and_reported_at_the_end() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("bag");
    write_frames(&path, 40, Compression::None);
    let file = path.join("bag_0.mcap");
    let mut bytes = fs::read(&file).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0xff;
    fs::write(&file, bytes).unwrap();
    let messages: Vec<_> = BagReader::open(&path).unwrap().messages().collect();
    let (last, whole) = messages.split_last().unwrap();
    assert!(whole.len() > 30 && whole.iter().all(Result::is_ok), "{}", whole.len());
    let message = last.as_ref().unwrap_err().to_string();
    assert!(message.contains("found checksum"), "{message}");
    assert!(!findings(&path).is_empty());
}

#[test]
fn errors_name_file_topic_found_and_expected() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("bag");
    let mut bag = BagWriter::create(&path, WriterOptions::default()).unwrap();
    let words = bag.topic("/words", RosString::TYPE).unwrap();
    bag.topic("/particles", ParticleFrame::TYPE).unwrap();
    bag.write(words, Stamp(0), Stamp(0), &word("a")).unwrap();

    let conflict = bag.topic("/words", ParticleFrame::TYPE).unwrap_err().to_string();
    let unknown = bag.topic("/points", "acme_msgs/msg/Probe").unwrap_err().to_string();
    let early = bag.write(words, Stamp(-5), Stamp(0), &word("b")).unwrap_err().to_string();
    bag.finish().unwrap();
    let exists = BagWriter::create(&path, WriterOptions::default()).err().unwrap().to_string();
    let bag = BagReader::open(&path).unwrap();
    let frames = |topic: &str| bag.frames(topic).err().unwrap().to_string();
    let at = path.display();
    for (found, expected) in [
        (conflict, format!("{at}: topic /words: found type eddy_msgs/msg/ParticleFrame, expected std_msgs/msg/String")),
        (unknown, "topic /points: message type: found acme_msgs/msg/Probe, expected a type of one of the packages".into()),
        (early, format!("{at}: topic /words: log_time: found -5 ns, expected 0 or later")),
        (exists, format!("{at}: already exists; choose another output path or delete it")),
        (frames("/words"), format!("{at}: topic /words: found type std_msgs/msg/String, expected eddy_msgs/msg/ParticleFrame")),
        (frames("/truth"), format!("{at}: topics: found /particles (eddy_msgs/msg/ParticleFrame), /words (std_msgs/msg/String), expected /truth among them")),
        (frames("/particles"), format!("{at}: topic /particles: found 0 messages, expected at least 1")),
    ] {
        assert!(found.starts_with(&expected), "{found}");
    }
}

#[test]
fn other_files_are_rejected_with_their_kind() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    fs::write(at("text.mcap"), "not a bag at all").unwrap();
    fs::create_dir(at("empty")).unwrap();
    let open = |name: &str| BagReader::open(&at(name)).err().unwrap().to_string();
    assert!(
        open("text.mcap").contains("found the first bytes [6e, 6f, 74"),
        "{}",
        open("text.mcap")
    );
    assert!(open("empty").contains("found a directory without metadata.yaml"), "{}", open("empty"));
    assert!(open("gone").contains("opening the bag: No such file"), "{}", open("gone"));
}

/// A file of `/words` messages at `times`, written with MCAP's own writer.
fn write_foreign(path: &Path, times: &[u64], options: mcap::WriteOptions) {
    let stream = fs::File::create(path).unwrap();
    let mut writer = options.create(stream).unwrap();
    let schema = writer.add_schema(RosString::TYPE, "ros2msg", b"string data").unwrap();
    let channel = writer.add_channel(schema, "/words", "cdr", &BTreeMap::new()).unwrap();
    for &time in times {
        let header =
            MessageHeader { channel_id: channel, sequence: 0, log_time: time, publish_time: time };
        writer.write_to_known_channel(&header, &word(&time.to_string())).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn files_of_other_writers_are_read_without_optional_records() {
    let directory = tempfile::tempdir().unwrap();
    let new = || mcap::WriteOptions::new().chunk_size(Some(40));
    let cases = [
        ("whole", new()),
        ("no summary", new().emit_summary_records(false).emit_summary_offsets(false)),
        ("no statistics", new().emit_statistics(false)),
        ("no chunk indexes", new().emit_chunk_indexes(false)),
        ("no repeated channels", new().repeat_channels(false).repeat_schemas(false)),
        ("no message indexes", new().emit_message_indexes(false)),
        ("no checksums", new().calculate_chunk_crcs(false).calculate_data_section_crc(false)),
        (
            "no checksums or compression",
            new().calculate_chunk_crcs(false).calculate_data_section_crc(false).compression(None),
        ),
        // rosbag2's preset "fastwrite".
        ("no chunks", new().use_chunks(false)),
        ("no chunks, no summary", new().use_chunks(false).emit_summary_records(false)),
    ];
    let times = [5, 3, 9, 1, 4, 4, 8];
    for (name, options) in cases {
        let path = directory.path().join(format!("{name}.mcap"));
        write_foreign(&path, &times, options);
        let bag = BagReader::open(&path).unwrap();
        assert_eq!(
            (bag.message_count(), bag.start(), bag.end()),
            (7, Some(Stamp(1)), Some(Stamp(9)))
        );
        let found: Vec<i64> = plain(&path).iter().map(|message| message.1).collect();
        assert_eq!(found, [1, 3, 4, 4, 5, 8, 9], "{name}");
        assert_eq!(findings(&path), [""; 0], "{name}");
    }
}

/// A bag directory of several files, as rosbag2 splits them.
fn write_split(directory: &Path) -> PathBuf {
    let bag = directory.join("split");
    fs::create_dir(&bag).unwrap();
    write_foreign(&bag.join("split_0.mcap"), &[1, 2, 6], mcap::WriteOptions::new());
    write_foreign(&bag.join("split_1.mcap"), &[4, 5, 9], mcap::WriteOptions::new());
    let metadata = "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  \
        message_count: 6\n  relative_file_paths:\n    - split_0.mcap\n    - split_1.mcap\n";
    fs::write(bag.join("metadata.yaml"), metadata).unwrap();
    bag
}

#[test]
fn a_split_bag_is_read_as_one_in_the_order_of_time() {
    let directory = tempfile::tempdir().unwrap();
    let path = write_split(directory.path());
    let times: Vec<i64> = plain(&path).iter().map(|message| message.1).collect();
    assert_eq!(times, [1, 2, 4, 5, 6, 9]);
    assert_eq!(BagReader::open(&path).unwrap().topics()[0].message_count, 6);
    assert_eq!(findings(&path), [""; 0]);
}

#[test]
fn a_selection_takes_topics_and_times() {
    let directory = tempfile::tempdir().unwrap();
    let bag = BagReader::open(&write_split(directory.path())).unwrap();
    let times = |selection: &Selection| -> Vec<i64> {
        bag.select(selection).map(|message| message.unwrap().log_time.0).collect()
    };
    let (from, until) = (Some(Stamp(2)), Some(Stamp(5)));
    assert_eq!(times(&Selection { from, until, topics: None }), [2, 4, 5]);
    let none = Selection { topics: Some(vec!["/other".into()]), ..Selection::default() };
    assert_eq!(times(&none), [0; 0]);
}

#[test]
fn the_survey_reports_what_is_wrong_in_a_stream() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("bag");
    let mut bag = BagWriter::create(&path, WriterOptions::default()).unwrap();
    let topic = bag.topic("/particles", ParticleFrame::TYPE).unwrap();
    let mut nan = ParticleFrame::from(&frame(3));
    nan.velocity[5] = f32::NAN;
    let frozen = Frame { stamp: frame(4).stamp, ..frame(5) };
    let messages = [
        frame(0).to_cdr(),
        frame(1).to_cdr(),
        frame(1).to_cdr(),
        cdr::encode(&nan),
        frame(4).to_cdr(),
        frozen.to_cdr(),
        vec![1, 2, 3],
    ];
    for (time, data) in messages.iter().enumerate() {
        bag.write(topic, Stamp(time as i64), Stamp(time as i64), data).unwrap();
    }
    bag.finish().unwrap();
    assert_eq!(
        findings(&path),
        [
            "topic /particles, stream 4: found sequence 1 (repeated or late), expected 2",
            "topic /particles, message 3: stream 4, frame 3: velocity[2]: found NaN, expected a finite number",
            "topic /particles, stream 4: found sequence 4 after 1, expected 2",
            "topic /particles, stream 4: sequence 5: found stamp 0.064 s, expected more than 0.064 s",
            "topic /particles, message 6: CDR header: found [01, 02, 03], expected [00, 01, 00, 00] (plain CDR, little-endian) or [00, 00, 00, 00] (big-endian)",
        ]
    );
}
