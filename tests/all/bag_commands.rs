//! The commands of `eddy bag` that make and repair bags; `crates/bag/tests` has the tests of the library.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use eddy_bag::{BagReader, BagWriter, Split, WriterOptions};
use eddy_frames::{Frame, Stamp};
use eddy_messages::{FrameCdr, Message, ParticleFrame, RosString, TypeSupport, type_support};
use mcap::records::MessageHeader;

use crate::{
    bags::{
        Folder, about, auxiliary, calibration, messages, small_chunks, write_split,
        write_with_auxiliary,
    },
    support::{eddy, fail, findings, succeed, word},
};

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
    let dates = ["--start", "1970-01-01T00:00:01.1Z", "--end", "1970-01-01T00:00:01.25Z"];
    assert_eq!(cut("e", &dates), [1100, 1150, 1200]);
    assert_eq!(findings(&folder.join("a")), [""; 0]);
}

#[test]
fn names_in_a_bag_are_shown_and_not_obeyed_by_a_terminal() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("odd");
    let mut bag = BagWriter::create(&path, WriterOptions::default()).unwrap();
    let foreign = TypeSupport::foreign("acme_msgs/msg/\u{9b}2J", "");
    let topic = bag.offered_topic("/\u{1b}[31mred\nodd: 1 message, no problems", &foreign, &[]);
    bag.write(topic.unwrap(), Stamp(1), Stamp(1), &[0, 1, 0, 0]).unwrap();
    let word = bag.topic("/\u{1b}[2J", RosString::TYPE).unwrap();
    bag.write(word, Stamp(1), Stamp(1), &[0, 1, 0, 0, 9]).unwrap();
    bag.finish().unwrap();
    let bag = path.to_str().unwrap();
    for arguments in [
        vec!["bag", "info", bag],
        vec!["bag", "check", bag],
        vec!["bag", "filter", bag, "--topics", "/gone", "-o", "x"],
    ] {
        let output = eddy().args(&arguments).output().unwrap();
        let said = String::from_utf8([output.stdout, output.stderr].concat()).unwrap();
        assert!(!said.contains(|c: char| c.is_control() && c != '\n'), "{said:?}");
        assert!(said.contains("/\\u001b["), "{arguments:?}: {said}");
        if arguments[1] != "filter" {
            assert!(!said.lines().any(|line| line.starts_with("odd: 1 message")), "{said}");
        }
    }
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
fn a_merge_leaves_a_topic_of_another_type_out_names_it_and_says_so_in_its_exit_code() {
    let folder = Folder::new();
    let mut bag = BagWriter::create(&folder.join("other"), WriterOptions::default()).unwrap();
    let topic = bag.topic("/imu", RosString::TYPE).unwrap();
    bag.write(topic, Stamp(1), Stamp(1), &word("no imu")).unwrap();
    bag.finish().unwrap();
    let (whole, other, output) =
        (folder.path("whole.mcap"), folder.path("other"), folder.path("merged"));
    let outcome = eddy().args(["bag", "merge", &whole, &other, "-o", &output]).output().unwrap();
    // As `bag recover` ends when something is missing.
    assert_eq!(outcome.status.code(), Some(3));
    let said = String::from_utf8(outcome.stdout).unwrap();
    let expected = "topic /imu: found type std_msgs/msg/String (RIHS01_df668c";
    assert!(said.contains("left out: ") && said.contains(expected), "{said}");
    assert!(said.contains("expected acme_msgs/msg/Imu (RIHS01_77)"), "{said}");
    assert_eq!(messages(&folder.join("merged")), messages(&folder.join("whole.mcap")));
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
fn a_copy_that_does_not_fit_on_the_disk_leaves_nothing() {
    let folder = Folder::new();
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
fn the_exit_codes_of_a_recovery_are_those_of_mcap() {
    let folder = Folder::new();
    let bytes = fs::read(folder.join("whole.mcap")).unwrap();
    let cut = folder.join("cut.mcap");
    fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    fail(3, ["bag", "recover", &folder.path("cut.mcap"), "-o", &folder.path("half")]);
    fs::write(&cut, &bytes[..40]).unwrap();
    fail(1, ["bag", "recover", &folder.path("cut.mcap"), "-o", &folder.path("none")]);
    assert!(!folder.join("none").exists());
}

#[test]
fn damaged_metadata_is_replaced_by_reindexing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bag");
    write_split(&path, Split { size: Some(4_000), duration: None });
    let metadata = path.join("metadata.yaml");
    let before = fs::read_to_string(&metadata).unwrap();
    fs::write(&metadata, "rubbish").unwrap();
    succeed(["bag", "reindex", path.to_str().unwrap()]);
    assert_eq!(fs::read_to_string(&metadata).unwrap(), before);
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
        let expected = eddy_messages::cloud::to_cdr(&<Frame>::from_cdr(&frame.4).unwrap());
        assert_eq!((cloud.1, cloud.2, cloud.3), (frame.1, frame.2, frame.3), "number and times");
        assert!(cloud.4 == expected, "frame {}", frame.1);
    }
    let again = folder.path().join("again");
    let both = ["bag", "export", "--cloud", "bags/sample", "bags/sample"];
    assert!(fail(2, both).contains("--cloud: found 2 bags, expected one"));
    assert!(fail(2, ["bag", "export", "bags/sample"]).contains("--format"));
    let csv = ["bag", "export", "--cloud", "--format", "csv", "bags/sample"];
    assert!(fail(2, csv).contains("--cloud"));
    let message = fail(1, ["bag", "cloud", new, "--output", again.to_str().unwrap()]);
    assert!(message.contains("no topic of eddy_msgs/msg/ParticleFrame"), "{message}");
}

