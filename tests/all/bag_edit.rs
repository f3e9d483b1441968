//! Bags made of bags: nothing of a message or of its topic changes on the way, and what fails leaves
//! nothing behind.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use eddy_bag::{
    BagError, BagReader, BagWriter, Channel, Compression, CopyOptions, Recovered, Recovery,
    Reindexed, Reindexing, Selection, Split, WriterOptions, extract, merge,
};
use eddy_frames::{Frame, Stamp};
use eddy_messages::{FrameCdr, Message, RosString};
use mcap::records::MessageHeader;
use proptest::prelude::*;
use tempfile::TempDir;

use crate::support::{eddy, fail, findings, succeed, word};

/// Everything about a message that must not change: topic, number, both times, data, description.
type Whole = (String, u32, i64, i64, Vec<u8>, Channel);

pub fn messages(path: &Path) -> Vec<Whole> {
    let messages = BagReader::open(path).unwrap().messages().map(Result::unwrap);
    messages
        .map(|m| {
            let (log, publish) = (m.log_time.0, m.publish_time.0);
            (m.topic.to_string(), m.sequence, log, publish, m.data, (*m.channel).clone())
        })
        .collect()
}

fn copying(go_on: &mut dyn FnMut() -> bool) -> CopyOptions<'_> {
    CopyOptions { writer: WriterOptions::default(), go_on }
}

pub fn recover(path: &Path, output: &Path) -> Result<Recovered, BagError> {
    Recovery::open(path, &mut |_| true)?.save(output, copying(&mut || true))
}

pub fn reindex(path: &Path) -> Result<Reindexed, BagError> {
    Reindexing::open(path, &mut |_| true)?.save(&mut |_| true)
}

/// What another program may have recorded: types we do not know, IDL definitions, its own numbers,
/// its own quality of service, a topic without a message.
pub fn write_foreign(path: &Path, times: &[u64], options: mcap::WriteOptions) {
    let mut writer = options.create(fs::File::create(path).unwrap()).unwrap();
    let imu = writer.add_schema("acme_msgs/msg/Imu", "ros2idl", b"module acme {};").unwrap();
    let of_words = writer.add_schema(RosString::TYPE, "ros2msg", b"string data").unwrap();
    let about = |hash: &str| {
        BTreeMap::from([
            ("offered_qos_profiles".to_owned(), "- history: 3\n  depth: 0\n".to_owned()),
            ("topic_type_hash".to_owned(), hash.to_owned()),
            ("driver".to_owned(), "v7".to_owned()),
        ])
    };
    let channels = [
        writer.add_channel(imu, "/imu", "cdr", &about("RIHS01_77")).unwrap(),
        writer.add_channel(of_words, "/words", "cdr", &about("")).unwrap(),
        writer.add_channel(0, "/untyped", "json", &BTreeMap::new()).unwrap(),
    ];
    writer.add_channel(of_words, "/silent", "cdr", &about("")).unwrap();
    for (number, &log_time) in (0..).zip(times) {
        let header = MessageHeader {
            channel_id: channels[number as usize % 3],
            sequence: 1_000 + 7 * number,
            log_time,
            publish_time: log_time / 2,
        };
        writer.write_to_known_channel(&header, &word(&number.to_string())).unwrap();
    }
    writer.finish().unwrap();
}

pub fn small_chunks() -> mcap::WriteOptions {
    mcap::WriteOptions::new().chunk_size(Some(200))
}

/// A folder with `whole.mcap`.
pub struct Folder(pub TempDir);

impl Folder {
    pub fn new() -> Self {
        let folder = Self(tempfile::tempdir().unwrap());
        let times: Vec<u64> = (0..60).map(|number| 1_000_000_000 + number * 50_000_000).collect();
        write_foreign(&folder.join("whole.mcap"), &times, small_chunks());
        folder
    }

