//! What `metadata.yaml` and the files of a bag say of its topics and of the recording.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use eddy_bag::{BagReader, BagWriter, WriterOptions};
use eddy_frames::Stamp;
use eddy_messages::{Message, QosProfile, RosString, TypeSupport, qos::DurabilityPolicy};
use mcap::records::MessageHeader;

use crate::support::{findings, messages, recover, reindex, word};

const QOS: &str = "- history: keep_last\n  depth: 3\n  reliability: best_effort\n  durability: transient_local\n  \
    deadline:\n    sec: 9223372036\n    nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  \
    liveliness: automatic\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n  \
    avoid_ros_namespace_conventions: false\n";
const HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

/// A bag of three words at 1, 2 and 3 s, whose channel says `of_channel` and whose file repeats the text `in_file`.
fn write(folder: &Path, of_channel: &[(&str, &str)], in_file: Option<&str>) -> PathBuf {
    let path = folder.join("bag");
    fs::create_dir_all(&path).unwrap();
    let file = fs::File::create(path.join("bag_0.mcap")).unwrap();
    let mut writer = mcap::WriteOptions::new().create(file).unwrap();
    let schema = writer.add_schema(RosString::TYPE, "ros2msg", b"string data").unwrap();
    let of_channel: BTreeMap<_, _> =
        of_channel.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect();
    let channel_id = writer.add_channel(schema, "/words", "cdr", &of_channel).unwrap();
    for second in 1..=3 {
        let time = second * 1_000_000_000;
        let header = MessageHeader { channel_id, sequence: 0, log_time: time, publish_time: time };
        writer.write_to_known_channel(&header, &word("eddy")).unwrap();
    }
    if let Some(text) = in_file {
        let metadata = [("serialized_metadata".to_owned(), text.to_owned())].into();
        let record = mcap::records::Metadata { name: "rosbag2".to_owned(), metadata };
        writer.write_metadata(&record).unwrap();
    }
    writer.finish().unwrap();
    path
}

/// What rosbag2 writes about it.
fn yaml(qos: &str, hash: &str, distro: &str, custom_data: &str) -> String {
    let qos: String = qos.lines().map(|line| format!("          {line}\n")).collect();
    let profiles = if qos.is_empty() { " []\n".to_owned() } else { format!("\n{qos}") };
    format!(
        "rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n  duration:\n    nanoseconds: 2000000000\n  \
         starting_time:\n    nanoseconds_since_epoch: 1000000000\n  message_count: 3\n  topics_with_message_count:\n    \
         - topic_metadata:\n        name: /words\n        type: std_msgs/msg/String\n        serialization_format: cdr\n        \
         offered_qos_profiles:{profiles}        type_description_hash: \"{hash}\"\n      message_count: 3\n  \
         compression_format: \"\"\n  compression_mode: \"\"\n  relative_file_paths:\n    - bag_0.mcap\n  files:\n    \
         - path: bag_0.mcap\n      starting_time:\n        nanoseconds_since_epoch: 1000000000\n      duration:\n        \
         nanoseconds: 2000000000\n      message_count: 3\n  custom_data: {custom_data}\n  ros_distro: {distro}\n"
    )
}

fn describe(bag: &Path, text: &str) {
    fs::write(bag.join("metadata.yaml"), text).unwrap();
}

fn description(bag: &Path) -> String {
    fs::read_to_string(bag.join("metadata.yaml")).unwrap()
}

#[test]
fn what_only_the_metadata_says_is_read_copied_and_kept() {
    let folder = tempfile::tempdir().unwrap();
    let path = write(folder.path(), &[], None);
    describe(&path, &yaml(QOS, HASH, "jazzy", "{robot: r2}"));
    assert_eq!(findings(&path), [""; 0], "one of two is silent");
    let expected = |path: &Path| {
        let bag = BagReader::open(path).unwrap();
        let topic = &bag.topics()[0];
        assert_eq!(topic.hash.as_deref(), Some(HASH));
        let [QosProfile { durability, .. }] = topic.offered[..] else { panic!("{topic:?}") };
        assert_eq!(durability, DurabilityPolicy::TransientLocal);
        assert_eq!(bag.custom_data()["robot"], "r2");
        let text = description(path);
        for said in ["transient_local", HASH, "ros_distro: jazzy", "robot: r2"] {
            assert!(text.contains(said), "{said} in {text}");
        }
    };
    expected(&path);
    let saved = folder.path().join("saved");
    recover(&path, &saved).unwrap();
    expected(&saved);
    reindex(&path).unwrap();
    expected(&path);
    assert_eq!((findings(&path), findings(&saved)), (vec![], vec![]));
}

