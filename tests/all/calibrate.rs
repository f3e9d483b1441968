//! `eddy calibrate`: what it writes, what it refuses, and who uses it.

use std::{fs, path::Path};

use eddy_inference::checkpoint::Checkpoint;
use tempfile::TempDir;

use crate::support::{eddy, fail, simulate, succeed};

const SHIPPED: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/checkpoints/particle-mingru");

/// The shipped network without its estimates, and scenes of 25 frames.
struct World {
    folder: TempDir,
}

impl World {
    fn new(scenes: u32) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = Checkpoint::load_uncalibrated(Path::new(SHIPPED)).unwrap();
        checkpoint.save(&folder.path().join("model")).unwrap();
        simulate(&folder.path().join("truth"), scenes, 0.4);
        Self { folder }
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().unwrap().to_owned()
    }

    fn arguments(&self, horizon: &str, more: &[&str]) -> Vec<String> {
        let [model, truth] = ["model", "truth"].map(|name| self.path(name));
        let arguments = ["calibrate", "--checkpoint", &model, "--data", &truth, "--starts", "3"];
        let all = [&arguments[..], &["--horizon", horizon], more].concat();
        all.into_iter().map(str::to_owned).collect()
    }

    fn error_model(&self) -> String {
        fs::read_to_string(self.path("model/error_model.toml")).unwrap()
    }
}

#[test]
fn a_calibrated_checkpoint_shows_in_evaluations_how_well_its_estimates_hold() {
    let world = World::new(10);
    let printed = succeed(world.arguments("10", &[]));
    assert!(printed.contains("30 free rollouts over 10 streams"), "{printed}");
    assert!(printed.contains("AUROC") && printed.contains("model/error_model.toml"), "{printed}");

    let (model, truth, report) = (world.path("model"), world.path("truth"), world.path("report"));
    let evaluate = ["eval", "--checkpoint", &model, "--data", &truth, "--output", &report];
    let evaluate = [&evaluate[..], &["--horizon", "10", "--starts", "3", "--tables"]].concat();
    let printed = succeed(&evaluate);
    assert!(printed.contains("its error estimates were calibrated on 10 of the 10"), "{printed}");
    assert!(printed.contains("estimates of the error"), "{printed}");
    let json: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(world.path("report/report.json")).unwrap())
            .unwrap();
    let found = json["predictors"][0]["reliability"].as_array().unwrap();
    let horizons: Vec<_> = found.iter().map(|at| at["horizon"].as_u64().unwrap()).collect();
    assert_eq!(horizons, [1, 3, 5, 7, 10], "the fourth is interpolated");
    // The last rollout of each scene ends before its fifth frame.
    let estimates: Vec<_> = found.iter().map(|at| at["estimates"].as_u64().unwrap()).collect();
    assert_eq!(estimates, [30, 30, 20, 20, 20]);
    crate::support::is_a_page_of_its_own(
        &fs::read_to_string(world.path("report/report.html")).unwrap(),
    );

    // Without its rules it is another model.
    let without = [&evaluate[..], &["--without-rules", "rest", "--force"]].concat();
    let output = eddy().args(without).output().unwrap();
    let warning = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{warning}");
    let shipped = Checkpoint::load(Path::new(SHIPPED)).unwrap().short_digest();
    let expected = format!("error_model.toml: calibrated for checkpoint {shipped}");
    assert!(warning.contains(&expected), "{warning}");
    assert!(!String::from_utf8(output.stdout).unwrap().contains("estimates of the error"));
}

#[test]
fn the_shipped_checkpoint_has_estimates_of_its_own() {
    let checkpoint = Checkpoint::load(Path::new(SHIPPED)).unwrap();
    let calibrated = checkpoint.error_model.as_ref().unwrap();
    assert_eq!(calibrated.checkpoint, checkpoint.digest());
}

#[test]
fn existing_estimates_are_replaced_only_by_force_even_damaged_ones() {
    let world = World::new(10);
    succeed(world.arguments("10", &[]));
    let first = world.error_model();
    let said = fail(1, world.arguments("10", &[]));
    assert!(said.contains("error_model.toml: already exists; replace it with --force"), "{said}");
    assert_eq!(world.error_model(), first);
    fs::write(world.path("model/error_model.toml"), "format_version = 2").unwrap();
    let predict = ["predict", "--checkpoint", &world.path("model"), "--input"];
    let (truth, output) = (world.path("truth/scene_0000"), world.path("predicted"));
    let said = fail(1, [&predict[..], &[&truth, "--output", &output]].concat());
    assert!(said.contains("error_model.toml: format_version: found 2, expected 1"), "{said}");
    succeed(world.arguments("10", &["--force"]));
    assert_eq!(world.error_model(), first, "the same rollouts give the same estimates");
}

#[test]
fn too_few_streams_or_frames_are_named_and_nothing_is_written() {
    let world = World::new(9);
    for (horizon, words) in [
        ("10", "streams: found 9, expected at least 10"),
        ("40", "the longest has 25 frames, expected at least"),
    ] {
        let said = fail(1, world.arguments(horizon, &[]));
        assert!(said.contains(words), "{said}");
    }
    let said = fail(2, world.arguments("0", &[]));
    assert!(said.contains("--horizon: found 0, expected at least 1 frame"), "{said}");
    assert!(!Path::new(&world.path("model/error_model.toml")).exists());
}