    pub fn join(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    pub fn path(&self, name: &str) -> String {
        self.join(name).to_str().unwrap().to_owned()
    }

    pub fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.0.path()).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn the_parts_of_a_cut_bag_merge_into_the_whole(
        times in prop::collection::vec(0..40u64, 1..80),
        mut cuts in prop::collection::vec(0..40i64, 0..5),
        chunk_size in 40..2_000u64,
    ) {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        write_foreign(&at("whole.mcap"), &times, mcap::WriteOptions::new().chunk_size(Some(chunk_size)));
        let whole = BagReader::open(&at("whole.mcap")).unwrap();
        cuts.extend([0, 40]);
        cuts.sort_unstable();
        cuts.dedup();
        let mut parts = Vec::new();
        for ends in cuts.windows(2) {
            let (from, until) = (Some(Stamp(ends[0])), Some(Stamp(ends[1] - 1)));
            let part = at(&format!("part_{}", ends[0]));
            let selection = Selection { topics: None, from, until };
            if whole.select(&selection).next().is_some() {
                extract(&whole, &selection, &part, copying(&mut || true)).unwrap();
                parts.push(BagReader::open(&part).unwrap());
            }
        }
        merge(&parts, &at("merged"), copying(&mut || true)).unwrap();
        prop_assert_eq!(messages(&at("merged")), messages(&at("whole.mcap")));
        let merged = BagReader::open(&at("merged")).unwrap();
        prop_assert_eq!(merged.topics(), whole.topics());
        prop_assert_eq!(findings(&at("merged")), [""; 0]);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn no_file_of_a_split_bag_is_larger_than_asked_for(
        messages in prop::collection::vec((0..40usize, 0..3_000usize), 1..120),
        size in 3_000..60_000u64,
        chunk_size in 40..20_000u64,
        compression in prop::sample::select(vec![Compression::None, Compression::Lz4, Compression::Zstd]),
    ) {
        let folder = tempfile::tempdir().unwrap();
        let split = Split { size: Some(size), duration: None };
        let options = WriterOptions { compression, chunk_size, split };
        let mut bag = BagWriter::create(&folder.path().join("bag"), options).unwrap();
        let mut noise = 1_u32;
        for (time, (topic, length)) in messages.iter().enumerate() {
            let topic = bag.topic(&format!("/topic_{topic}"), RosString::TYPE).unwrap();
            // Bytes that no compression makes smaller.
            let data: Vec<u8> = (0..*length).map(|_| {
                noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (noise >> 24) as u8
            }).collect();
            bag.write(topic, Stamp(time as i64), Stamp(time as i64), &data).unwrap();
        }
        let summary = bag.finish().unwrap();
        prop_assert_eq!(summary.messages, messages.len() as u64);
        for file in summary.files.iter().filter(|file| file.messages > 1) {
            prop_assert!(file.size <= size, "{} messages take {}", file.messages, file.size);
        }
    }
}

#[test]
fn a_cut_keeps_the_start_and_leaves_out_the_end() {
    let folder = Folder::new();
    let (whole, log_times) = (folder.path("whole.mcap"), |bag: &str| -> Vec<i64> {
        messages(&folder.join(bag)).iter().map(|message| message.2 / 1_000_000).collect()
    });
    let cut = |bag: &str, arguments: &[&str]| {
        let output = folder.path(bag);
        succeed([&["bag", "cut", &whole, "-o", &output], arguments].concat());
        log_times(bag)
    };
    assert_eq!(cut("a", &["--start", "0.1", "--end", "0.25"]), [1100, 1150, 1200]);
    assert_eq!(cut("b", &["--start", "1100000000ns", "--duration", "0.15"]), [1100, 1150, 1200]);
    assert_eq!(cut("c", &["--start", "2.9"]), [3900, 3950]);
    assert_eq!(cut("d", &["--end", "1050000001ns"]), [1000, 1050]);
    assert_eq!(findings(&folder.join("a")), [""; 0]);
}

#[test]
fn a_filter_takes_names_and_patterns_and_keeps_their_descriptions() {
    let folder = Folder::new();
    let whole = folder.path("whole.mcap");
    let filter = |bag: &str, arguments: &[&str]| {
        let output = folder.path(bag);
        succeed([&["bag", "filter", &whole, "-o", &output], arguments].concat());
        let topics = BagReader::open(&folder.join(bag)).unwrap().topics().to_vec();
        topics.into_iter().map(|topic| topic.name).collect::<Vec<_>>()
    };
    assert_eq!(filter("a", &["--topics", "/imu", "/silent"]), ["/imu", "/silent"]);
    assert_eq!(filter("b", &["--regex", "^/(imu|w)"]), ["/imu", "/words"]);
    assert_eq!(filter("c", &["--exclude", "imu", "-x", "untyped"]), ["/silent", "/words"]);
    let expected: Vec<_> =
        messages(&folder.join("whole.mcap")).into_iter().filter(|m| m.0 == "/imu").collect();
    assert_eq!(expected.len(), 20);
    assert_eq!(messages(&folder.join("a")), expected);
    let unknown = fail(1, ["bag", "filter", &whole, "-o", &folder.path("d"), "--topics", "/gone"]);
    assert!(unknown.contains("--topics: found /gone, expected one of /imu, /silent"), "{unknown}");
}

#[test]
fn a_merge_refuses_a_topic_with_two_types_and_writes_nothing() {
    let folder = Folder::new();
    let mut bag = BagWriter::create(&folder.join("other"), WriterOptions::default()).unwrap();
    let topic = bag.topic("/imu", RosString::TYPE).unwrap();
    bag.write(topic, Stamp(1), Stamp(1), &word("no imu")).unwrap();
    bag.finish().unwrap();
    let before = folder.names();
    let (whole, other, output) =
        (folder.path("whole.mcap"), folder.path("other"), folder.path("merged"));
    let message = fail(1, ["bag", "merge", &whole, &other, "-o", &output]);
    let expected = "topic /imu: found type std_msgs/msg/String (RIHS01_df668c";
    assert!(message.contains(expected), "{message}");
    assert!(message.contains("expected acme_msgs/msg/Imu (RIHS01_77)"), "{message}");
    assert_eq!(folder.names(), before);
}

#[test]
fn what_is_there_is_never_overwritten_and_what_fails_leaves_nothing() {
    let folder = Folder::new();
    let whole = folder.path("whole.mcap");
    fs::create_dir(folder.join("taken")).unwrap();
    let bytes = fs::read(folder.join("whole.mcap")).unwrap();
    fs::write(folder.join("cut.mcap"), &bytes[..bytes.len() / 2]).unwrap();
    let before = folder.names();
    let (taken, cut, new) = (folder.path("taken"), folder.path("cut.mcap"), folder.path("new"));
    for (arguments, expected) in [
        (vec!["bag", "recover", &whole, "-o", &taken], "already exists"),
        (vec!["bag", "merge", &whole, &whole, "-o", &taken], "already exists"),
        (vec!["bag", "cut", &whole, "--start", "99", "-o", &new], "found no message"),
        (vec!["bag", "filter", &whole, "-x", "/", "-o", &new], "found no message"),
        (
            vec!["bag", "merge", &whole, &cut, "-o", &new],
            "`eddy bag recover` copies what can be read",
        ),
        (vec!["bag", "cut", &cut, "-o", &new], "found the end of the file"),
        (vec!["bag", "reindex", &cut], "`eddy bag recover` copies what can be read"),
    ] {
        let message = fail(1, arguments);
        assert!(message.contains(expected), "{message}");
        assert_eq!(folder.names(), before);
    }
    assert_eq!(fs::read(folder.join("whole.mcap")).unwrap(), bytes);
}

#[test]
fn a_copy_that_is_stopped_or_runs_out_of_room_leaves_nothing() {
    let folder = Folder::new();
    let whole = BagReader::open(&folder.join("whole.mcap")).unwrap();
    let mut copied = 0;
    let mut some = || {
        copied += 1;
        copied < 10
    };
    let stopped = extract(&whole, &Selection::default(), &folder.join("new"), copying(&mut some))
        .unwrap_err();
    assert!(stopped.to_string().contains("interrupted"), "{stopped}");
    assert_eq!(folder.names(), ["whole.mcap"]);

    // Files of at most 8 KiB: less than the messages take.
    let mut bag = BagWriter::create(&folder.join("long"), WriterOptions::default()).unwrap();
    let topic = bag.topic("/words", RosString::TYPE).unwrap();
    for time in 0..200 {
        let noise: String =
            (0..200).map(|i| char::from(33 + ((time * 31 + i * i * 7) % 90) as u8)).collect();
        bag.write(topic, Stamp(time), Stamp(time), &word(&noise)).unwrap();
    }
    bag.finish().unwrap();
    let before = folder.names();
    let program = eddy().get_program().to_owned();
    let output = Command::new("sh")
        .args(["-c", "ulimit -f 16; exec \"$@\"", "sh"])
        .arg(program)
        .args([
            "bag",
            "cut",
            &folder.path("long"),
            "--compression",
            "none",
            "-o",
            &folder.path("new"),
        ])
        .output()
        .unwrap();
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert!(message.contains("File too large"), "{message}");
    assert_eq!(folder.names(), before);
}

#[test]
fn a_whole_bag_is_recovered_as_it_is() {
    let folder = Folder::new();
    let printed =
        succeed(["bag", "recover", &folder.path("whole.mcap"), "-o", &folder.path("saved")]);
    assert!(printed.contains("60 messages on 4 topics"), "{printed}");
    assert_eq!(messages(&folder.join("saved")), messages(&folder.join("whole.mcap")));
}

#[test]
fn a_bag_cut_anywhere_gives_back_its_whole_messages_with_the_exit_codes_of_mcap() {
    let folder = Folder::new();
    let whole = messages(&folder.join("whole.mcap"));
    let bytes = fs::read(folder.join("whole.mcap")).unwrap();
    let (cut, saved) = (folder.join("cut.mcap"), folder.join("saved"));
    let mut most = 0;
    for length in (0..bytes.len()).step_by(97) {
        fs::write(&cut, &bytes[..length]).unwrap();
        match recover(&cut, &saved) {
            Ok(recovered) => {
                assert_eq!(recovered.losses.len(), 1, "{:?}", recovered.losses);
                let kept = messages(&saved);
                assert_eq!(kept, whole[..kept.len()]);
                assert!(kept.len() >= most, "{length} bytes");
                most = kept.len();
                assert_eq!(findings(&saved), [""; 0]);
                fs::remove_dir_all(&saved).unwrap();
            }
            Err(error) => {
                assert!(error.to_string().contains("found no message"), "{error}");
                assert!(most == 0 && !saved.exists());
            }
        }
        assert_eq!(fs::read(&cut).unwrap(), bytes[..length], "the bag itself is not touched");
    }
    assert_eq!(most, 60);

    fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    fail(3, ["bag", "recover", &folder.path("cut.mcap"), "-o", &folder.path("half")]);
    fs::write(&cut, &bytes[..40]).unwrap();
    fail(1, ["bag", "recover", &folder.path("cut.mcap"), "-o", &folder.path("none")]);
    assert!(!folder.join("none").exists());
}

#[test]
fn damage_in_the_middle_costs_its_chunk_and_no_other() {
    let folder = Folder::new();
    let whole = messages(&folder.join("whole.mcap"));
    let mut bytes = fs::read(folder.join("whole.mcap")).unwrap();
    let middle = bytes.len() / 3;
    bytes[middle] ^= 0xff;
    let damaged = folder.join("damaged.mcap");
    fs::write(&damaged, &bytes).unwrap();
    let recovered = recover(&damaged, &folder.join("saved")).unwrap();
    let kept = messages(&folder.join("saved"));
    assert!((50..60).contains(&kept.len()), "{}", kept.len());
    assert_eq!(recovered.losses.len(), 2);
    let counted = format!("found {} messages, expected the 60 declared", kept.len());
    assert!(recovered.losses[1].ends_with(&counted), "{:?}", recovered.losses);
    assert!(kept.iter().all(|message| whole.contains(message)));
    assert_eq!(findings(&folder.join("saved")), [""; 0]);
}

/// A split bag of 30 messages, and its files.
pub fn write_split(path: &Path, split: Split) -> Vec<PathBuf> {
    let compression = Compression::None;
    let options = WriterOptions { compression, chunk_size: 300, split };
    let mut bag = BagWriter::create(path, options).unwrap();
    let topic = bag.topic("/words", RosString::TYPE).unwrap();
    for number in 0..30 {
        if number == 20 {
            bag.topic("/later", RosString::TYPE).unwrap();
        }
        let time = Stamp(number * 100_000_000);
        bag.write(topic, time, time, &word(&format!("{number:0100}"))).unwrap();
    }
    let summary = bag.finish().unwrap();
    assert_eq!((summary.messages, summary.lost), (30, 0));
    summary.files.into_iter().map(|file| file.path).collect()
}

#[test]
fn a_bag_is_split_by_size_and_by_time_and_read_as_one() {
    let folder = tempfile::tempdir().unwrap();
    let by_size = folder.path().join("by_size");
    let files = write_split(&by_size, Split { size: Some(4_000), duration: None });
    assert!(files.len() > 2);
    assert!(
        files
            .iter()
            .enumerate()
            .all(|(n, file)| *file == by_size.join(format!("by_size_{n}.mcap")))
    );
    let by_time = folder.path().join("by_time");
    let duration = Some(Duration::from_secs(1));
    assert_eq!(write_split(&by_time, Split { size: None, duration }).len(), 3);
    for path in [&by_size, &by_time] {
        let found = messages(path);
        assert_eq!(found.len(), 30);
        assert!((1..).zip(&found).all(|(number, message)| message.1 == number), "numbers go on");
        assert_eq!(findings(path), [""; 0]);
    }
    let one = BagReader::open(&by_time.join("by_time_1.mcap")).unwrap();
    assert_eq!((one.start(), one.end()), (Some(Stamp(1_000_000_000)), Some(Stamp(1_900_000_000))));
}

#[test]
fn a_split_bag_without_its_metadata_is_reindexed_to_the_same_metadata() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bag");
    write_split(&path, Split { size: Some(4_000), duration: None });
    let metadata = path.join("metadata.yaml");
    let before = fs::read_to_string(&metadata).unwrap();
    fs::remove_file(&metadata).unwrap();
    assert!(reindex(&path).unwrap().summarized.is_empty());
    assert_eq!(fs::read_to_string(&metadata).unwrap(), before);
    fs::write(&metadata, "rubbish").unwrap();
    succeed(["bag", "reindex", path.to_str().unwrap()]);
    assert_eq!(fs::read_to_string(&metadata).unwrap(), before);
}