#[test]
fn what_only_the_file_says_is_read_and_kept() {
    let folder = tempfile::tempdir().unwrap();
    for (of_channel, hash) in [
        (vec![("offered_qos_profiles", QOS), ("topic_type_hash", HASH)], ""),
        // rosbag2 repeats the metadata in the file.
        (vec![], HASH),
    ] {
        let in_file = yaml(if hash.is_empty() { "" } else { QOS }, hash, "jazzy", "{robot: r2}");
        let path = write(folder.path(), &of_channel, Some(&in_file));
        for text in [Some(yaml("", "", "\"\"", "~")), None] {
            match text {
                Some(text) => describe(&path, &text),
                None => fs::remove_file(path.join("metadata.yaml")).unwrap(),
            }
            reindex(&path).unwrap();
            let text = description(&path);
            for said in ["transient_local", HASH, "ros_distro: jazzy", "robot: r2"] {
                assert!(text.contains(said), "{said} in {text}");
            }
            assert_eq!(findings(&path), [""; 0]);
        }
        fs::remove_dir_all(&path).unwrap();
    }
}

#[test]
#[expect(clippy::too_many_lines, reason = "one story: a bag, its edited metadata, what is found")]
fn metadata_that_a_user_edits_counts_and_is_a_finding() {
    let folder = tempfile::tempdir().unwrap();
    let said = [("offered_qos_profiles", QOS), ("topic_type_hash", HASH)];
    let path = write(folder.path(), &said, Some(&yaml(QOS, HASH, "jazzy", "{robot: r2}")));
    let volatile = QOS.replace("transient_local", "volatile");
    let other = format!("RIHS01_{}", "0".repeat(64));
    let good = yaml(QOS, HASH, "jazzy", "{robot: r2}");
    describe(&path, &good);
    assert_eq!(findings(&path), [""; 0]);
    for (text, expected) in [
        (
            yaml(&volatile, HASH, "jazzy", "{robot: r2}"),
            "other offered_qos_profiles than in the files",
        ),
        (yaml(QOS, &other, "jazzy", "{robot: r2}"), "type_description_hash: found RIHS01_000"),
        (yaml(QOS, HASH, "humble", "{robot: r2}"), "ros_distro: found humble, expected jazzy"),
        (yaml(QOS, HASH, "jazzy", "{robot: c3}"), "custom_data: robot: found c3, expected r2"),
        (
            good.replace("message_count: 3\n  topics", "message_count: 4\n  topics"),
            "message_count: found 4, expected the 3",
        ),
        (
            good.replace("message_count: 3\n  compression", "message_count: 4\n  compression"),
            "topic /words: found 4 messages",
        ),
        (
            good.replace("message_count: 3\n  custom", "message_count: 4\n  custom"),
            "bag_0.mcap: message_count: found 4",
        ),
        (good.replacen("epoch: 1", "epoch: 2", 1), "starting_time and duration: found 2000000000"),
        (
            good.replacen("nanoseconds: 2", "nanoseconds: 1", 1),
            "found 1000000000 and 1000000000 ns",
        ),
        (
            good.replace("name: /words", "name: /other"),
            "topic /other: found type std_msgs/msg/String, expected no such topic",
        ),
        (
            good.replace("type: std_msgs/msg/String", "type: std_msgs/msg/Int8"),
            "found type std_msgs/msg/Int8, expected std_msgs/msg/String",
        ),
    ] {
        assert_ne!(text, good, "{expected}");
        describe(&path, &text);
        let found = findings(&path);
        assert!(found.iter().any(|finding| finding.contains(expected)), "{expected}: {found:?}");
        // Either of the two mends it, and the metadata counts.
        let saved = folder.path().join("saved");
        recover(&path, &saved).unwrap();
        let left = findings(&saved);
        // A hash that is not that of the definition stays, and stays a finding.
        let is_left = |finding: &String| !finding.contains("hash of std_msgs/msg/String");
        assert!(!left.iter().any(is_left), "{expected}: {left:?}");
        let of = |path: &Path| (messages(path), BagReader::open(path).unwrap().topics().to_vec());
        assert_eq!(of(&saved), of(&path), "{expected}");
        fs::remove_dir_all(&saved).unwrap();
    }
    describe(&path, &yaml(&volatile, HASH, "humble", "{robot: c3}"));
    reindex(&path).unwrap();
    let text = description(&path);
    for said in ["durability: volatile", "ros_distro: humble", "robot: c3"] {
        assert!(text.contains(said), "{said} in {text}");
    }
}

