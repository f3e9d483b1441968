//! What the data states is compared with the checkpoint, and rejected frames are said where people look.

use std::{fs, path::Path, process::Stdio};

use eddy_bag::{BagReader, BagWriter, WriterOptions};
use eddy_frames::Frame;
use eddy_messages::{FrameCdr, Message, ParticleFrame};

use crate::{
    pty::OnTerminal,
    support::{World, fail, succeed, talking_eddy, wait_for},
    train::{FRAMES, stream},
};

const DT: f32 = 0.016;

/// Frames of stream `id`, `dt` apart.
fn frames(id: u64, dt: f32) -> Vec<Frame> {
    let stream = stream(id);
    let at = |index| {
        let frame = stream.frame(index);
        Frame { dt, stamp: stream.first_stamp.advance(dt, index as u32), ..frame }
    };
    (0..FRAMES).map(at).collect()
}

/// Writes a bag of one stream, whose metadata has these entries.
fn write(bag: &Path, frames: &[Frame], entries: &[(&str, &str)]) {
    let mut writer = BagWriter::create(bag, WriterOptions::default()).unwrap();
    for (key, value) in entries {
        writer.set_custom_data(key, (*value).to_owned());
    }
    let topic = writer.topic("/particles", ParticleFrame::TYPE).unwrap();
    for frame in frames {
        writer.write(topic, frame.stamp, frame.stamp, &frame.to_cdr()).unwrap();
    }
    writer.finish().unwrap();
}

const ON_THE_MOON: [(&str, &str); 2] = [("eddy_gravity", "-1.62"), ("eddy_stiffness", "100000")];

/// Settings of a training that takes no time.
const SMALL: &str = "epochs = 1
elastic_modulus = 300.0
unroll = [{ share = 1.0, frames = 4 }]
[network]
encoder = 4
hidden = 4
cell_width = 0.5
channels = [4, 4]
[windows]
batch = 2
per_epoch = 2
[validation]
horizon = 8
";

/// How often `words` are in `text`.
fn count(text: &str, words: &str) -> usize {
    text.matches(words).count()
}

#[test]
fn gravity_and_stiffness_that_a_bag_states_are_compared_with_the_checkpoint_once() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let [moon, earth, silent] = ["moon", "earth", "silent"].map(path);
    let unlike = [ON_THE_MOON[0], ("eddy_stiffness", "10000000")];
    write(Path::new(&moon), &frames(1, DT), &unlike);
    let as_trained = [("eddy_gravity", "-9.8"), ("eddy_stiffness", "1000")];
    write(Path::new(&earth), &frames(2, DT), &as_trained);
    write(Path::new(&silent), &frames(3, DT), &[]);

    let gravity = "gravity is -1.62 along y, model was trained with -9.8";
    let stiffness = "stiffness is 10000000, model was trained with 300";
    let predict = |bag: &str| {
        let output = path("predicted");
        fail(0, ["predict", "--input", bag, "--output", &output, "--force"])
    };
    let evaluate = |bag: &str| {
        let (output, model) = (path("report"), "particle-mingru");
        let given = ["eval", "--checkpoint", model, "--data", bag, "--output", &output, "--force"];
        fail(0, [&given[..], &["--horizon", "4", "--starts", "1"]].concat())
    };
    for said in [predict(&moon), evaluate(&moon)] {
        assert_eq!((count(&said, gravity), count(&said, stiffness)), (1, 1), "{said}");
    }
    predict(&moon);
    let predicted = BagReader::open(folder.path().join("predicted").as_ref()).unwrap();
    for (key, value) in unlike {
        assert_eq!(
            predicted.custom_data()[key],
            value,
            "what is so of the frames is so of predictions"
        );
    }
    for said in [predict(&earth), evaluate(&earth)] {
        assert!(!said.contains("gravity") && !said.contains("stiffness"), "{said}");
    }
    for said in [predict(&silent), evaluate(&silent)] {
        let assumed = count(&said, "stiffness is not stated; assuming 1000");
        assert!(!said.contains("gravity") && assumed == 1, "{said}");
    }
}