#[test]
fn files_without_a_summary_get_one_and_keep_their_messages() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    fs::create_dir(&bag).unwrap();
    let times: Vec<u64> = (0..60).map(|number| number * 1_000).collect();
    let file = bag.join("bag_0.mcap");
    let bare = small_chunks().emit_summary_records(false).emit_summary_offsets(false);
    write_foreign(&file, &times, bare);
    let (before, size) = (messages(&file), fs::metadata(&file).unwrap().len());
    assert_eq!(reindex(&bag).unwrap().summarized, std::slice::from_ref(&file));
    assert_eq!(messages(&bag), before);
    assert_eq!(findings(&bag), [""; 0]);
    assert!(fs::metadata(&file).unwrap().len() > size + 1_000);
    // MCAP's own reader finds in it what we put there.
    let summary = mcap::Summary::read(&fs::read(&file).unwrap()).unwrap().unwrap();
    assert_eq!(summary.stats.unwrap().message_count, 60);
    assert_eq!(summary.channels.len(), 4);
    assert!(summary.chunk_indexes.len() > 5);
    let indexed =
        summary.chunk_indexes.iter().filter(|chunk| !chunk.message_index_offsets.is_empty());
    assert!(indexed.count() > 5);
    assert!(reindex(&bag).unwrap().summarized.is_empty());
}

