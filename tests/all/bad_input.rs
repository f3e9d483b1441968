//! What the program says when something is wrong: exit code 1, and the file, the field, what was
//! found and what was expected. Nothing already there is lost.

use std::{
    fs,
    path::{Path, PathBuf},
};

use eddy_bag::{BagReader, BagWriter, WriterOptions};
use eddy_frames::Stamp;
use eddy_inference::checkpoint::Checkpoint;
use eddy_messages::{Message, RosString, cdr};
use tempfile::TempDir;

use crate::support::{eddy, fail, simulate, succeed, unique};

struct Folder(TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn join(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn path(&self, name: &str) -> String {
        self.join(name).to_str().unwrap().to_owned()
    }
}

/// Fails if `message` lacks one of `words`.
fn says(message: &str, words: &[&str]) {
    for word in words {
        assert!(message.contains(word), "`{word}` is not in: {message}");
    }
}

fn predict(folder: &Folder, bag: &str) -> String {
    fail(1, ["predict", "--input", bag, "--output", &folder.path("out")])
}

#[test]
fn a_bag_that_is_not_there_is_named() {
    let folder = Folder::new();
    says(&predict(&folder, &folder.path("nowhere")), &["nowhere"]);
}

#[test]
fn a_truncated_bag_is_named_and_what_is_whole_is_predicted() {
    let folder = Folder::new();
    simulate(&folder.join("truth"), 1, 0.5);
    let file = folder.join("truth/scene_0000/scene_0000_0.mcap");
    let bytes = fs::read(&file).unwrap();
    fs::write(&file, &bytes[..bytes.len() * 2 / 3]).unwrap();

    let bag = folder.path("truth/scene_0000");
    says(&fail(1, ["bag", "check", &bag]), &["scene_0000", "problems found"]);
    says(&predict(&folder, &bag), &["scene_0000_0.mcap", "expected"]);
    let predicted = BagReader::open(&folder.join("out")).unwrap();
    assert!(predicted.message_count() > 5, "what could be read was predicted and kept");
}

#[test]
fn a_bag_without_frames_is_named_with_the_topics_it_has() {
    let folder = Folder::new();
    let mut bag = BagWriter::create(&folder.join("words"), WriterOptions::default()).unwrap();
    let topic = bag.topic("/words", RosString::TYPE).unwrap();
    let word = cdr::encode(&RosString { data: "hello".into() });
    bag.write(topic, Stamp(1), Stamp(1), &word).unwrap();
    bag.finish().unwrap();

    let bag = folder.path("words");
    says(&predict(&folder, &bag), &["words", "/particles", "/words"]);
    let output = folder.path("model");
    says(&fail(1, ["train", "--data", &bag, "--output", &output]), &["words", "/particles"]);
    assert!(!Path::new(&output).exists());
}

#[test]
fn a_topic_of_another_type_is_named_with_both_types() {
    let folder = Folder::new();
    let mut bag = BagWriter::create(&folder.join("wrong"), WriterOptions::default()).unwrap();
    let topic = bag.topic("/particles", RosString::TYPE).unwrap();
    let word = cdr::encode(&RosString { data: "hello".into() });
    bag.write(topic, Stamp(1), Stamp(1), &word).unwrap();
    bag.finish().unwrap();
    says(
        &predict(&folder, &folder.path("wrong")),
        &["wrong", "/particles", "std_msgs/msg/String", "eddy_msgs/msg/ParticleFrame"],
    );
}

#[test]
fn a_checkpoint_that_does_not_fit_is_refused_before_anything_is_written() {
    let folder = Folder::new();
    simulate(&folder.join("truth"), 1, 0.3);
    let bag = folder.path("truth/scene_0000");
    let model = folder.join("model");
    Checkpoint::shipped().unwrap().save(&model).unwrap();
    let description = fs::read_to_string(model.join("model.toml")).unwrap();
    let weights = fs::read(model.join("model.safetensors")).unwrap();
    let refused = |description: &str, weights: &[u8]| {
        fs::write(model.join("model.toml"), description).unwrap();
        fs::write(model.join("model.safetensors"), weights).unwrap();
        let output = folder.path("out");
        let model = model.to_str().unwrap();
        let message =
            fail(1, ["predict", "--checkpoint", model, "--input", &bag, "--output", &output]);
        assert!(!Path::new(&output).exists(), "a bag was begun");
        message
    };
    let other = |from: &str, to: &str| {
        assert!(description.contains(from), "{description}");
        description.replacen(from, to, 1)
    };
    says(
        &refused(&other("format_version = 2", "format_version = 99"), &weights),
        &["model.toml", "format_version", "99", "expected 1 to 3"],
    );
    let hidden = other("\nhidden = ", "\nhidden = 1");
    says(&refused(&hidden, &weights), &["model.safetensors", "found", "expected"]);
    says(&refused(&other("dt = ", "depth = 3\ndt = "), &weights), &["model.toml", "depth"]);
    says(&refused(&description, &weights[..weights.len() / 2]), &["model.safetensors"]);
}

#[test]
fn an_unknown_config_key_is_named_with_its_file() {
    let folder = Folder::new();
    fs::write(folder.join("node.toml"), "horizont = 3\n").unwrap();
    says(&fail(1, ["node", "--config", &folder.path("node.toml")]), &["node.toml", "horizont"]);

    simulate(&folder.join("truth"), 2, 0.8);
    fs::write(folder.join("train.toml"), "[windows]\nbatches = 3\n").unwrap();
    let (data, output, config) =
        (folder.path("truth"), folder.path("model"), folder.path("train.toml"));
    let message = fail(1, ["train", "--data", &data, "--output", &output, "--config", &config]);
    says(&message, &["train.toml", "batches"]);
}

#[test]
fn a_busy_port_is_named() {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let output = eddy()
        .args(["node", "--input", "zenoh:/busy/particles", "--output", "zenoh:/busy/prediction"])
        .env("ZENOH_CONFIG_OVERRIDE", format!("listen/endpoints=[\"tcp/127.0.0.1:{port}\"]"))
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    says(&String::from_utf8_lossy(&output.stderr), &["zenoh:/busy/particles", &port.to_string()]);
}

#[test]
fn an_existing_bag_is_never_written_over() {
    let folder = Folder::new();
    simulate(&folder.join("truth"), 1, 0.3);
    let bag = folder.path("truth/scene_0000");
    succeed(["predict", "--input", &bag, "--output", &folder.path("out")]);
    let before = fs::read(folder.join("out/out_0.mcap")).unwrap();
    says(&predict(&folder, &bag), &["out"]);
    let link = format!("shm:/{}/particles", unique("bad_input"));
    says(&fail(1, ["record", &link, "--output", &folder.path("out")]), &["out"]);
    assert_eq!(fs::read(folder.join("out/out_0.mcap")).unwrap(), before);
}

#[test]
fn a_link_that_no_other_process_can_meet_is_refused() {
    let folder = Folder::new();
    let record =
        ["record", "memory:/particles", "--output", &folder.path("out")].map(str::to_owned);
    says(&fail(2, record), &["memory:/particles", "expected shm, zenoh or dds"]);
    says(&fail(2, ["node", "--input", "memory:/particles"]), &["memory:/particles"]);
}

#[test]
fn wrong_usage_is_exit_code_2() {
    says(&fail(2, ["node", "--input", "tcp:/particles"]), &["found `tcp`", "shm, zenoh or dds"]);
    says(&fail(2, ["simulate"]), &["--output"]);
    for (typed, words) in [
        ("simulate --scenes 0 --output o", &["'0'", "--scenes"][..]),
        (
            "simulate --preset kinds --particles 100 --output o",
            &["--particles: found 100", "250 to"],
        ),
        ("simulate --duration -1 --output o", &["'-1'", "--duration", "more than 0"]),
        ("simulate --threads 2000 --output o", &["--threads: found 2000", "1 to 1024"]),
        ("eval --checkpoint c --data d --output o --horizon 0", &["--horizon: found 0"]),
        ("eval --checkpoint c --data d --output o --starts 0", &["--starts: found 0"]),
        ("train --data d --output o --epochs 0", &["epochs: found 0"]),
        ("train --data d --output o --memory -1", &["--memory: found -1"]),
        ("node --horizon 0", &["horizon: found 0"]),
        ("node --input shm:/a --output shm:/a", &["output: found shm:/a, which is the input"]),
        ("record memory:/a --output o", &["expected shm, zenoh or dds"]),
        ("record shm:/a zenoh:/a --output o", &["found topic /a twice"]),
        ("record shm:/a --stop-after 0 --output o", &["'0'", "--stop-after"]),
        ("replay b --rate 0", &["'0'", "--rate", "a positive number"]),
        ("replay b --start-offset -2", &["'-2'", "--start-offset"]),
        ("bag render b --output x.jpg", &["x.jpg: found .jpg"]),
        ("bag render b --output x.gif --rate -1", &["'-1'", "--rate"]),
        ("bag cut b --duration 0 --output o", &["'0'", "--duration"]),
        ("bag export a b --cloud", &["--cloud: found 2 bags"]),
        ("topic hz /a --duration -3", &["'-3'", "--duration"]),
        ("topic echo memory:/a", &["memory links stay within one process"]),
    ] {
        says(&fail(2, typed.split(' ')), words);
    }
}

#[test]
fn an_unstable_number_of_substeps_is_refused_with_the_limit() {
    let folder = Folder::new();
    let output = folder.path("truth");
    let message = fail(1, ["simulate", "--substeps", "20", "--output", &output]);
    says(&message, &["substeps", "20", "at least"]);
}

#[cfg(feature = "cuda")]
#[test]
fn a_gpu_that_is_not_there_is_refused() {
    let folder = Folder::new();
    let bag = folder.path("bag");
    let arguments = ["predict", "--input", &bag, "--output", &folder.path("out"), "--device"];
    let train = ["train", "--data", &bag, "--output", &folder.path("out"), "--gpus", "2"];
    says(&fail(2, train), &["--gpus: found 2 with --device flex", "expected --device cuda"]);
    // Without a driver, and with one but without so many GPUs.
    says(&fail(1, arguments.into_iter().chain(["cuda:15"])), &["device: found no", "expected"]);
    for found in ["gpu", "cuda:16", "cuda:", "cuda1"] {
        let expected = ["--device", "expected cpu, cuda or cuda:N"];
        says(&fail(2, arguments.into_iter().chain([found])), &expected);
    }
    let solver = ["simulate", "--output", &folder.path("truth"), "--device", "cpu:1"];
    says(&fail(2, solver), &["--device", "expected cpu, cuda or cuda:N"]);
    let simulate = ["simulate", "--output", &folder.path("truth"), "--device", "cuda:15"];
    says(&fail(1, simulate), &["device: found no", "expected"]);
    assert!(!Path::new(&folder.path("truth")).exists(), "nothing is written");
}