#[test]
fn training_compares_the_bags_with_the_settings_and_with_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let bags: Vec<String> = (0..3).map(|number| path(&format!("bag_{number}"))).collect();
    for (id, bag) in bags.iter().enumerate() {
        let entries = if id == 1 { &ON_THE_MOON[..] } else { &[("eddy_stiffness", "1000")][..] };
        write(Path::new(bag), &frames(id as u64, DT), entries);
    }
    let config = path("small.toml");
    fs::write(&config, SMALL).unwrap();
    let output = path("model");
    let mut command = talking_eddy();
    command.args(["train", "--config", &config, "--output", &output, "--data"]).args(&bags);
    let trained = command.stdout(Stdio::null()).output().unwrap();
    let said = String::from_utf8(trained.stderr).unwrap();
    for words in [
        "gravity is -1.62 along y, and the settings say -9.8",
        "set `gravity = [0.0, -1.62]` (1 of 3 streams)",
        "set `elastic_modulus = 30000.0` (1 of 3 streams)",
    ] {
        assert_eq!(count(&said, words), 1, "`{words}` is not once in: {said}");
    }
}

#[test]
fn a_bag_whose_frames_are_all_rejected_is_said_once_and_leaves_no_bag() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let [slow, output] = ["slow", "predicted"].map(path);
    write(Path::new(&slow), &frames(7, 0.02), &[]);
    let said = fail(1, ["predict", "--input", &slow, "--output", &output]);
    let reason = "stream 7: dt: found 0.02 s, expected 0.016 s";
    assert_eq!(count(&said, "frame rejected: "), 1, "{said}");
    assert_eq!(count(&said, reason), 2, "once at the first frame, once at the end: {said}");
    let last = said.lines().last().unwrap();
    assert!(last.contains(&format!("all {FRAMES} frames were rejected: {reason}")), "{last}");
    assert!(!Path::new(&output).exists(), "an empty bag is left behind");

    // Among good frames it is no failure, and said.
    let mut mixed = frames(1, DT);
    mixed.extend(frames(7, 0.02));
    mixed.sort_by_key(|frame| frame.stamp);
    let bag = path("mixed");
    write(Path::new(&bag), &mixed, &[]);
    let printed = talking_eddy().args(["predict", "--input", &bag, "--output", &output]).output();
    let printed = printed.unwrap();
    assert!(printed.status.success());
    let stdout = String::from_utf8(printed.stdout).unwrap();
    let last = stdout.lines().last().unwrap();
    assert!(last.contains(&format!("; last rejected: {reason}")), "{last}");
    assert!(BagReader::open(Path::new(&output)).unwrap().message_count() > 0);
}

#[test]
fn a_node_says_at_once_and_first_why_it_rejects_frames() {
    let world = World::new("rejects");
    let (input, output) = (world.link("shm", "particles"), world.link("shm", "prediction"));
    let mut command = talking_eddy();
    command.args(["node", "--input", &input.to_string(), "--output", &output.to_string()]);
    let mut node = OnTerminal::start(&command, 80);
    let begun = node.wait_for("waiting for frames on shm:", 0);
    let mut source = world.publisher("shm", "particles", ParticleFrame::TYPE);
    wait_for("the node listens", || (source.subscribers() > 0).then_some(()));
    let frames = frames(7, 0.02);
    source.publish_frame(&frames[0]).unwrap();
    let logged = node.wait_for("frame rejected: stream 7: dt: found 0.02 s", begun);
    // The live line is new each second, and begins with it.
    source.publish_frame(&frames[1]).unwrap();
    let shown = node.wait_for("2 rejected: stream 7: dt: found 0.02 s, expected 0.016 s", logged);
    node.press(b"\x03");
    assert!(node.wait().success());
    node.wait_for("2 wrong interval; last rejected: stream 7: dt: found 0.02 s", shown);
}

#[test]
fn the_same_training_has_the_same_digest_wherever_it_is_written_to() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let bags: Vec<String> = (0..3).map(|number| path(&format!("bag_{number}"))).collect();
    for (id, bag) in bags.iter().enumerate() {
        write(Path::new(bag), &frames(id as u64, DT), &[]);
    }
    let config = path("small.toml");
    fs::write(&config, SMALL).unwrap();
    let description = |name: &str| {
        let output = path(name);
        let given = ["train", "--config", &config, "--output", &output, "--data"];
        succeed(given.into_iter().chain(bags.iter().map(String::as_str)));
        fs::read_to_string(Path::new(&output).join("model.toml")).unwrap()
    };
    assert_eq!(description("one"), description("another/place"));
}
