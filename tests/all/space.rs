//! Frames of three dimensions: what carries frames carries them, what computes with frames says that it does not.

use std::{fs, path::Path};

use eddy_bag::{BagReader, BagWriter, WriterOptions};
use eddy_frames::Stamp;
use eddy_messages::{Message as _, ParticleFrame, cdr};

use crate::support::{Process, World, fail, findings, free_port, succeed, talking_eddy};

const PARTICLES: usize = 20;
const FRAMES: u64 = 40;

/// A frame of a drop that falls in a box.
fn frame(sequence: u64) -> ParticleFrame {
    let stamp = Stamp(0).advance(0.016, sequence as u32);
    let fallen = 0.01 * sequence as f32;
    let place = |p: usize| [0.3 + 0.01 * (p % 4) as f32, 0.9 - fallen, 0.2 + 0.01 * (p / 4) as f32];
    let mut message = ParticleFrame {
        stream: 3,
        sequence,
        dt: 0.016,
        lower: vec![0.0; 3],
        upper: vec![1.0, 1.0, 0.5],
        position: (0..PARTICLES).flat_map(place).collect(),
        velocity: [0.0, -0.625, 0.0].repeat(PARTICLES),
        material: vec![0; PARTICLES],
        ..ParticleFrame::default()
    };
    message.header.stamp = stamp.into();
    "world".clone_into(&mut message.header.frame_id);
    message
}

/// A bag of them.
fn write(path: &Path) {
    let mut bag = BagWriter::create(path, WriterOptions::default()).unwrap();
    let topic = bag.topic("/particles", ParticleFrame::TYPE).unwrap();
    for frame in (0..FRAMES).map(frame) {
        bag.write_stamped(topic, frame.header.stamp.into(), &cdr::encode(&frame)).unwrap();
    }
    bag.finish().unwrap();
}

fn messages(path: &Path) -> Vec<Vec<u8>> {
    let bag = BagReader::open(path).unwrap();
    bag.messages().map(|message| message.unwrap().data).collect()
}

#[test]
fn a_bag_is_checked_copied_and_shown() {
    let folder = tempfile::tempdir().unwrap();
    let [bag, part] = ["bag", "part"].map(|name| folder.path().join(name));
    write(&bag);
    let [from, to] = [&bag, &part].map(|path| path.to_str().unwrap());
    assert_eq!(findings(&bag), [] as [&str; 0]);
    let info: serde_json::Value =
        serde_json::from_str(&succeed(["bag", "info", from, "--json"])).unwrap();
    let stream = &info["topics"][0]["streams"][0];
    assert_eq!((&stream["particles"][0], &stream["dimension"]), (&PARTICLES.into(), &3.into()));
    assert!(succeed(["bag", "info", from]).contains("20 in 3-D"));
    succeed(["bag", "cut", from, "--output", to, "--end", "0.2"]);
    assert_eq!(messages(&part), messages(&bag)[..13]);
}

#[test]
fn exports_have_three_axes() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    write(&bag);
    let export = |format: &str| {
        let output = folder.path().join(format);
        let [from, to] = [&bag, &output].map(|path| path.to_str().unwrap());
        succeed(["bag", "export", from, "--format", format, "--output", to]);
        output
    };
    let table = fs::read_to_string(export("csv")).unwrap();
    let mut lines = table.lines();
    assert_eq!(lines.next(), Some("stream,sequence,time,particle,material,x,y,z,vx,vy,vz"));
    assert_eq!(lines.next(), Some("3,0,0,0,liquid,0.3,0.9,0.2,0,-0.625,0"));
    let grid = fs::read_to_string(export("vtu").join("stream_0003/000000.vtu")).unwrap();
    let strain = r#"Name="strain" NumberOfComponents="6" ComponentName0="xx" ComponentName1="yy" ComponentName2="zz" ComponentName3="xy" ComponentName4="yz" ComponentName5="xz""#;
    assert!(grid.contains(strain), "{grid}");
    let metadata = fs::read_to_string(export("gns").join("metadata.json")).unwrap();
    let metadata: serde_json::Value = serde_json::from_str(&metadata).unwrap();
    assert_eq!(metadata["dim"], 3);
    assert_eq!(metadata["bounds"], serde_json::json!([[0.0, 1.0], [0.0, 1.0], [0.0, 0.5]]));
    assert_eq!(metadata["vel_mean"].as_array().unwrap().len(), 3);
}

