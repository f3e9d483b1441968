//! Scenes that people write: the shipped ones run, and what is wrong in one is named.

use std::{
    fs,
    path::{Path, PathBuf},
};

use eddy_bag::BagReader;
use eddy_frames::Frame;
use tempfile::TempDir;

use crate::support::{fail, simulate, succeed};

/// A disc of water in the middle.
const DISC: &str = "
[[bodies]]
material = 'liquid'
shape.disc.radius = 0.1
position = [0.5, 0.5]
";

/// The scene files that come with the program.
fn shipped() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("launch_configs/scenes");
    let files = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    files.collect()
}

/// Two frames of a scene, asked for by `option`.
fn two_frames(option: &str, value: &str) -> Vec<Frame> {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().to_str().unwrap();
    succeed(["simulate", option, value, "--duration", "0.032", "--output", output]);
    let bag = BagReader::open(&folder.path().join("scene_0000")).unwrap();
    bag.frames("/particles").unwrap().map(Result::unwrap).collect()
}

#[test]
fn every_shipped_scene_runs_by_its_file_and_by_its_name() {
    assert!(shipped().len() >= 5);
    for file in shipped() {
        let name = file.file_stem().unwrap().to_str().unwrap().replace('_', "-");
        let by_file = two_frames("--scene", file.to_str().unwrap());
        assert_eq!(by_file.len(), 2, "{name}");
        assert_eq!(by_file, two_frames("--preset", &name));
    }
}

#[test]
fn a_wide_tank_holds_100_000_particles_at_the_usual_spacing() {
    let frames = two_frames("--preset", "wide-tank");
    assert_eq!(frames[0].len(), 100_000);
    assert_eq!(frames[0].domain.upper, [16.0, 1.0]);
    let column = &frames[0].position[..2];
    assert!((column[1][1] - column[0][1] - 1.0 / 128.0).abs() < 1e-6, "{column:?}");
}

/// A scene file of this text, and a place for its output.
struct Written(TempDir);

impl Written {
    fn new(text: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("scene.toml"), text).unwrap();
        Self(folder)
    }

    fn path(&self, name: &str) -> String {
        self.0.path().join(name).to_str().unwrap().to_owned()
    }

    fn arguments(&self) -> [String; 7] {
        let (scene, output) = (self.path("scene.toml"), self.path("out"));
        ["simulate", "--scene", &scene, "--duration", "0.048", "--output", &output]
            .map(str::to_owned)
    }

    /// What is said of it. Nothing is written.
    fn refused(&self) -> String {
        let message = fail(1, self.arguments());
        assert!(!Path::new(&self.path("out")).exists(), "{message}");
        message
    }
}

#[test]
#[expect(clippy::too_many_lines, reason = "a table of cases")]
fn what_is_wrong_in_a_scene_file_is_named_with_what_to_change() {
    let second = |body: &str| format!("{DISC}[[bodies]]\nmaterial = 'snow'\n{body}");
    let cases: [(String, &[&str]); 22] = [
        // Not as a scene is written: the line is shown.
        (DISC.replace("radius", "radus"), &["line 4", "radus", "available keys: radius"]),
        (DISC.replace("'liquid'", "'watr'"), &["line 3", "watr", "`jelly`"]),
        (DISC.replace("0.1\n", "'big'\n"), &["line 4", "expected a number"]),
        (DISC.replace("position", "# position"), &["missing field `position`"]),
        (format!("solver.steps = 3\n{DISC}"), &["steps", "`substeps`"]),
        // Not of the plane.
        (
            format!("domain = [1.0, 1.0, 1.0]\n{DISC}"),
            &["line 1", "found 3 numbers, expected 2: scenes are two-dimensional"],
        ),
        (DISC.replace("[0.5, 0.5]", "[0.5, 0.5, 0.1]"), &["line 5", "found 3 numbers"]),
        (format!("{DISC}velocity = [0.0, 0.0, 5.0]\n"), &["line 6", "found 3 numbers"]),
        (format!("{DISC}velocity = [5.0]\n"), &["line 6", "found 1 numbers"]),
        (
            second("shape.rectangle.size = [0.2, 0.2, 0.9]\nposition = [0.2, 0.2]"),
            &["line 8", "found 3 numbers"],
        ),
        // No particles.
        (String::new(), &["bodies: found none", "at least one body or emitter"]),
        (
            second(
                "shape.polygon.corners = [[0, 0], [0.001, 0], [0, 0.001]]\nposition = [0.2, 0.2]",
            ),
            &["bodies[1].shape", "room for 0 particles", "enlarge it"],
        ),
        (DISC.replace("0.1\n", "-0.1\n"), &["bodies[0].shape.disc.radius: found -0.1"]),
        // No place.
        (
            DISC.replace("[0.5, 0.5]", "[0.5, 0.1]"),
            &["bodies[0]", "between the walls", "move or shrink the body"],
        ),
        (
            second("shape.rectangle.size = [0.1, 0.1]\nposition = [0.6, 0.5]"),
            &["bodies[0] and bodies[1] overlap near", "move or shrink one"],
        ),
        (
            format!("domain = [1.01, 1.0]\n{DISC}"),
            &["domain: found [1.01, 1.0]", "[1.015625, 1.0]"],
        ),
        (format!("spacing = 0.1\n{DISC}"), &["spacing: found 0.1", "and a cell (0.015625)"]),
        (format!("spacing = 1e-6\n{DISC}"), &["spacing: found 0.000001", "a 64th of a cell"]),
        (format!("domain = [900.0, 900.0]\n{DISC}"), &["domain: found", "fewer than 2^31 nodes"]),
        (
            format!("attractor = {{ centre = [0.5, 0.5], strength = 9.0, frames = 5000 }}\n{DISC}"),
            &["attractor.frames: found 5000", "at most 1000"],
        ),
        // No time, no memory.
        (
            format!("solver.substeps = 3\n{DISC}"),
            &["substeps: found 3, expected at least", "sound in liquid"],
        ),
        (
            "domain = [700.0, 700.0]\n[[bodies]]\nmaterial = 'liquid'\nparticles = 10\n\
             shape.rectangle.size = [680.0, 680.0]\nposition = [350.0, 350.0]"
                .to_owned(),
            &["memory: ", "TiB needed", "available", "increase the spacing"],
        ),
    ];
    for (text, words) in cases {
        let written = Written::new(&text);
        let message = written.refused();
        for word in words.iter().chain([&"scene.toml: "]) {
            assert!(message.contains(word), "`{word}` is not in: {message}");
        }
    }
}

