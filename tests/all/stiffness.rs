//! Networks conditioned on the stiffness of a stream: the sources of the stiffness, and the errors without one.

use std::{fs, path::Path};

use eddy_inference::checkpoint::Checkpoint;
use serde_json::Value;
use tempfile::TempDir;

use crate::support::{fail, run, succeed};

const SHIPPED: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/checkpoints/particle-mingru");

/// Small scenes, each with a stiffness of its own, and a network that is trained on them and conditioned on the stiffness.
struct World {
    folder: TempDir,
}

impl World {
    fn new() -> Self {
        let world = Self { folder: tempfile::tempdir().unwrap() };
        world.simulate("seen", "1", "5");
        world.simulate("unseen", "2", "10");
        world.write_settings(TRAINING);
        succeed(world.train("seen", "model"));
        world
    }

    fn write_settings(&self, text: &str) {
        fs::write(self.path("train.toml"), text).unwrap();
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().unwrap().to_owned()
    }

    fn simulate(&self, name: &str, seed: &str, scenes: &str) {
        let output = self.path(name);
        let arguments = ["simulate", "--preset", "kinds", "--particles", "250", "--seed", seed];
        let more = ["--scenes", scenes, "--duration", "0.4", "--stiffness", "300..3e4"];
        succeed([&arguments[..], &more, &["--output", &output]].concat());
    }

    fn train(&self, data: &str, output: &str) -> Vec<String> {
        let [data, output, config] = [data, output, "train.toml"].map(|name| self.path(name));
        let all = ["train", "--data", &data, "--output", &output, "--config", &config];
        all.into_iter().map(str::to_owned).collect()
    }

    fn eval(&self, checkpoint: &str, more: &[&str]) -> Vec<String> {
        let [data, output] = ["unseen", "report"].map(|name| self.path(name));
        let all = ["eval", "--checkpoint", checkpoint, "--data", &data, "--output", &output];
        let all = [&all[..], &["--force", "--horizon", "3", "--starts", "2"], more].concat();
        all.into_iter().map(str::to_owned).collect()
    }

    /// The skill of the network in an evaluation.
    fn skill(&self, more: &[&str]) -> Value {
        succeed(self.eval(&self.path("model"), more));
        self.skill_of_report()
    }

    fn skill_of_report(&self) -> Value {
        let text = fs::read_to_string(self.path("report/report.json")).unwrap();
        let report: Value = serde_json::from_str(&text).unwrap();
        report["predictors"][0]["skill"].clone()
    }

    fn predict(&self, checkpoint: &str, output: &str, more: &[&str]) -> Vec<String> {
        let [bag, output] = ["unseen/scene_0001", output].map(|name| self.path(name));
        let all = ["predict", "--checkpoint", checkpoint, "--input", &bag, "--output", &output];
        [&all[..], more].concat().into_iter().map(str::to_owned).collect()
    }

    /// The bytes of the predictions.
    fn predicted(&self, output: &str, more: &[&str]) -> Vec<u8> {
        succeed(self.predict(&self.path("model"), output, more));
        fs::read(self.path(&format!("{output}/{output}_0.mcap"))).unwrap()
    }
}

/// A small network and a short training.
const TRAINING: &str = "
epochs = 1
unroll = [{ share = 1.0, frames = 2 }]
network.stiffness = true
network.encoder = 8
network.hidden = 8
network.channels = [8, 8, 8]
windows.per_epoch = 64
validation.horizon = 4
";

