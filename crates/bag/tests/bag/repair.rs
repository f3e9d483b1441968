//! Recovering damaged bags, and reindexing.

use std::fs;

use eddy_bag::{
    BagError, BagReader, BagWriter, Compression, Recovery, Reindexing, Split, WriterOptions,
};
use eddy_frames::Stamp;
use eddy_messages::{Message, RosString};

use crate::support::{
    Folder, about, auxiliary, calibration, findings, messages, recover, reindex, small_chunks,
    word, write_foreign, write_split, write_with_auxiliary,
};

/// Start of the summary section of a finished file (bytes).
fn summary_start(bytes: &[u8]) -> usize {
    let footer = bytes.len() - 37;
    u64::from_le_bytes(bytes[footer + 9..footer + 17].try_into().unwrap()) as usize
}

/// A finished file with a footer that declares no summary section.
fn without_summary(bytes: &[u8]) -> Vec<u8> {
    let footer = [&[2][..], &20_u64.to_le_bytes(), &[0; 20], b"\x89MCAP0\r\n"].concat();
    [&bytes[..summary_start(bytes)], &footer].concat()
}

/// A file of chunks with another message outside chunks, at the end of the data section.
fn with_an_unchunked_message(bytes: &[u8]) -> Vec<u8> {
    let footer = bytes.len() - 37;
    let number = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
    let (summary, offsets) = (number(footer + 9), number(footer + 17));
    // The data end record, before the summary, takes 13 bytes.
    let data_end = summary as usize - 13;
    let mut record = vec![5];
    let body =
        [&1_u16.to_le_bytes()[..], &99_u32.to_le_bytes(), &[9; 16], &word("unchunked")].concat();
    record.extend_from_slice(&(body.len() as u64).to_le_bytes());
    record.extend_from_slice(&body);
    let mut mixed = [&bytes[..data_end], &record, &bytes[data_end..]].concat();
    let shift = record.len() as u64;
    let footer = footer + record.len();
    mixed[footer + 9..footer + 17].copy_from_slice(&(summary + shift).to_le_bytes());
    mixed[footer + 17..footer + 25].copy_from_slice(&(offsets + shift).to_le_bytes());
    // No checksum of the summary section.
    mixed[footer + 25..footer + 29].fill(0);
    mixed
}

#[test]
fn a_bag_truncated_anywhere_gives_back_its_complete_messages() {
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
    reindex(&path).unwrap();
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
    // mcap's own reader reads it.
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
        assert_eq!(kept.last(), whole.last(), "{name}: messages after the damage are kept");
        assert_eq!(findings(&saved), [""; 0], "{name}");
        fs::remove_dir_all(&saved).unwrap();
    }
}

#[test]
fn messages_outside_chunks_are_read_with_those_in_chunks() {
    let folder = Folder::new();
    let mixed = with_an_unchunked_message(&fs::read(folder.join("whole.mcap")).unwrap());
    fs::write(folder.join("mixed.mcap"), mixed).unwrap();
    let found = messages(&folder.join("mixed.mcap"));
    assert_eq!(found.len(), 61);
    assert!(found.iter().any(|message| message.1 == 99 && message.4 == word("unchunked")));
    let recovered = recover(&folder.join("mixed.mcap"), &folder.join("saved")).unwrap();
    assert_eq!((recovered.bag.messages, recovered.losses.len()), (61, 0));
}

#[test]
fn one_wrong_byte_costs_one_chunk_at_most() {
    let folder = Folder::new();
    let whole = messages(&folder.join("whole.mcap"));
    let bytes = fs::read(folder.join("whole.mcap")).unwrap();
    let (damaged, saved) = (folder.join("damaged.mcap"), folder.join("saved"));
    let most = {
        let index = mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes;
        60 / index.len() + 2
    };
    for (number, position) in (8..bytes.len()).step_by(11).enumerate() {
        let mut bytes = bytes.clone();
        bytes[position] ^= 1 << (number % 8);
        fs::write(&damaged, &bytes).unwrap();
        recover(&damaged, &saved).unwrap_or_else(|error| panic!("byte {position}: {error}"));
        let kept = messages(&saved);
        assert!(kept.len() + most >= 60, "byte {position}: {} messages", kept.len());
        let right = kept.iter().filter(|message| whole.contains(message)).count();
        // The wrong byte may be in a name in the summary section, which is not covered by the chunk checksums.
        assert!(right == kept.len() || kept.len() == 60, "byte {position}: {right} are right");
        fs::remove_dir_all(&saved).unwrap();
    }
}

