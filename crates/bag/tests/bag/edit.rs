//! Bags made from bags, and split bags.

use std::{fs, path::Path, time::Duration};

use eddy_bag::{
    BagError, BagReader, BagWriter, Compression, CopyOptions, Selection, Split, WriterOptions,
    extract, merge,
};
use eddy_frames::Stamp;
use eddy_messages::{
    Message, QosProfile, RosString,
    qos::{DurabilityPolicy, HistoryPolicy, ReliabilityPolicy},
    type_support,
};
use proptest::prelude::*;

use crate::support::{
    Folder, Whole, copying, findings, messages, recover, reindex, word, write_foreign, write_split,
};

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn parts_of_a_bag_merge_into_the_whole(
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
    fn no_file_of_a_split_bag_exceeds_the_limit(
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
            // Incompressible bytes.
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
        assert!(
            (1..).zip(&found).all(|(number, message)| message.1 == number),
            "sequence numbers continue"
        );
        assert_eq!(findings(path), [""; 0]);
    }
    let one = BagReader::open(&by_time.join("by_time_1.mcap")).unwrap();
    assert_eq!((one.start(), one.end()), (Some(Stamp(1_000_000_000)), Some(Stamp(1_900_000_000))));
}

#[test]
fn copies_keep_the_custom_data_that_all_bags_have_but_not_what_was_lost() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for (name, run) in [("one", "7"), ("two", "8")] {
        let mut bag = BagWriter::create(&at(name), WriterOptions::default()).unwrap();
        let topic = bag.topic("/words", RosString::TYPE).unwrap();
        bag.write(topic, Stamp(1), Stamp(1), &word("once")).unwrap();
        bag.set_custom_data("run", run.into());
        bag.set_custom_data("robot", "arm 3: left".into());
        bag.count_dropped(7);
        bag.finish().unwrap();
    }
    let open = |name: &str| BagReader::open(&at(name)).unwrap();
    let custom_data = |name: &str| {
        let bag = open(name);
        let entries = bag.custom_data().iter();
        entries.map(|(key, value)| format!("{key}={value}")).collect::<Vec<_>>()
    };
    assert!(custom_data("one").contains(&"eddy_messages_not_recorded=7".to_owned()));
    let all = Selection::default();
    extract(&open("one"), &all, &at("part"), copying(&mut || true)).unwrap();
    assert_eq!(custom_data("part"), ["robot=arm 3: left", "run=7"]);
    recover(&at("one"), &at("recovered")).unwrap();
    assert_eq!(custom_data("recovered"), ["robot=arm 3: left", "run=7"]);
    merge(&[open("one"), open("two")], &at("both"), copying(&mut || true)).unwrap();
    assert_eq!(custom_data("both"), ["robot=arm 3: left"]);
    let given = [("run", "both"), ("place", "hall")];
    let given = given.map(|(key, value)| (key.to_owned(), value.to_owned())).into();
    let mut all_of_them = || true;
    let options = CopyOptions { custom_data: given, ..copying(&mut all_of_them) };
    merge(&[open("one"), open("two")], &at("given"), options).unwrap();
    assert_eq!(custom_data("given"), ["place=hall", "robot=arm 3: left", "run=both"]);
    reindex(&at("given")).unwrap();
    assert_eq!(custom_data("given"), ["place=hall", "robot=arm 3: left", "run=both"]);
    let file = open("one").files().next().unwrap().to_owned();
    assert!(BagReader::open(&file).unwrap().custom_data().is_empty(), "a file of a bag");
}

#[test]
fn a_stopped_copy_leaves_nothing() {
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
}

/// QoS of publishers that keep their last two messages.
const LATCHED: QosProfile = QosProfile {
    reliability: ReliabilityPolicy::Reliable,
    durability: DurabilityPolicy::TransientLocal,
    history: HistoryPolicy::KeepLast(2),
};

/// A bag with words on `/map`, whose publisher keeps two messages, at 1, 2, 3 and 40 s, and on `/odom`, whose publisher keeps
/// none, at every second up to 59 s, in chunks of a few messages.
fn write_latched(path: &Path, split: Option<Duration>) {
    let split = Split { size: None, duration: split };
    let options = WriterOptions { chunk_size: 200, split, ..WriterOptions::default() };
    let mut bag = BagWriter::create(path, options).unwrap();
    let words = type_support(RosString::TYPE).unwrap();
    let map = bag.offered_topic("/map", words, &[LATCHED]).unwrap();
    let odom = bag.offered_topic("/odom", words, &[QosProfile::default()]).unwrap();
    for second in 0..60 {
        let stamp = Stamp(second * 1_000_000_000);
        if [1, 2, 3, 40].contains(&second) {
            bag.write(map, stamp, stamp, &word(&second.to_string())).unwrap();
        }
        bag.write(odom, stamp, stamp, &word("here")).unwrap();
    }
    bag.finish().unwrap();
}