#[test]
fn a_file_that_the_metadata_does_not_list_is_a_finding_and_listed_anew() {
    let folder = tempfile::tempdir().unwrap();
    let path = write(folder.path(), &[], None);
    describe(&path, &yaml("", "", "jazzy", "~"));
    fs::copy(path.join("bag_0.mcap"), path.join("bag_1.mcap")).unwrap();
    let found = findings(&path);
    assert!(found[0].contains("relative_file_paths: found no bag_1.mcap"), "{found:?}");
    reindex(&path).unwrap();
    assert_eq!((messages(&path).len(), findings(&path)), (6, vec![]));
}

#[test]
fn an_empty_storage_identifier_means_mcap() {
    let folder = tempfile::tempdir().unwrap();
    let path = write(folder.path(), &[], None);
    let text = yaml("", "", "jazzy", "~").replace("identifier: mcap", "identifier: \"\"");
    describe(&path, &text);
    assert_eq!(messages(&path).len(), 3);
    describe(&path, &text.replace("bag_0.mcap", "bag_0.db3"));
    let error = BagReader::open(&path).unwrap_err().to_string();
    assert!(error.contains("storage_identifier: found ``, expected mcap"), "{error}");
}

#[test]
fn messages_are_checked_by_the_definition_of_their_type() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bag");
    let mut bag = BagWriter::create(&path, WriterOptions::default()).unwrap();
    let pair = TypeSupport::from_schema("acme_msgs/msg/Pair", "float64 a\nfloat64 b\n").unwrap();
    let wide = TypeSupport::from_schema("acme_msgs/msg/Wide", "wstring a\n").unwrap();
    let pairs = bag.offered_topic("/pairs", &pair, &[]).unwrap();
    let names = bag.offered_topic("/wide", &wide, &[]).unwrap();
    // A built-in type without a definition in the bag.
    let bare = TypeSupport::foreign("geometry_msgs/msg/Point", "");
    let points = bag.offered_topic("/points", &bare, &[]).unwrap();
    let numbers = |count: usize| [&[0, 1, 0, 0][..], &vec![0; 8 * count]].concat();
    for (topic, data) in [
        (pairs, numbers(2)),
        (pairs, numbers(1)),
        (pairs, [&[0, 0, 0, 0][..], &[0; 16]].concat()),
        (pairs, numbers(3)),
        (points, numbers(3)),
        (points, numbers(2)),
        (names, numbers(1)),
    ] {
        bag.write(topic, Stamp(1), Stamp(1), &data).unwrap();
    }
    bag.finish().unwrap();
    assert_eq!(
        findings(&path),
        [
            "topic /pairs, message 1: acme_msgs/msg/Pair: b: found a message of 12 bytes, expected a longer one",
            "topic /pairs, message 3: acme_msgs/msg/Pair: found a message of 28 bytes, expected one of 20",
            "topic /points, message 1: geometry_msgs/msg/Point: z: found a message of 20 bytes, expected a longer one",
        ]
    );
}

#[test]
fn two_versions_of_a_type_on_a_topic_are_a_finding() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("versions.mcap");
    let mut writer = mcap::WriteOptions::new().create(fs::File::create(&path).unwrap()).unwrap();
    for (number, text) in [(0, "int32 a\n"), (1, "int32 a # the same\n"), (2, "int32 a\nint32 b\n")]
    {
        let schema = writer.add_schema("acme_msgs/msg/P", "ros2msg", text.as_bytes()).unwrap();
        let about = BTreeMap::from([("writer".to_owned(), number.to_string())]);
        let channel_id = writer.add_channel(schema, "/p", "cdr", &about).unwrap();
        let header = MessageHeader { channel_id, sequence: 0, log_time: number, publish_time: 1 };
        let data = [&[0, 1, 0, 0][..], &vec![0; if number < 2 { 4 } else { 8 }]].concat();
        writer.write_to_known_channel(&header, &data).unwrap();
    }
    writer.finish().unwrap();
    let found = findings(&path);
    let [finding] = &found[..] else { panic!("{found:?}") };
    assert!(finding.starts_with("topic /p: found 2 versions of acme_msgs/msg/P ("), "{finding}");
}

#[test]
fn pointers_of_git_lfs_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bag_0.mcap");
    fs::write(&file, "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 5\n")
        .unwrap();
    let error = BagReader::open(&file).unwrap_err().to_string();
    assert!(
        error
            .ends_with("found a pointer of Git LFS instead of the data; `git lfs pull` fetches it"),
        "{error}"
    );
}