#[test]
fn a_wrong_length_of_a_message_outside_chunks_costs_no_other() {
    let folder = Folder::new();
    let times: Vec<u64> = (0..60).map(|number| number * 1_000).collect();
    write_foreign(
        &folder.join("unchunked.mcap"),
        &times,
        mcap::WriteOptions::new().use_chunks(false),
    );
    let whole = messages(&folder.join("unchunked.mcap"));
    let bytes = fs::read(folder.join("unchunked.mcap")).unwrap();
    let start = bytes.windows(9).position(|w| w[0] == 5 && w[2..] == [0; 7]).unwrap();
    for (place, wrong) in [(1, 0xff), (2, 0x10), (5, 0x01), (8, 0x80)] {
        let mut bytes = bytes.clone();
        bytes[start + place] ^= wrong;
        fs::write(folder.join("damaged.mcap"), &bytes).unwrap();
        let recovered = recover(&folder.join("damaged.mcap"), &folder.join("saved")).unwrap();
        let kept = messages(&folder.join("saved"));
        assert_eq!(kept, whole[1..], "byte {place} of the first length");
        assert_eq!(recovered.losses.len(), 2, "{:?}", recovered.losses);
        fs::remove_dir_all(folder.join("saved")).unwrap();
    }
}

#[test]
fn a_bag_that_declares_more_messages_than_it_has_is_incomplete() {
    let folder = Folder::new();
    let bag = folder.join("bag");
    write_split(&bag, Split { size: Some(4_000), duration: None });
    fs::remove_file(bag.join("bag_1.mcap")).unwrap();
    let recovered = recover(&bag, &folder.join("saved")).unwrap();
    let kept = recovered.bag.messages;
    assert!(kept < 30);
    assert_eq!(
        recovered.losses,
        [format!("{}: found {kept} messages, expected the 30 declared", bag.display())]
    );
}

#[test]
fn a_wrong_opcode_that_hides_the_rest_is_damage_and_nothing_is_removed() {
    let folder = Folder::new();
    let file = folder.join("bag.mcap");
    write_with_auxiliary(&file, 0..60);
    let bytes = fs::read(&file).unwrap();
    let chunk = mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes[0].clone();
    let start = chunk.chunk_start_offset as usize;
    let after = start + chunk.chunk_length as usize;
    assert_eq!([bytes[start], bytes[after]], [6, 7], "a chunk, a message index");
    // Without a summary section that would reveal it. 2 is the footer, 15 the data end.
    for (place, wrong) in [(start, 2), (after, 15)] {
        let mut bytes = without_summary(&bytes);
        bytes[place] = wrong;
        fs::write(&file, &bytes).unwrap();
        assert!(reindex(&file).is_err(), "opcode {wrong}");
        assert_eq!(fs::read(&file).unwrap(), bytes);
        assert_ne!(findings(&file), [""; 0]);
    }
}

#[test]
fn a_reindexed_file_lists_its_attachments_and_metadata() {
    let folder = Folder::new();
    let file = folder.join("bag.mcap");
    write_with_auxiliary(&file, 0..60);
    let bytes = fs::read(&file).unwrap();
    fs::write(&file, without_summary(&bytes)).unwrap();
    assert_eq!(reindex(&file).unwrap().summarized, std::slice::from_ref(&file));
    assert_eq!(auxiliary(&file), (vec![calibration()], vec![about("rosbag2"), about("place")]));
    assert_eq!(findings(&file), [""; 0]);
}

#[test]
fn a_scan_and_a_copy_can_be_interrupted() {
    let folder = Folder::new();
    let bag = folder.join("bag.mcap");
    let times: Vec<u64> = (0..40_000).collect();
    let bare = mcap::WriteOptions::new().emit_summary_records(false).emit_summary_offsets(false);
    write_foreign(&bag, &times, bare.compression(None));
    let mut passed = 0;
    let mut twice = |bytes| {
        passed += bytes;
        passed < 2 << 20
    };
    let error = Reindexing::open(&bag, &mut twice).unwrap_err();
    assert!(matches!(error, BagError::Interrupted { .. }), "{error}");
    let error = Recovery::open(&bag, &mut |_| false).unwrap_err();
    assert!(matches!(error, BagError::Interrupted { .. }), "{error}");
    let (mut read, mut copied) = (0, 0);
    let mut count = |bytes| {
        read += bytes;
        true
    };
    let reindexing = Reindexing::open(&bag, &mut count).unwrap();
    let size = fs::metadata(&bag).unwrap().len();
    assert_eq!((read, reindexing.to_copy()), (size, size), "all of it is read once");
    let mut twice = |bytes| {
        copied += bytes;
        copied < 2 << 20
    };
    let error = reindexing.save(&mut twice).unwrap_err();
    assert!(error.to_string().ends_with("nothing was changed"), "{error}");
    assert_eq!(folder.names(), ["bag.mcap", "whole.mcap"]);
    assert_eq!(fs::metadata(&bag).unwrap().len(), size);
}

