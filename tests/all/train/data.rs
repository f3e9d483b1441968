//! Data larger than memory: the same windows, the same bits, and a bound that holds.

use std::fs;

use eddy_dataset::{Dataset, LoadOptions, Stream, load_trajectories};
use eddy_inference::checkpoint::{Architecture, Core};

use super::{load, run, small, stream, write_bag};

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
    let options = LoadOptions::within(memory);
    let all = load_trajectories(&data, options, &mut |_, _| ()).unwrap().streams;
    assert_eq!(held.digest, eddy_dataset::digest(&all, |_| ()).unwrap());

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