#[test]
fn a_conditioned_network_takes_the_stiffness_of_each_scene_or_the_one_that_is_given() {
    let world = World::new();
    let model = world.path("model");
    let description = Checkpoint::load(Path::new(&model)).unwrap().description;
    assert!(description.stiffness);

    let manifest = fs::read_to_string(world.path("unseen/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_str(&manifest).unwrap();
    let scene = &manifest["scenes"][1]["scene"];
    assert_eq!(scene["id"], 1);
    let own = scene["materials"]["stiffness"].to_string();
    let found = world.predicted("own", &[]);
    assert!(found == world.predicted("given", &["--stiffness", &own]), "{own}");
    assert!(found != world.predicted("other", &["--stiffness", "3e5"]), "{own}");

    assert_ne!(world.skill(&[]), world.skill(&["--stiffness", "3e5"]));
    let calibrate = ["calibrate", "--checkpoint", &model, "--data", &world.path("unseen")];
    let calibrate = [&calibrate[..], &["--horizon", "3", "--starts", "3", "--force"]].concat();
    succeed(&calibrate);
    let errors = || fs::read_to_string(world.path("model/error_model.toml")).unwrap();
    let own = errors();
    succeed([&calibrate[..], &["--stiffness", "3e5"]].concat());
    assert_ne!(errors(), own);

    // The metadata of the bags says it, too.
    let skill = world.skill(&[]);
    for data in ["seen", "unseen"] {
        fs::remove_file(world.path(&format!("{data}/manifest.json"))).unwrap();
    }
    assert!(found == world.predicted("alone", &[]));
    assert_eq!(world.skill(&[]), skill);
    for data in ["seen", "unseen"] {
        for entry in fs::read_dir(world.path(data)).unwrap() {
            let metadata = entry.unwrap().path().join("metadata.yaml");
            let Ok(text) = fs::read_to_string(&metadata) else { continue };
            assert!(text.contains("eddy_stiffness: "), "{text}");
            fs::write(metadata, text.replace("eddy_stiffness: ", "run: ")).unwrap();
        }
    }
    let expected = "stiffness: found nothing, expected eddy_stiffness in custom_data of metadata.yaml, or manifest.json of `eddy simulate`";
    for (arguments, words) in [
        (world.train("seen", "again"), ["seen/scene_0000", "beside the bag"]),
        (world.eval(&model, &[]), ["unseen/scene_0000", "or `stiffness` given"]),
        (
            calibrate.iter().map(ToString::to_string).collect(),
            ["unseen/scene_0000", "or `stiffness` given"],
        ),
        (world.predict(&model, "no", &[]), ["unseen/scene_0001", "or `stiffness` given"]),
    ] {
        let message = fail(1, arguments);
        for word in [expected, words[0], words[1]] {
            assert!(message.contains(word), "`{word}` is not in: {message}");
        }
    }
    assert!(!Path::new(&world.path("no")).exists());
    world.skill(&["--stiffness", "1e4"]);

    let expected = "stiffness: found nothing, expected Young's modulus of the stream";
    let message = fail(1, ["node", "--checkpoint", &model, "--input", "shm:/stiffness/particles"]);
    assert!(message.contains(expected), "{message}");

    assumes_a_stiffness(&world);
}

/// A checkpoint may assume a stiffness of streams that state none.
fn assumes_a_stiffness(world: &World) {
    let model = world.path("model");
    let file = world.path("model/model.toml");
    let text = fs::read_to_string(&file).unwrap();
    let assuming = "stiffness = true\nassumed_stiffness = 1000.0\n";
    fs::write(&file, text.replacen("stiffness = true\n", assuming, 1)).unwrap();
    let given = world.predicted("given_again", &["--stiffness", "1e3"]);
    assert!(world.predicted("assumed", &[]) == given, "as with the assumed stiffness");
    let skill = world.skill(&["--stiffness", "1e3"]);
    assert_eq!(world.skill(&[]), skill);
    let said = String::from_utf8(run(world.eval(&model, &[])).stderr).unwrap();
    assert!(said.contains("stiffness is not stated; assuming 1000"), "{said}");
}

#[test]
fn the_shipped_network_is_better_than_trivial_predictors() {
    let world = World { folder: tempfile::tempdir().unwrap() };
    world.simulate("unseen", "2", "10");
    succeed(world.eval(SHIPPED, &[]));
    let skill = world.skill_of_report();
    assert!(skill[2].as_f64().unwrap() > 0.5, "{skill}");
}

#[test]
fn a_stiffness_for_a_network_that_does_not_use_it_is_refused() {
    let world = World { folder: tempfile::tempdir().unwrap() };
    world.simulate("seen", "1", "5");
    world.simulate("unseen", "2", "2");
    world.write_settings(&TRAINING.replace("network.stiffness = true", ""));
    succeed(world.train("seen", "model"));
    let model = world.path("model");
    let given = &["--stiffness", "1e4"];
    let message = fail(1, world.eval(&model, given));
    let expected = "stiffness: found 10000, expected nothing: no checkpoint is conditioned on it";
    assert!(message.contains(expected), "{message}");
    let expected = "stiffness: found 10000, expected nothing: the checkpoint does not use it";
    for arguments in [
        world.predict(&model, "no", given),
        [
            "node",
            "--checkpoint",
            &model,
            "--input",
            "shm:/stiffness/particles",
            "--stiffness",
            "1e4",
        ]
        .map(str::to_owned)
        .into(),
    ] {
        let message = fail(1, arguments);
        assert!(message.contains(expected), "{message}");
    }
    let message = fail(2, world.predict(&model, "no", &["--stiffness", "-1"]));
    assert!(message.contains("stiffness: found -1, expected 0 to 1000000000"), "{message}");
}
