//! What a file says twice, and differently: the messages count, `check` finds it, `reindex` or `recover` mends it.

use std::{fs, path::Path};

use eddy_bag::{BagReader, Selection};
use eddy_frames::Stamp;
use mcap::records::op;

use crate::{
    raw::{body, channel, chunk, data_section, file, message, number, summarized, with_number},
    support::{Folder, findings, messages, recover, reindex},
};

/// Log times of the messages of a selection.
fn times(path: &Path, from: i64, until: i64) -> Vec<i64> {
    let bag = BagReader::open(path).unwrap();
    let selection =
        Selection { from: Some(Stamp(from)), until: Some(Stamp(until)), ..Selection::default() };
    bag.select(&selection).map(|message| message.unwrap().log_time.0).collect()
}

#[test]
fn times_and_indexes_that_are_not_those_of_the_messages_lose_none() {
    let folder = Folder::new();
    let whole = folder.join("whole.mcap");
    let bytes = fs::read(&whole).unwrap();
    assert_eq!(findings(&whole), [""; 0]);
    let bag = BagReader::open(&whole).unwrap();
    let (all, span) = (messages(&whole), (bag.start(), bag.end()));
    // Fields of chunks, chunk indexes and statistics: MCAP specification, "Records".
    let at = |opcode, which, field| body(&bytes, opcode, which).start + field;
    let second = |field| number(&bytes, at(op::CHUNK_INDEX, 1, field));
    let lies = [
        ("a chunk index that ends too early", at(op::CHUNK_INDEX, 1, 8), second(0)),
        ("a chunk index that begins too late", at(op::CHUNK_INDEX, 1, 0), second(8)),
        ("a chunk index that begins at 0", at(op::CHUNK_INDEX, 1, 0), 0),
        ("a chunk that ends too early", at(op::CHUNK, 1, 8), second(0)),
        ("a chunk that begins too late", at(op::CHUNK, 1, 0), second(8)),
        ("a message index with another time", at(op::MESSAGE_INDEX, 3, 6), 5),
        ("a message index with another place", at(op::MESSAGE_INDEX, 3, 14), 5),
        ("statistics that begin too late", at(op::STATISTICS, 0, 26), second(8)),
        ("statistics that end too early", at(op::STATISTICS, 0, 34), second(0)),
        ("statistics of fewer messages", at(op::STATISTICS, 0, 0), 7),
        ("statistics of fewer messages of a channel", at(op::STATISTICS, 0, 48), 7),
    ];
    let lying = folder.join("lying.mcap");
    for (name, at, value) in lies {
        assert_ne!(number(&bytes, at), value, "{name}");
        let lie = with_number(&bytes, at, value);
        fs::write(&lying, &lie).unwrap();
        assert_eq!(messages(&lying), all, "{name}");
        let read = BagReader::open(&lying).unwrap();
        assert_eq!((read.start(), read.end()), span, "{name}");
        assert_eq!(read.message_count(), 60, "{name}");
        for (from, until) in [(1_000_000_000, 1_150_000_000), (1_200_000_000, 1_700_000_000)] {
            let expected: Vec<i64> = all.iter().map(|message| message.2).collect();
            let expected: Vec<i64> =
                expected.into_iter().filter(|time| (from..=until).contains(time)).collect();
            assert_eq!(times(&lying, from, until), expected, "{name}");
        }
        let found = findings(&lying);
        assert!((1..=3).contains(&found.len()), "{name}: {found:?}");
        assert!(found[0].contains("lying.mcap: byte "), "{found:?}");

        let saved = folder.join("saved");
        assert_eq!(recover(&lying, &saved).unwrap().losses, [""; 0], "{name}");
        assert_eq!((messages(&saved), findings(&saved)), (all.clone(), vec![]), "{name}");
        fs::remove_dir_all(&saved).unwrap();

        assert_eq!(reindex(&lying).unwrap().summarized, std::slice::from_ref(&lying), "{name}");
        assert_eq!((messages(&lying), findings(&lying)), (all.clone(), vec![]), "{name}");
        let mended = fs::read(&lying).unwrap();
        assert_eq!(mcap::Summary::read(&mended).unwrap().unwrap().chunk_indexes.len(), {
            mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes.len()
        });
        assert!(reindex(&lying).unwrap().summarized.is_empty(), "{name}");
    }
}

/// Two chunks that declare channel 1 as a topic each, with two messages each, and the summary of the second one.
fn twice_declared() -> [Vec<u8>; 3] {
    let part = |topic: &str, from: u64| {
        chunk("", &[channel(1, topic), message(1, from, b"1"), message(1, from + 1, b"2")])
    };
    let parts = [part("/left", 10), part("/right", 20)];
    let parts = [&parts[0][..], &parts[1][..]];
    let first = summarized(&parts, &channel(1, "/left"), &[(1, 4)]);
    [file(&parts), first, summarized(&parts, &channel(1, "/right"), &[(1, 4)])]
}