#[test]
fn a_scene_has_the_number_that_its_file_says() {
    let written = Written::new(&format!("id = 7\n{DISC}"));
    succeed(written.arguments());
    let bag = BagReader::open(Path::new(&written.path("out/scene_0007"))).unwrap();
    let streams = bag.frames("/particles").unwrap().map(|frame| frame.unwrap().stream);
    assert_eq!(streams.collect::<Vec<_>>(), [7, 7, 7]);
}

#[test]
fn a_scene_that_has_changed_does_not_take_the_place_of_the_old_one() {
    let written = Written::new(DISC);
    succeed(written.arguments());
    assert!(succeed(written.arguments()).contains("1 of 1 scenes are already in"));
    fs::write(written.path("scene.toml"), DISC.replace("0.5]", "0.6]")).unwrap();
    let message = fail(1, written.arguments());
    assert!(message.contains("scene_0000: already exists and is not this scene"), "{message}");
}

#[test]
fn scenes_of_another_domain_are_predicted_with_a_word_and_refused_by_data_sets() {
    let written = Written::new(&format!("domain = [1.5, 1.0]\n{DISC}"));
    succeed(written.arguments());
    let (bag, predicted) = (written.path("out/scene_0000"), written.path("predicted"));
    let message = fail(0, ["predict", "--input", &bag, "--output", &predicted]);
    let words =
        "domain is 1.5 x 1, model was trained on 1 x 1; assuming walls of the same thickness";
    assert!(message.contains(words), "{message}");

    let (random, model) = (written.path("random"), written.path("model"));
    simulate(Path::new(&random), 2, 0.048);
    let message = fail(1, ["train", "--data", &bag, &random, "--output", &model]);
    let words = ["lower, upper: found 0 to ", "0 to 1.5 x 0 to 1"];
    assert!(words.iter().all(|word| message.contains(word)), "{message}");
}

#[test]
fn scenes_from_several_files_without_an_id_are_evaluated_together_and_trained_on() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let mut bags = Vec::new();
    for (name, height) in [("low", "0.4"), ("middle", "0.5"), ("high", "0.6")] {
        fs::write(path("scene.toml"), DISC.replace("0.5]", &format!("{height}]"))).unwrap();
        let (scene, output) = (path("scene.toml"), path(name));
        succeed(["simulate", "--scene", &scene, "--duration", "0.6", "--output", &output]);
        bags.push(output);
    }
    let model = concat!(env!("CARGO_MANIFEST_DIR"), "/checkpoints/particle-mingru");
    let report = path("report");
    let eval = ["eval", "--checkpoint", model, "--output", &report, "--references", "mpm"];
    let more = ["--horizon", "5", "--starts", "2", "--data"].map(str::to_owned);
    succeed(eval.map(str::to_owned).into_iter().chain(more).chain(bags.clone()));
    let text = fs::read_to_string(path("report/report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!((&report["streams"], &report["windows"]), (&3.into(), &6.into()));

    fs::write(path("train.toml"), "windows.per_epoch = 16\nvalidation.horizon = 5\n").unwrap();
    let (config, output) = (path("train.toml"), path("model"));
    let train = ["train", "--output", &output, "--config", &config, "--epochs", "1", "--data"];
    succeed(train.map(str::to_owned).into_iter().chain(bags));
    assert!(Path::new(&path("model/model.toml")).exists());
}