#[test]
fn damage_between_chunks_without_an_index_costs_what_it_hits() {
    let folder = Folder::new();
    let times: Vec<u64> = (0..60).map(|number| number * 1_000).collect();
    let bare = small_chunks().emit_summary_records(false).emit_summary_offsets(false);
    write_foreign(&folder.join("bare.mcap"), &times, bare);
    let whole = messages(&folder.join("bare.mcap"));
    let bytes = fs::read(folder.join("bare.mcap")).unwrap();
    let middle = bytes.len() / 2;
    for name in ["zeros", "ones", "a hole"] {
        let mut bytes = bytes.clone();
        match name {
            "zeros" => bytes[middle..middle + 300].fill(0),
            "ones" => bytes[middle..middle + 300].fill(0xff),
            _ => drop(bytes.drain(middle..middle + 300)),
        }
        fs::write(folder.join("damaged.mcap"), &bytes).unwrap();
        let saved = folder.join("saved");
        let recovered = recover(&folder.join("damaged.mcap"), &saved).unwrap();
        assert!((1..=3).contains(&recovered.losses.len()), "{name}: {:?}", recovered.losses);
        let kept = messages(&saved);
        assert!((50..60).contains(&kept.len()), "{name}: {}", kept.len());
        assert!(kept.iter().all(|message| whole.contains(message)), "{name}");
        assert_eq!(kept.last(), whole.last(), "{name}: what comes after the damage is kept");
        assert_eq!(findings(&saved), [""; 0], "{name}");
        fs::remove_dir_all(&saved).unwrap();
    }
}

