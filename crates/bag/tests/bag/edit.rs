//! Bags made from bags, and split bags.

use std::time::Duration;

use eddy_bag::{
    BagReader, BagWriter, Compression, CopyOptions, Selection, Split, WriterOptions, extract, merge,
};
use eddy_frames::Stamp;
use eddy_messages::{Message, RosString};
use proptest::prelude::*;

use crate::support::{
    Folder, copying, findings, messages, recover, reindex, word, write_foreign, write_split,
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
