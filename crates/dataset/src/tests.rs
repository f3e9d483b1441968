use std::{
    fs,
    path::{Path, PathBuf},
};

use super::*;
use crate::test_streams::simulated;
use eddy_bag::{BagReader, BagWriter, Compression, WriterOptions};
use eddy_frames::{Domain, Stamp};
use eddy_messages::{FrameCdr, Message, ParticleFrame};
use eddy_mpm::{Extent, Preset};

const DT: f32 = 0.016;
const FRAMES: usize = 40;
const PARTICLES: usize = 24;

/// Particles that move uniformly.
fn stream(id: u64) -> Stream {
    let fraction = |i: usize, step: f32| (0.37 * (i as f32 + 1.0) + step * id as f32).fract();
    let start = |i| [0.2 + 0.3 * fraction(i, 0.11), 0.3 + 0.3 * fraction(i, 0.23)];
    let velocity: Vec<[f32; 2]> =
        (0..PARTICLES).map(|i| [0.4 * fraction(i, 0.31), 0.2 * fraction(i, 0.43)]).collect();
    let position = |frame: usize| {
        let time = DT * frame as f32;
        let moved = |i: usize| [0, 1].map(|axis| start(i)[axis] + time * velocity[i][axis]);
        (0..PARTICLES).map(moved).collect()
    };
    Stream {
        id,
        source: "test".into(),
        dt: DT,
        domain: Domain::UNIT,
        material: (0..PARTICLES).map(|i| Material::ALL[i % 2]).collect(),
        first_sequence: 0,
        first_stamp: Stamp(0),
        stiffness: None,
        tools: None,
        states: (0..FRAMES)
            .map(|frame| State { position: position(frame), velocity: velocity.clone() })
            .collect(),
    }
}

/// Replaces what `metadata.yaml` of a bag says about the stiffness of its streams.
fn restate_stiffness(bag: &Path, with: &str) {
    let path = bag.join("metadata.yaml");
    let text = fs::read_to_string(&path).unwrap();
    let stated = text.lines().find(|line| line.trim().starts_with("eddy_stiffness: ")).unwrap();
    fs::write(&path, text.replace(stated.trim(), with)).unwrap();
}

#[test]
fn a_stream_has_the_stiffness_that_the_metadata_of_its_bag_says() {
    let extent = Extent::usual(Preset::Kinds).with_stiffness([300.0, 3e5]).unwrap();
    let (folder, streams) = simulated(extent, 2).unwrap();
    let scenes = simulate::recorded_scenes(folder.path()).unwrap().unwrap();
    let load = || {
        let options = LoadOptions::within(u64::MAX);
        let loaded = load_trajectories(&[folder.path().into()], options, &mut |_, _| ())?;
        Ok::<_, DatasetError>(loaded.streams)
    };
    // Rather than the manifest. As yaml-cpp writes the value in rosbag2: without quotation marks.
    let bag = streams[1].source.clone();
    restate_stiffness(&bag, "eddy_stiffness: 2.5e4");
    assert_eq!(load().unwrap()[1].stiffness, Some(2.5e4));
    let stated = stiffness_of(&BagReader::open(&bag).unwrap(), TRUTH_TOPIC);
    assert_eq!(stated.unwrap(), 2.5e4);

    fs::remove_file(folder.path().join("manifest.json")).unwrap();
    assert_eq!(load().unwrap()[0].stiffness, Some(scenes[&0].materials.stiffness));
    for wrong in ["stiff", "-3", "inf", ""] {
        restate_stiffness(&bag, &format!("eddy_stiffness: '{wrong}'"));
        let error = load().unwrap_err().to_string();
        let expected = format!("found {wrong:?}, expected a positive number");
        let field = "metadata.yaml: custom_data.eddy_stiffness";
        assert_eq!(error, format!("{}/{field}: {expected}", bag.display()));
    }
}

#[test]
fn a_stream_has_the_stiffness_of_its_scene_in_the_manifest_beside_its_bag() {
    let extent = Extent::usual(Preset::Kinds).with_stiffness([300.0, 3e5]).unwrap();
    let (folder, streams) = simulated(extent, 2).unwrap();
    let scenes = simulate::recorded_scenes(folder.path()).unwrap().unwrap();
    // As an older version has left them.
    streams.iter().for_each(|stream| restate_stiffness(&stream.source, "run: seven"));
    let load = |memory| {
        let options = LoadOptions::within(memory);
        load_trajectories(&[folder.path().into()], options, &mut |_, _| ()).unwrap().streams
    };
    let streams = load(u64::MAX);
    for stream in &streams {
        assert_eq!(stream.stiffness, Some(scenes[&stream.id].materials.stiffness));
        assert_eq!(stream.cut(1..3).unwrap().stiffness, stream.stiffness);
        let bag = BagReader::open(&stream.source).unwrap();
        assert_eq!(stiffness_of(&bag, TRUTH_TOPIC).ok(), stream.stiffness);
    }
    assert_eq!(load(0)[1].stiffness, streams[1].stiffness, "on disk");

    // Another bag with a stream of this id is not of this scene.
    fs::rename(&streams[1].source, folder.path().join("other")).unwrap();
    let renamed = load(u64::MAX);
    assert_eq!((renamed[0].stiffness, renamed[1].stiffness), (streams[0].stiffness, None));
    let message = renamed[1].known_stiffness().unwrap_err().to_string();
    let expected = "expected eddy_stiffness in custom_data of metadata.yaml, or manifest.json of `eddy simulate` with this scene beside the bag";
    assert!(
        message.ends_with(&format!("other: stream 1: stiffness: found nothing, {expected}")),
        "{message}"
    );
    for manifest in ["{}", ""] {
        fs::write(folder.path().join("manifest.json"), manifest).unwrap();
        assert_eq!(load(u64::MAX)[0].stiffness, None, "a manifest that cannot be read");
    }
    fs::remove_file(folder.path().join("manifest.json")).unwrap();
    assert_eq!(load(u64::MAX)[0].stiffness, None);
}

