//! `eddy eval`: what is judged, what is refused, what is said.

use std::{fs, path::Path};

use eddy::{
    bench::inference::Case,
    checkpoint::{Checkpoint, Core, Description},
    dataset,
};
use serde_json::Value;
use tempfile::TempDir;

use crate::support::{fail, simulate, succeed};

const SHIPPED: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/checkpoints/particle-mingru");

fn path(folder: &TempDir, name: &str) -> String {
    folder.path().join(name).to_str().unwrap().to_owned()
}

fn report(folder: &TempDir) -> Value {
    let text = fs::read_to_string(folder.path().join("report/report.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

fn names(report: &Value) -> Vec<&str> {
    let predictors = report["predictors"].as_array().unwrap();
    predictors.iter().map(|predictor| predictor["name"].as_str().unwrap()).collect()
}

/// The shipped checkpoint, changed, under another name.
fn changed(folder: &TempDir, name: &str, change: impl FnOnce(&mut Description)) -> String {
    let mut checkpoint = Checkpoint::load(Path::new(SHIPPED)).unwrap();
    change(&mut checkpoint.description);
    checkpoint.save(&folder.path().join(name)).unwrap();
    path(folder, name)
}

#[test]
fn seeds_and_rivals_are_judged_side_by_side_on_the_same_frames() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    simulate(&folder.path().join("truth"), 1, 0.2);
    let seed = changed(&folder, "another", |description| description.training.seed = 77);

    let mut arguments = vec!["eval", "--checkpoint", SHIPPED, &seed, "--data", &data];
    arguments.extend(["--output", &output, "--horizon", "5", "--starts", "2", "--threads", "2"]);
    arguments.extend(["--rivals", "mpm,chaos", "--join-late"]);
    let printed = succeed(arguments);
    assert!(printed.contains("particle mingru, mean of 2 seeds"), "{printed}");

    let report = report(&folder);
    let expected = [
        "particle-mingru",
        "another",
        "particle-mingru, joined late",
        "another, joined late",
        "persistence",
        "constant velocity",
        "ballistic with walls",
        "MPM restarted",
        "MPM restarted, half the substeps",
        "MPM restarted, half the grid",
        "truth displaced by 1e-4",
        "truth",
    ];
    assert_eq!(names(&report), expected);
    assert_eq!((&report["windows"], &report["reach"]), (&Value::from(2), &Value::from(200)));
    let skill = |number: usize| report["predictors"][number]["skill"][4].as_f64().unwrap();
    assert_eq!(skill(0), skill(1), "the same weights");
    assert!(skill(7) > 0.5, "the restarted solver knows the law: {}", skill(7));
    assert!(skill(10) > 0.99, "a small displacement is forgiven for five frames: {}", skill(10));
    assert_eq!(skill(11), 1.0, "the truth makes no error");
    for number in [0, 7, 10] {
        let cost = report["predictors"][number]["cost"]["p50"].as_f64().unwrap();
        assert!(cost > 0.0, "{number}");
    }
    let group = &report["groups"][0];
    assert_eq!(group["members"].as_array().unwrap().len(), 2);
    assert_eq!(group["spread"][4], 0.0);
    assert_eq!(group["kinds"][0][1]["spread"][4], 0.0);
    assert!(group["skill_intervals"].is_null(), "one scene says nothing about others");
    assert!(group["ms"].as_f64().unwrap() > 0.0);
    assert_eq!(report["compared"], serde_json::json!([2, 1]));
    let cost = &report["predictors"][7]["cost"];
    assert_eq!(cost["kinds"][0]["p50"], cost["p50"], "one kind");
    let plot = fs::read(folder.path().join("report/cost_error.png")).unwrap();
    assert!(plot.starts_with(b"\x89PNG"));

    let csv = fs::read_to_string(folder.path().join("report/curves.csv")).unwrap();
    let header = csv.lines().next().unwrap().split(',').count();
    for row in csv.lines().skip(1) {
        // Names may have commas.
        let (_, rest) = row.rsplit_once('"').unwrap();
        assert_eq!(rest.split(',').count(), header, "{row}");
    }
    // One kind and all of them, five frames each.
    assert_eq!(csv.lines().count(), 1 + expected.len() * 2 * 5);
}

#[test]
fn scenes_in_a_wider_domain_than_the_checkpoints_are_judged_in_their_own() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    let scenes = ["simulate", "--preset", "kinds", "--particles", "10000", "--output", &data];
    succeed([scenes.as_slice(), &["--duration", "0.2"]].concat());
    let mut arguments = vec!["eval", "--checkpoint", SHIPPED, "--data", &data, "--output", &output];
    arguments.extend(["--horizon", "2", "--starts", "1", "--rivals", "mpm"]);
    succeed(arguments);
    let report = report(&folder);
    let predictors = report["predictors"].as_array().unwrap();
    for name in ["ballistic with walls", "MPM restarted", "truth"] {
        let number = names(&report).iter().position(|found| *found == name).unwrap();
        // Three quarters of the particles are outside the domain of the checkpoint.
        assert_eq!(predictors[number]["blow_ups"]["any"], 0, "{name}");
    }
    assert!(report["walls"][1][0].as_f64().unwrap() > 3.0, "{}", report["walls"]);
}

#[test]
fn without_a_manifest_there_are_no_rivals_and_that_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    simulate(&folder.path().join("truth"), 1, 0.2);
    fs::remove_file(folder.path().join("truth/manifest.json")).unwrap();

    let mut arguments = vec!["eval", "--checkpoint", SHIPPED, "--data", &data, "--output", &output];
    arguments.extend(["--horizon", "2", "--starts", "1", "--rivals", "mpm,chaos"]);
    let printed = succeed(arguments);
    for words in ["no rivals", "scene_0000", "manifest.json"] {
        assert!(printed.contains(words), "`{words}` is not in: {printed}");
    }
    assert_eq!(names(&report(&folder)).len(), 5);
}