fn of_map(messages: &[Whole]) -> Vec<(i64, i64, &[u8])> {
    let seconds = |time: i64| time / 1_000_000_000;
    let of_map = messages.iter().filter(|message| message.0 == "/map");
    of_map
        .map(|(_, _, log, publish, data, _)| (seconds(*log), seconds(*publish), &data[..]))
        .collect()
}

#[test]
fn a_part_of_a_bag_begins_with_what_its_publishers_had_kept() {
    let folder = tempfile::tempdir().unwrap();
    for split in [None, Some(Duration::from_secs(9))] {
        let path = folder.path().join(format!("bag_{}", split.is_some()));
        write_latched(&path, split);
        let bag = BagReader::open(&path).unwrap();
        let [one, two, three, forty] = ["1", "2", "3", "40"].map(word);
        for (start, expected) in [
            (0, vec![(1, 1, &one), (2, 2, &two), (3, 3, &three), (40, 40, &forty)]),
            (1, vec![(1, 1, &one), (2, 2, &two), (3, 3, &three), (40, 40, &forty)]),
            (2, vec![(2, 1, &one), (2, 2, &two), (3, 3, &three), (40, 40, &forty)]),
            (30, vec![(30, 2, &two), (30, 3, &three), (40, 40, &forty)]),
            (41, vec![(41, 3, &three), (41, 40, &forty)]),
        ] {
            let selection =
                Selection { from: Some(Stamp(start * 1_000_000_000)), ..Selection::default() };
            let part = path.with_extension(start.to_string());
            extract(&bag, &selection, &part, copying(&mut || true)).unwrap();
            let found = messages(&part);
            let expected: Vec<_> = expected
                .into_iter()
                .map(|(log, publish, data)| (log, publish, &data[..]))
                .collect();
            assert_eq!(of_map(&found), expected, "from {start} s");
            let others = found.len() - expected.len();
            assert_eq!(others as i64, 60 - start);
            assert_eq!(findings(&part), [""; 0]);
        }
        // Without a message in the selected time, nothing is written.
        let after = Selection { from: Some(Stamp(i64::MAX)), ..Selection::default() };
        let nothing = extract(&bag, &after, &path.with_extension("after"), copying(&mut || true));
        assert!(matches!(nothing, Err(BagError::Nothing { .. })), "{nothing:?}");
    }
}

#[test]
fn what_publishers_had_kept_is_that_of_the_selected_topics() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bag");
    write_latched(&path, None);
    let bag = BagReader::open(&path).unwrap();
    let topics = Some(vec!["/odom".to_owned()]);
    let selection = Selection { topics, from: Some(Stamp(30_000_000_000)), until: None };
    let part = path.with_extension("part");
    extract(&bag, &selection, &part, copying(&mut || true)).unwrap();
    assert_eq!(of_map(&messages(&part)), []);
}

#[test]
fn only_blocks_that_hold_a_kept_message_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bag");
    write_latched(&path, None);
    let file = path.join("bag_0.mcap");
    // Damage in the middle of the file: between 3 and 40 s there are chunks of `/odom` only.
    let mut bytes = fs::read(&file).unwrap();
    let middle = bytes.len() / 4;
    bytes[middle..middle + 16].fill(0xaa);
    fs::write(&file, &bytes).unwrap();
    let bag = BagReader::open(&path).unwrap();
    assert!(bag.messages().any(|message| message.is_err()), "the damage is met");
    let kept = bag.kept_at(Stamp(30_000_000_000), |topic| topic.kept());
    let kept: Vec<_> = kept.into_iter().map(|message| message.unwrap().data).collect();
    assert_eq!(kept, [word("2"), word("3")]);
}

#[test]
fn a_topic_with_another_type_than_in_the_first_bag_is_left_out_of_a_merge_and_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for (name, kind, times) in
        [("one", RosString::TYPE, [1, 3]), ("two", "std_msgs/msg/Int32", [2, 4])]
    {
        let mut bag = BagWriter::create(&at(name), WriterOptions::default()).unwrap();
        let odd = bag.topic("/odd", kind).unwrap();
        let words = bag.topic("/words", RosString::TYPE).unwrap();
        for time in times.map(Stamp) {
            bag.write(odd, time, time, &word(name)).unwrap();
            bag.write(words, time, time, &word(name)).unwrap();
        }
        bag.finish().unwrap();
    }
    let bags = ["one", "two"].map(|name| BagReader::open(&at(name)).unwrap());
    let merged = merge(&bags, &at("both"), copying(&mut || true)).unwrap();
    let reasons: Vec<_> = merged.left_out.iter().map(ToString::to_string).collect();
    assert_eq!(reasons.len(), 1);
    let expected = "topic /odd: found type std_msgs/msg/Int32 (RIHS01_";
    assert!(reasons[0].contains(expected), "{reasons:?}");
    let found = messages(&at("both"));
    let found: Vec<_> = found.iter().map(|message| (message.0.as_str(), message.2)).collect();
    let expected =
        [("/odd", 1), ("/words", 1), ("/words", 2), ("/odd", 3), ("/words", 3), ("/words", 4)];
    assert_eq!(found, expected);
    assert_eq!(findings(&at("both")), [""; 0]);
}
