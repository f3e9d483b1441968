//! Data larger than memory: the same windows, the same bits, and a bound that holds.

use std::fs;

use eddy_evaluation::dataset::{Dataset, Stream, load_trajectories};
use eddy_inference::checkpoint::{Architecture, Core};

use super::{DT, FRAMES, load, run, small, stream, write_bag};

/// Size of the frames of these streams in memory (bytes).
fn size(streams: &[Stream]) -> u64 {
    let frame = |stream: &Stream| 48 + 16 * stream.material.len();
    streams.iter().map(|stream| stream.states.len() * frame(stream)).sum::<usize>() as u64
}

/// Five times as many frames as [`stream`], by repetition, so that a stream has several blocks.
fn long(id: u64) -> Stream {
    let mut stream = stream(id);
    stream.states = vec![stream.states; 5].concat();
    stream
}

fn ids(streams: &[eddy_evaluation::dataset::Trajectory]) -> Vec<(u64, u64, usize)> {
    streams.iter().map(|stream| (stream.id, stream.first_sequence, stream.frames)).collect()
}

#[test]
fn what_is_on_disk_teaches_the_bits_of_what_is_in_memory() {
    let folder = tempfile::tempdir().unwrap();
    let streams: Vec<_> = (0..8).map(long).collect();
    write_bag(&folder.path().join("even"), &streams.iter().step_by(2).cloned().collect::<Vec<_>>());
    write_bag(
        &folder.path().join("odd"),
        &streams.iter().skip(1).step_by(2).cloned().collect::<Vec<_>>(),
    );
    let data = [folder.path().to_owned()];
    let memory = size(&streams) / 5;
    let (held, stored) = (load(&data, u64::MAX).unwrap(), load(&data, memory).unwrap());
    assert!(held.frame_store().is_none());
    assert_eq!(held.digest, stored.digest);
    assert_eq!(held.normalization, stored.normalization);
    let all = load_trajectories(&data, memory, &mut |_, _| ()).unwrap();
    assert_eq!(held.digest, eddy_evaluation::dataset::digest(&all, |_| ()).unwrap());

    for architecture in [Architecture::Particle, Architecture::Frame] {
        let mut config = small(architecture, Core::MinGru);
        config.epochs = 2;
        config.windows.per_epoch = 64;
        let outcome = |dataset: &Dataset, name: &str| {
            let output = folder.path().join(format!("{architecture:?}{name}"));
            let outcome = run(&config, dataset, &output).unwrap();
            (outcome, fs::read(output.join("last/model.safetensors")).unwrap())
        };
        let (from_memory, from_disk) = (outcome(&held, "held"), outcome(&stored, "stored"));
        assert_eq!(from_memory.0.epochs, from_disk.0.epochs, "{architecture:?}");
        assert!(from_memory.1 == from_disk.1, "{architecture:?}: other weights");
    }

    let usage = stored.frame_store().unwrap().cache_usage();
    assert!(usage.reads > 30, "{usage:?}: nothing was read twice");
    assert!(usage.most_bytes <= memory, "{usage:?}, at most {memory}");
    assert!(usage.frames as u64 * (48 + 16 * 24) <= memory, "{usage:?}");
}

#[test]
fn a_limit_below_one_block_still_trains_with_one_block_in_memory() {
    let folder = tempfile::tempdir().unwrap();
    write_bag(&folder.path().join("bag"), &[0, 1, 2].map(long));
    let data = [folder.path().join("bag")];
    let (held, stored) = (load(&data, u64::MAX).unwrap(), load(&data, 1).unwrap());
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.epochs = 1;
    config.windows.per_epoch = 16;
    let outcome = |dataset, name: &str| run(&config, dataset, &folder.path().join(name)).unwrap();
    assert_eq!(outcome(&held, "held").epochs, outcome(&stored, "stored").epochs);
    let usage = stored.frame_store().unwrap().cache_usage();
    assert!(usage.frames <= 64, "{usage:?}");
}

#[test]
fn streams_on_disk_are_cut_where_those_in_memory_are() {
    let folder = tempfile::tempdir().unwrap();
    // One stream with a frame missing, one whose sequence begins again, one as it should be.
    let mut first = stream(0);
    first.states.truncate(10);
    let mut rest = stream(0);
    rest.first_sequence = 11;
    rest.first_stamp = rest.first_stamp.advance(DT, 11);
    let mut again = stream(1);
    again.first_stamp = again.first_stamp.advance(DT, FRAMES as u32);
    write_bag(&folder.path().join("cut"), &[first, rest, stream(1), again, stream(2)]);
    let data = [folder.path().join("cut")];
    let (held, stored) = (load(&data, u64::MAX).unwrap(), load(&data, 1).unwrap());
    assert_eq!(held.digest, stored.digest);
    assert_eq!(held.normalization, stored.normalization);
    for (held, stored) in [(&held.train, &stored.train), (&held.validation, &stored.validation)] {
        assert_eq!(ids(held), ids(stored));
        for (held, stored) in held.iter().zip(stored) {
            let all = 0..held.frames;
            assert_eq!(held.bounds, stored.bounds);
            let (held, stored) = (held.cut(all.clone()).unwrap(), stored.cut(all).unwrap());
            assert_eq!(held.states, stored.states);
            assert_eq!(held.first_stamp, stored.first_stamp);
        }
    }
    assert_eq!(ids(&held.train), [(0, 0, 10), (0, 11, 40)]);
    assert_eq!(ids(&held.validation), [(1, 0, 40), (1, 0, 40)]);
}

#[test]
fn a_bag_that_changes_while_it_is_learned_from_is_noticed() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    write_bag(&bag, &[0, 1, 2].map(stream));
    let stored = load(std::slice::from_ref(&bag), 1).unwrap();
    fs::remove_dir_all(&bag).unwrap();
    let mut others = [0, 1, 2].map(stream);
    for stream in &mut others {
        stream.states.reverse();
    }
    write_bag(&bag, &others);
    // Two blocks do not fit: the first stream is not in memory any more.
    let message = stored.train[0].cut(0..10).unwrap_err().to_string();
    assert!(message.contains("bag") && message.contains("stream 0"), "{message}");
}

#[test]
fn one_stream_that_begins_pressed_together_does_not_set_the_spacing() {
    let folder = tempfile::tempdir().unwrap();
    let mut streams: Vec<_> = (0..5).map(|id| Stream { id, ..stream(1) }).collect();
    write_bag(&folder.path().join("as-they-are"), &streams);
    for state in &mut streams[0].states {
        for position in &mut state.position {
            *position = position.map(|x| 0.4 + 0.1 * x);
        }
    }
    write_bag(&folder.path().join("pressed"), &streams);
    let spacing = |name: &str| load(&[folder.path().join(name)], u64::MAX).unwrap().spacing;
    assert_eq!(spacing("pressed"), spacing("as-they-are"));
    assert!(spacing("pressed") > 0.0 && spacing("pressed").is_finite());
}