#[test]
fn an_interruption_between_two_files_reports_how_many_are_new() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    fs::create_dir(&bag).unwrap();
    let files = [bag.join("bag_0.mcap"), bag.join("bag_1.mcap")];
    for (file, start) in files.iter().zip([0, 1_000]) {
        let times: Vec<u64> = (start..start + 60).collect();
        let bare = small_chunks().emit_summary_records(false).emit_summary_offsets(false);
        write_foreign(file, &times, bare);
    }
    let before = files.each_ref().map(|file| fs::read(file).unwrap());
    let mut reported = Vec::new();
    let mut once = |bytes| {
        reported.push(bytes);
        reported.len() < 2
    };
    let error = Reindexing::open(&bag, &mut |_| true).unwrap().save(&mut once).unwrap_err();
    assert_eq!(reported, before.each_ref().map(|bytes| bytes.len() as u64));
    let expected = "interrupted after 1 of 2 files: these have a summary now, the other files and metadata.yaml \
                are unchanged";
    assert!(error.to_string().ends_with(expected), "{error}");
    assert_eq!(fs::read(&files[1]).unwrap(), before[1]);
    assert!(!bag.join("metadata.yaml").exists());
    assert_eq!(reindex(&bag).unwrap().summarized, [files[1].clone()]);
    assert_eq!(findings(&bag), [""; 0]);
}

/// Truncates a file of one chunk of compressible strings at each quarter.
#[test]
fn a_truncated_chunk_is_reported_in_every_compression() {
    let folder = tempfile::tempdir().unwrap();
    for compression in [Compression::None, Compression::Lz4, Compression::Zstd] {
        let bag = folder.path().join(format!("{compression:?}"));
        let options = WriterOptions { compression, chunk_size: 16 << 20, ..Default::default() };
        let mut writer = BagWriter::create(&bag, options).unwrap();
        let topic = writer.topic("/words", RosString::TYPE).unwrap();
        for number in 0..200 {
            let time = Stamp(number);
            let text = format!("{number:040000}{}", "!".repeat(number as usize));
            writer.write(topic, time, time, &word(&text)).unwrap();
        }
        let file = writer.finish().unwrap().files[0].path.clone();
        let whole = messages(&file);
        let bytes = fs::read(&file).unwrap();
        let index = &mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes;
        let [chunk] = &index[..] else { panic!("{} chunks", index.len()) };
        let mut most = 0;
        for quarter in 1..4 {
            let length = chunk.chunk_start_offset + chunk.chunk_length * quarter / 4;
            let cut = folder.path().join("cut.mcap");
            fs::write(&cut, &bytes[..length as usize]).unwrap();
            let damage = BagReader::open(&cut).unwrap().damage().unwrap();
            let expected =
                format!("expected a chunk of {} bytes from byte", chunk.chunk_length - 9);
            assert!(matches!(damage, BagError::Truncated { .. }), "{compression:?}: {damage}");
            assert!(damage.to_string().contains(&expected), "{compression:?}: {damage}");
            let saved = folder.path().join("saved");
            match recover(&cut, &saved) {
                Ok(recovered) => assert_eq!(recovered.losses, [damage.to_string()]),
                Err(error) => assert!(matches!(error, BagError::Nothing { .. }), "{error}"),
            }
            if saved.exists() {
                let kept = messages(&saved);
                assert_eq!(kept, whole[..kept.len()]);
                assert!(kept.len() > most, "{compression:?}, {quarter} quarters: {}", kept.len());
                most = kept.len();
                fs::remove_dir_all(&saved).unwrap();
            }
        }
        assert!(most >= 50, "{compression:?}: {most}");
    }
}

#[test]
fn every_damaged_chunk_is_reported_up_to_ten_with_the_number_of_the_others() {
    let folder = Folder::new();
    let times: Vec<u64> = (0..100).collect();
    write_foreign(&folder.join("long.mcap"), &times, small_chunks());
    let bytes = fs::read(folder.join("long.mcap")).unwrap();
    let chunks = mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes;
    assert!(chunks.len() > 15, "{}", chunks.len());
    // With a summary section, from which chunks are located, and without, when the whole file is scanned.
    for bare in [false, true] {
        for damaged in [3, 12] {
            let mut bytes = bytes.clone();
            let mut places = Vec::new();
            // The first chunks hold the channels.
            for chunk in &chunks[chunks.len() - damaged..] {
                let last = (chunk.chunk_start_offset + chunk.chunk_length) as usize - 5;
                bytes[last] ^= 0xff;
                places.push(format!("byte {}: found ", chunk.chunk_start_offset));
            }
            if bare {
                bytes = without_summary(&bytes);
            }
            let file = folder.join("damaged.mcap");
            fs::write(&file, &bytes).unwrap();
            let recovered = recover(&file, &folder.join("saved")).unwrap();
            fs::remove_dir_all(folder.join("saved")).unwrap();
            let (mut losses, path) = (recovered.losses, file.display());
            if !bare {
                let stated = losses.pop().unwrap();
                assert!(stated.ends_with("expected the 100 declared"), "{stated}");
            }
            if damaged > 10 {
                let more = format!("{path}: {} more errors, not listed", damaged - 10);
                assert_eq!(losses.pop(), Some(more));
            }
            assert_eq!(losses.len(), damaged.min(10), "{losses:?}");
            for (loss, place) in losses.iter().zip(places) {
                assert!(loss.starts_with(&format!("{path}: {place}")), "{loss}");
            }
        }
    }
}