#[test]
fn attachments_and_metadata_go_with_the_messages() {
    let folder = Folder::new();
    write_with_auxiliary(&folder.join("one.mcap"), 0..60);
    write_with_auxiliary(&folder.join("two.mcap"), 100..160);
    let expected = (vec![calibration()], vec![about("place")]);
    for arguments in [
        vec!["cut", "one.mcap", "--start", "50ns"],
        vec!["filter", "one.mcap", "--topics", "/a"],
        vec!["merge", "one.mcap", "two.mcap"],
        vec!["recover", "one.mcap"],
    ] {
        let new = folder.path(&format!("{}ted", arguments[0]));
        let path = |word: &str| {
            if word.ends_with("mcap") { folder.path(word) } else { word.to_owned() }
        };
        let arguments: Vec<String> = arguments.into_iter().map(path).collect();
        let arguments =
            [&["bag".to_owned()], &arguments[..], &["-o".to_owned(), new.clone()]].concat();
        succeed(&arguments);
        assert_eq!(auxiliary(Path::new(&new)), expected, "{arguments:?}");
        let said = succeed(["bag", "info", &new]);
        assert!(said.contains("attachments  1\nmetadata     1\n"), "{said}");
    }
}

/// The limit is on the memory that the process asks for; the attachments together are more.
#[cfg(target_os = "linux")]
#[test]
fn attachments_of_any_size_together_are_saved_one_after_the_other() {
    const SIZE: usize = 8 << 20;
    const ATTACHMENTS: u8 = 20;
    let folder = Folder::new();
    let file = folder.join("large.mcap");
    let mut writer = small_chunks().create(fs::File::create(&file).unwrap()).unwrap();
    let channel_id = writer.add_channel(0, "/a", "json", &BTreeMap::new()).unwrap();
    let header = MessageHeader { channel_id, sequence: 0, log_time: 0, publish_time: 0 };
    writer.write_to_known_channel(&header, b"1").unwrap();
    for number in 0..ATTACHMENTS {
        let data = vec![number; SIZE].into();
        writer.attach(&mcap::Attachment { data, ..calibration() }).unwrap();
    }
    writer.finish().unwrap();
    let saved = folder.join("saved");
    let mut command = Command::new("sh");
    command.args(["-c", "ulimit -d 98304; exec \"$@\"", "sh"]).arg(eddy().get_program());
    command.args(["--quiet", "bag", "recover", file.to_str().unwrap()]);
    let output = command.args(["-o", saved.to_str().unwrap()]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let bag = BagReader::open(&saved).unwrap();
    assert_eq!(bag.auxiliary_counts(), [usize::from(ATTACHMENTS), 0]);
    assert!(bag.size() > SIZE as u64 * u64::from(ATTACHMENTS));
}

/// Compiles the library that makes a sector of a file unreadable.
#[cfg(target_os = "linux")]
fn bad_sector(folder: &Path) -> PathBuf {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/bad_sector.rs");
    let library = folder.join("bad_sector.so");
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let mut command = Command::new(rustc);
    command.args(["--edition=2024", "--crate-type=cdylib", "-Cpanic=abort", "-o"]);
    assert!(command.arg(&library).arg(source).status().unwrap().success());
    library
}

#[cfg(target_os = "linux")]
#[test]
fn a_sector_that_cannot_be_read_costs_the_chunks_that_it_is_in() {
    let folder = Folder::new();
    let library = bad_sector(folder.0.path());
    let summarized = mcap::WriteOptions::new().chunk_size(Some(5_000)).compression(None);
    let bare = summarized.clone().emit_summary_records(false).emit_summary_offsets(false);
    for (name, options) in [("summarized", summarized), ("bare", bare)] {
        let file = folder.join(&format!("{name}.mcap"));
        let mut writer = options.create(fs::File::create(&file).unwrap()).unwrap();
        let channel = writer.add_channel(0, "/a", "json", &BTreeMap::new()).unwrap();
        for sequence in 0..400 {
            let log_time = u64::from(sequence);
            let header = MessageHeader { channel_id: channel, sequence, log_time, publish_time: 0 };
            writer.write_to_known_channel(&header, &[b'!'; 1_000]).unwrap();
        }
        writer.finish().unwrap();
        let recover = |start: u64, end: u64| {
            let saved = folder.join(&format!("{name}_{start}"));
            let output = eddy()
                .args(["bag", "recover", file.to_str().unwrap(), "-o", saved.to_str().unwrap()])
                .env("LD_PRELOAD", &library)
                .env("BAD_SECTOR_FILE", &file)
                .env("BAD_SECTOR_START", start.to_string())
                .env("BAD_SECTOR_END", end.to_string())
                .output()
                .unwrap();
            let said = String::from_utf8(output.stdout).unwrap();
            assert_eq!(output.status.code(), Some(3), "{name}, byte {start}: {said}");
            assert!(said.contains("bytes that the disk cannot read"), "{name}: {said}");
            let numbers: Vec<u32> = messages(&saved).iter().map(|message| message.1).collect();
            assert_eq!(findings(&saved), [""; 0]);
            numbers
        };
        // In the middle, in the middle of a chunk or over the border of two.
        for start in [102_400, 204_800] {
            let numbers = recover(start, start + 4_096);
            assert!((380..=395).contains(&numbers.len()), "{name}: {}", numbers.len());
            assert_eq!((numbers[0], numbers[numbers.len() - 1]), (0, 399));
        }
    }
    // The beginning, with magic and topics, is repeated in the summary only.
    let file = folder.join("summarized.mcap");
    let saved = folder.join("beginning");
    let output = eddy()
        .args(["bag", "recover", file.to_str().unwrap(), "-o", saved.to_str().unwrap()])
        .env("LD_PRELOAD", &library)
        .env("BAD_SECTOR_FILE", &file)
        .env("BAD_SECTOR_START", "0")
        .env("BAD_SECTOR_END", "4096")
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(3), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(messages(&saved).len() >= 390);
}

#[test]
fn the_sample_has_the_definition_of_today() {
    let bag = BagReader::open("bags/sample".as_ref()).unwrap();
    let definitions: Vec<_> = bag.channels().iter().map(|it| it.schema.clone().unwrap()).collect();
    let [definition] = &definitions[..] else { panic!("one topic") };
    let expected = &type_support(ParticleFrame::TYPE).unwrap().schema;
    assert_eq!(
        String::from_utf8_lossy(&definition.data),
        *expected,
        "bags/README.md says how to make it"
    );
}

#[test]
fn equal_findings_are_grouped_and_a_loop_is_no_damage() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("looped");
    let frames: Vec<_> =
        BagReader::open("bags/sample".as_ref()).unwrap().frames("/particles").unwrap().collect();
    let frames: Vec<Frame> = frames.into_iter().take(20).map(Result::unwrap).collect();
    let write = |path: &Path, numbers: &[usize]| {
        let mut bag = BagWriter::create(path, WriterOptions::default()).unwrap();
        let topic = bag.topic("/particles", ParticleFrame::TYPE).unwrap();
        for (time, &number) in numbers.iter().enumerate() {
            let time = Stamp(1_700_000_000_000_000_000 + time as i64 * 16_000_000);
            bag.write(topic, time, time, &frames[number].to_cdr()).unwrap();
        }
        bag.finish().unwrap();
    };
    // Three passes.
    let passes: Vec<usize> = (0..60).map(|number| number % 20).collect();
    write(&path, &passes);
    let said = succeed(["bag", "check", path.to_str().unwrap()]);
    assert!(said.contains("topic /particles, stream 0: restarts 2 times, as in a loop"), "{said}");
    assert!(said.contains("60 messages, no problems found"), "{said}");

    let gaps = folder.path().join("gaps");
    write(&gaps, &[0, 2, 4, 6, 8, 10, 9]);
    let output = eddy().args(["bag", "check", gaps.to_str().unwrap()]).output().unwrap();
    let (said, error) = (String::from_utf8(output.stdout), String::from_utf8(output.stderr));
    let (said, error) = (said.unwrap(), error.unwrap());
    assert_eq!(
        said,
        "topic /particles, stream 0: found sequence 2 after 0, expected 1 (and 4 more of this kind)\n\
         topic /particles, stream 0: found sequence 9 (repeated or late), expected 11\n"
    );
    assert!(error.contains("gaps: 6 problems found"), "{error}");

    let unreadable = folder.path().join("unreadable");
    write(&unreadable, &[0]);
    fs::write(unreadable.join("metadata.yaml"), "not: a bag").unwrap();
    let output = eddy().args(["bag", "check"]).arg(folder.path()).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let (said, error) = (String::from_utf8(output.stdout), String::from_utf8(output.stderr));
    let (said, error) = (said.unwrap(), error.unwrap());
    assert!(said.contains("gaps: 6 problems found"), "{said}");
    assert!(said.contains("looped: 60 messages, no problems found"), "{said}");
    assert!(said.contains("unreadable/metadata.yaml"), "{said}");
    assert!(error.contains("2 of 3 bags have problems"), "{error}");

    let text = succeed(["bag", "info", path.to_str().unwrap()]);
    assert!(text.contains("start        2023-11-14T22:13:20Z (1700000000.000000000 s)"), "{text}");
    let json = succeed(["bag", "info", path.to_str().unwrap(), "--json"]);
    let info: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(info["start"]["utc"], "2023-11-14T22:13:20Z");
    assert_eq!(info["messages"], 60);
    let topic = &info["topics"][0];
    let bytes: usize = passes.iter().map(|&number| frames[number].to_cdr().len()).sum();
    assert_eq!((&topic["size"], &topic["topic"]), (&bytes.into(), &"/particles".into()));
    assert_eq!(topic["streams"][0]["restarts"], 2);
}