#[test]
fn frames_get_clouds_beside_them_and_everything_else_stays_as_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("clouds");
    let new = output.to_str().unwrap();
    succeed(["bag", "export", "--cloud", "bags/sample", "--output", new]);
    assert_eq!(findings(&output), Vec::<String>::new());
    let (clouds, others): (Vec<_>, Vec<_>) =
        messages(&output).into_iter().partition(|(topic, ..)| topic == "/particles/cloud");
    assert_eq!(others, messages(Path::new("bags/sample")));
    let frames: Vec<_> = others.iter().filter(|(topic, ..)| topic == "/particles").collect();
    assert_eq!(clouds.len(), frames.len());
    for (cloud, frame) in clouds.iter().zip(frames) {
        let expected = eddy_messages::cloud::to_cdr(&Frame::from_cdr(&frame.4).unwrap());
        assert_eq!((cloud.1, cloud.2, cloud.3), (frame.1, frame.2, frame.3), "number and times");
        assert!(cloud.4 == expected, "frame {}", frame.1);
    }
    let again = folder.path().join("again");
    let both = ["bag", "export", "--cloud", "bags/sample", "bags/sample"];
    assert!(fail(1, both).contains("--cloud: found 2 bags, expected one"));
    assert!(fail(2, ["bag", "export", "bags/sample"]).contains("--format"));
    let csv = ["bag", "export", "--cloud", "--format", "csv", "bags/sample"];
    assert!(fail(2, csv).contains("--cloud"));
    let message = fail(1, ["bag", "cloud", new, "--output", again.to_str().unwrap()]);
    assert!(message.contains("no topic of eddy_msgs/msg/ParticleFrame"), "{message}");
}