#[test]
fn a_grid_that_cannot_be_halved_leaves_out_that_rival_only() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    let scene = path(&folder, "odd.toml");
    let words = r#"
        domain = [1.015625, 1.0]
        [[bodies]]
        material = "liquid"
        shape.rectangle.size = [0.2, 0.2]
        position = [0.5, 0.3]
    "#;
    fs::write(&scene, words).unwrap();
    succeed(["simulate", "--scene", &scene, "--output", &data, "--duration", "0.2"]);
    let mut arguments = vec!["eval", "--checkpoint", SHIPPED, "--data", &data, "--output", &output];
    arguments.extend(["--horizon", "2", "--starts", "1", "--rivals", "mpm"]);
    let printed = succeed(arguments);
    let note = "no MPM restarted, half the grid";
    assert!(printed.contains(note) && printed.contains("[65, 64] cells"), "{printed}");
    let report = report(&folder);
    assert!(report["notes"][0].as_str().unwrap().starts_with(note), "{}", report["notes"]);
    let names = names(&report);
    assert!(names.contains(&"MPM restarted, half the substeps"), "{names:?}");
    assert!(!names.contains(&"MPM restarted, half the grid"), "{names:?}");
}

#[test]
fn data_without_a_scene_that_the_checkpoint_has_not_seen_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    simulate(&folder.path().join("truth"), 1, 0.2);
    let streams = dataset::load_trajectories(&[data.clone().into()], u64::MAX, &mut |_, _| ());
    let digest = dataset::digest(&streams.unwrap(), |_| ()).unwrap();
    let seen = changed(&folder, "seen", |description| description.data = digest);
    let message = fail(1, ["eval", "--checkpoint", &seen, "--data", &data, "--output", &output]);
    assert!(message.contains("found 1 streams that a checkpoint was trained on"), "{message}");
}

#[test]
fn a_stream_that_a_checkpoint_has_learned_from_is_left_out_wherever_it_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    simulate(&folder.path().join("truth"), 2, 0.2);
    let streams = dataset::load_trajectories(&[data.clone().into()], u64::MAX, &mut |_, _| ());
    let known = streams.unwrap()[1].fingerprint().unwrap();
    let seen = changed(&folder, "seen", |description| description.training.seen = vec![known]);
    let judge = |data: &str| {
        let arguments = ["eval", "--checkpoint", &seen, "--data", data, "--output", &output];
        let arguments = arguments.into_iter().chain(["--horizon", "2", "--starts", "1"]);
        arguments.map(str::to_owned).collect::<Vec<_>>()
    };
    let printed = succeed(judge(&data));
    let words = "a checkpoint was trained on 1 of the 2 streams: they are left out";
    assert!(printed.contains(words), "{printed}");
    assert!(printed.contains("free rollouts over 1 streams"), "{printed}");
    let message = fail(1, judge(&format!("{data}/scene_0001")));
    assert!(message.contains("found 1 streams that a checkpoint was trained on"), "{message}");
}

#[test]
fn data_that_a_checkpoint_was_not_made_for_is_refused_before_anything_is_predicted() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    simulate(&folder.path().join("truth"), 1, 0.2);
    let slower = changed(&folder, "slower", |description| description.dt = 0.02);
    let wider = changed(&folder, "wider", |description| description.domain.upper = [2.0; 2]);
    let barren = changed(&folder, "barren", |description| description.materials.truncate(1));
    Case::frame(Core::Mlp, 10).checkpoint.save(&folder.path().join("few")).unwrap();
    let few = path(&folder, "few");

    for (checkpoint, words) in [
        (&slower, ["slower", "scene_0000", "dt: found 0.016 s, expected 0.02 s"]),
        (&wider, ["wider", "scene_0000", "lower, upper: found [0.0, 0.0], [1.0, 1.0]"]),
        (&barren, ["barren", "scene_0000", "expected one of liquid"]),
        (&few, ["few", "scene_0000", "particles: found 2500, expected 10"]),
    ] {
        let mut arguments = vec!["eval", "--checkpoint", SHIPPED, checkpoint, "--data", &data];
        arguments.extend(["--output", &output, "--horizon", "2"]);
        let message = fail(1, arguments);
        for word in words {
            assert!(message.contains(word), "`{word}` is not in: {message}");
        }
        assert!(!Path::new(&output).exists());
    }
}

#[test]
fn streams_shorter_than_the_horizon_are_named_with_what_is_needed() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    simulate(&folder.path().join("truth"), 1, 0.1);
    let message = fail(1, ["eval", "--checkpoint", SHIPPED, "--data", &data, "--output", &output]);
    assert!(message.contains("the longest has 6 frames, expected at least"), "{message}");
}