#[test]
fn messages_of_an_id_that_is_declared_twice_keep_their_topics() {
    let folder = Folder::new();
    for (number, bytes) in twice_declared().into_iter().enumerate() {
        let path = folder.join("twice.mcap");
        fs::write(&path, &bytes).unwrap();
        let read = |path: &Path| -> Vec<(String, i64)> {
            messages(path).into_iter().map(|message| (message.0, message.2)).collect()
        };
        let expected = [("/left", 10), ("/left", 11), ("/right", 20), ("/right", 21)];
        let expected = expected.map(|(topic, time)| (topic.to_owned(), time));
        assert_eq!(read(&path), expected, "{number}");
        let bag = BagReader::open(&path).unwrap();
        let topics = bag.topics().iter().map(|topic| (topic.name.as_str(), topic.message_count));
        assert_eq!(topics.collect::<Vec<_>>(), [("/left", 2), ("/right", 2)], "{number}");
        let found = findings(&path);
        assert!(found[0].contains("channel 1 of topic /left"), "{found:?}");
        let error = reindex(&path).unwrap_err().to_string();
        assert!(error.contains("one content for each id; `eddy bag recover`"), "{error}");
        assert_eq!(fs::read(&path).unwrap(), bytes);
        let saved = folder.join("saved");
        assert_eq!(recover(&path, &saved).unwrap().losses, [""; 0]);
        assert_eq!((read(&saved), findings(&saved)), (expected.to_vec(), vec![]), "{number}");
        fs::remove_dir_all(&saved).unwrap();
    }
}

#[test]
fn an_id_declared_again_within_a_chunk_or_without_chunks_changes_from_there_on() {
    let folder = Folder::new();
    let records = [
        channel(1, "/left"),
        message(1, 10, b"1"),
        channel(1, "/right"),
        message(1, 11, b"2"),
        channel(1, "/left"),
        message(1, 12, b"3"),
    ];
    let in_chunk = chunk("", &records);
    for bytes in [file(&[&in_chunk]), file(&[&records.concat()])] {
        let path = folder.join("twice.mcap");
        fs::write(&path, bytes).unwrap();
        let found: Vec<_> = messages(&path).into_iter().map(|message| message.0).collect();
        assert_eq!(found, ["/left", "/right", "/left"]);
    }
    // A summary section hides it from who does not read the chunk: an error, and no message under another name.
    let path = folder.join("hidden.mcap");
    fs::write(&path, summarized(&[&in_chunk], &channel(1, "/left"), &[(1, 3)])).unwrap();
    let bag = BagReader::open(&path).unwrap();
    let read: Vec<_> = bag.messages().collect();
    assert_eq!(read.iter().filter(|message| message.is_ok()).count(), 1);
    let error = read[1].as_ref().unwrap_err().to_string();
    assert!(error.contains("channel 1 of topic /right"), "{error}");
    assert!(!findings(&path).is_empty());
    let saved = folder.join("saved");
    recover(&path, &saved).unwrap();
    let found: Vec<_> = messages(&saved).into_iter().map(|message| message.0).collect();
    assert_eq!(found, ["/left", "/right", "/left"]);
}

#[test]
fn chunks_with_compression_none_are_read_and_mended() {
    let folder = Folder::new();
    let path = folder.join("none.mcap");
    let part = chunk("none", &[channel(1, "/left"), message(1, 10, b"1")]);
    for bytes in [file(&[&part]), summarized(&[&part], &channel(1, "/left"), &[(1, 1)])] {
        fs::write(&path, bytes).unwrap();
        assert_eq!(messages(&path).len(), 1);
        assert_eq!(BagReader::open(&path).unwrap().compressions().into_iter().next(), Some("none"));
        assert_eq!(findings(&path), [""; 0]);
    }
    // Cut off within the chunk.
    let bytes = file(&[&part]);
    fs::write(&path, &bytes[..bytes.len() - 80]).unwrap();
    assert!(BagReader::open(&path).unwrap().damage().is_some());
}

#[test]
fn the_parts_of_two_files_are_one_file() {
    let folder = Folder::new();
    let bytes = fs::read(folder.join("whole.mcap")).unwrap();
    let data = data_section(&bytes);
    let path = folder.join("doubled.mcap");
    fs::write(&path, file(&[data, data])).unwrap();
    assert_eq!(messages(&path).len(), 120);
    assert_eq!(findings(&path), [""; 0], "equal declarations contradict nothing");
}