#[test]
fn a_topic_of_both_dimensions_is_not_exported() {
    let folder = tempfile::tempdir().unwrap();
    let [bag, output] = ["bag", "output"].map(|name| folder.path().join(name));
    let mut writer = BagWriter::create(&bag, WriterOptions::default()).unwrap();
    let topic = writer.topic("/particles", ParticleFrame::TYPE).unwrap();
    let mut flat = frame(1);
    flat.lower.pop();
    flat.upper.pop();
    flat.position.truncate(2 * PARTICLES);
    flat.velocity = vec![0.0; 2 * PARTICLES];
    for frame in [frame(0), flat] {
        writer.write_stamped(topic, frame.header.stamp.into(), &cdr::encode(&frame)).unwrap();
    }
    writer.finish().unwrap();
    let [from, to] = [&bag, &output].map(|path| path.to_str().unwrap());
    let said = fail(1, ["bag", "export", from, "--format", "npz", "--output", to]);
    assert!(said.contains("lower: found 2 dimensions, expected 3"), "{said}");
    assert!(!output.exists());
}

#[test]
fn what_is_replayed_is_recorded_bit_by_bit_on_every_transport() {
    for transport in ["shm", "zenoh", "dds"] {
        let world = World::new("space");
        let bag = world.bag().with_extension("played");
        write(&bag);
        let port = free_port();
        let started = |listens: bool, arguments: &[&str]| {
            let (there, nowhere) = (format!(r#"["tcp/127.0.0.1:{port}"]"#), "[]".to_owned());
            let [listen, connect] = if listens { [there, nowhere] } else { [nowhere, there] };
            let mut command = talking_eddy();
            command.env(
                "ZENOH_CONFIG_OVERRIDE",
                format!("listen/endpoints={listen};connect/endpoints={connect}"),
            );
            command.env("ROS_DOMAIN_ID", world.domain.to_string());
            Process::start(command.args(arguments))
        };
        let link = format!("{transport}:{}/particles", world.prefix);
        let to = world.bag();
        let count = FRAMES.to_string();
        let to = to.to_str().unwrap();
        let recording = ["--quiet", "record", "--output", to, &link, "--max-messages", &count];
        let mut recorder = started(true, &recording);
        let remap = format!("/particles:={}/particles", world.prefix);
        let from = bag.to_str().unwrap();
        let playing = ["replay", from, "--to", transport, "--wait-for", "1", "--rate", "8"];
        let mut player = started(false, &[&playing[..], &["--remap", &remap]].concat());
        assert!(player.wait().success() && recorder.wait().success(), "{transport}");
        let (found, expected) = (messages(Path::new(to)), messages(&bag));
        assert_eq!(found.len(), expected.len(), "{transport}");
        for (found, expected) in found.iter().zip(&expected) {
            // DDS pads messages to a multiple of 4 bytes.
            let length = if transport == "dds" { expected.len() } else { found.len() };
            assert_eq!(found[..length], expected[..], "{transport}");
        }
    }
}

#[test]
fn what_knows_two_dimensions_says_so_in_one_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let [bag, output] = ["bag", "output"].map(|name| folder.path().join(name));
    write(&bag);
    let [bag, output] = [&bag, &output].map(|path| path.to_str().unwrap().to_owned());
    // Without the estimates that `calibrate` would replace.
    let checkpoint = folder.path().join("checkpoint");
    fs::create_dir(&checkpoint).unwrap();
    for file in ["model.toml", "model.safetensors"] {
        fs::copy(Path::new("checkpoints/particle-mingru").join(file), checkpoint.join(file))
            .unwrap();
    }
    let checkpoint = checkpoint.to_str().unwrap();
    let commands: [&[&str]; 5] = [
        &["predict", "--input", &bag, "--output", &output],
        &["eval", "--checkpoint", checkpoint, "--data", &bag, "--output", &output],
        &["train", "--data", &bag, "--output", &output],
        &["calibrate", "--checkpoint", checkpoint, "--data", &bag],
        &["bag", "render", &bag, "--output", &output],
    ];
    for command in commands {
        let said = fail(1, command);
        let sentence = "lower: found 3 dimensions, expected 2";
        let lines = said.lines().filter(|line| line.contains(sentence)).count();
        assert_eq!(lines, 1, "{command:?}: {said}");
        assert!(said.lines().count() <= 2 && said.contains(&bag), "{command:?}: {said}");
        assert!(!Path::new(&output).exists(), "{command:?}");
    }
}