fn write_bag(path: &Path, streams: &[Stream]) {
    let options = WriterOptions {
        compression: Compression::None,
        chunk_size: 1 << 14,
        ..WriterOptions::default()
    };
    let mut bag = BagWriter::create(path, options).unwrap();
    let topic = bag.topic(TRUTH_TOPIC, ParticleFrame::TYPE).unwrap();
    for index in 0..FRAMES {
        for stream in streams.iter().filter(|stream| index < stream.states.len()) {
            let frame = stream.frame(index);
            bag.write(topic, frame.stamp, frame.stamp, &frame.to_cdr()).unwrap();
        }
    }
    bag.finish().unwrap();
}

/// Loads bags; frames that take more than `memory` bytes stay on disk.
fn load(paths: &[PathBuf], memory: u64) -> Result<Dataset, DatasetError> {
    Dataset::load(paths, LoadOptions::within(memory), &mut |_, _| {})
}

fn ids(streams: &[Trajectory]) -> Vec<(u64, u64, usize)> {
    streams.iter().map(|stream| (stream.id, stream.first_sequence, stream.frames)).collect()
}

#[test]
fn streams_on_disk_are_split_like_those_in_memory() {
    let folder = tempfile::tempdir().unwrap();
    // A stream with a missing frame, one whose sequence restarts, and a complete one.
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
fn a_bag_that_changes_after_loading_is_an_error() {
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
    // The cache holds one block, so the first stream has been evicted.
    let message = stored.train[0].cut(0..10).unwrap_err().to_string();
    assert!(message.contains("bag") && message.contains("stream 0"), "{message}");
}

#[test]
fn one_compressed_stream_does_not_affect_the_spacing() {
    let folder = tempfile::tempdir().unwrap();
    let mut streams: Vec<_> = (0..5).map(|id| Stream { id, ..stream(1) }).collect();
    write_bag(&folder.path().join("usual"), &streams);
    for state in &mut streams[0].states {
        for position in &mut state.position {
            *position = position.map(|x| 0.4 + 0.1 * x);
        }
    }
    write_bag(&folder.path().join("compressed"), &streams);
    let spacing = |name: &str| load(&[folder.path().join(name)], u64::MAX).unwrap().spacing;
    assert_eq!(spacing("compressed"), spacing("usual"));
    assert!(spacing("compressed") > 0.0 && spacing("compressed").is_finite());
}

#[test]
fn skipped_streams_leave_the_others_as_they_would_be_alone() {
    let folder = tempfile::tempdir().unwrap();
    let (mixed, alone) = (folder.path().join("mixed"), folder.path().join("alone"));
    let mut streams: Vec<_> = (0..5).map(stream).collect();
    write_bag(&alone, &[0, 2, 4].map(stream));
    streams[1].states[30].position[3] = [0.5, 1.2];
    streams[3].states[20].velocity[2][1] = f32::NAN;
    write_bag(&mixed, &streams);
    for memory in [u64::MAX, 1] {
        let options = |skip_streams| LoadOptions { memory, skip_streams };
        let load =
            |path: &Path, skip| Dataset::load(&[path.to_owned()], options(skip), &mut |_, _| ());
        let message = load(&mixed, false).unwrap_err().to_string();
        assert!(message.contains("mixed: stream 3, frame 20: velocity[2]: found NaN"), "{message}");
        let (skipping, alone) = (load(&mixed, true).unwrap(), load(&alone, false).unwrap());
        assert_eq!(skipping.digest, alone.digest);
        assert_eq!(skipping.normalization, alone.normalization);
        let found: Vec<_> = skipping.skipped.iter().map(|it| (it.stream, it.sequence)).collect();
        assert_eq!(found, [(1, 30), (3, 20)]);
        for (some, others) in [(&skipping.train, &alone.train), (&skipping.test, &alone.test)] {
            for (one, other) in some.iter().zip(others) {
                let all = 0..one.frames;
                assert_eq!(one.cut(all.clone()).unwrap().states, other.cut(all).unwrap().states);
            }
        }
    }
}

#[test]
fn streams_of_another_domain_are_named_or_skipped() {
    let folder = tempfile::tempdir().unwrap();
    let mut streams = [0, 1, 2].map(stream);
    streams[0].domain = Domain { upper: [2.0, 1.0], ..Domain::UNIT };
    write_bag(&folder.path().join("bag"), &streams);
    let load = |skip_streams| {
        let options = LoadOptions { memory: u64::MAX, skip_streams };
        Dataset::load(&[folder.path().join("bag")], options, &mut |_, _| ())
    };
    let message = load(false).unwrap_err().to_string();
    let expected = "bag: stream 0, frame 0: lower, upper: found 0 to 2 x 0 to 1, expected 0 to 1 x 0 to 1 as in most streams";
    assert!(message.ends_with(expected), "{message}");
    assert_eq!(load(true).unwrap().skipped.len(), 1);
}
