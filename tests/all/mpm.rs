//! `eddy simulate`: what it leaves on disk, and what it refuses.

use std::{fs, path::Path};

use crate::support::{Process, eddy, fail, succeed, wait_for};

fn simulate(output: &Path, more: &[&str]) -> Vec<String> {
    let mut arguments = vec!["simulate", "--duration", "0.032", "--output"];
    arguments.push(output.to_str().unwrap());
    arguments.extend(more);
    arguments.into_iter().map(str::to_owned).collect()
}

fn manifest(output: &Path) -> serde_json::Value {
    serde_json::from_str(&fs::read_to_string(output.join("manifest.json")).unwrap()).unwrap()
}

#[test]
fn the_same_seed_writes_the_same_bags() {
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("first"), folder.path().join("second"));
    for output in [&first, &second] {
        succeed(simulate(output, &["--scenes", "3", "--seed", "4"]));
    }
    for scene in ["scene_0000", "scene_0001", "scene_0002"] {
        let file = format!("{scene}/{scene}_0.mcap");
        assert_eq!(fs::read(first.join(&file)).unwrap(), fs::read(second.join(&file)).unwrap());
    }
    assert_eq!(manifest(&first), manifest(&second));
    assert_eq!(manifest(&first)["scenes"][2]["frames"], 2);
    assert_eq!(fs::read_dir(&first).unwrap().count(), 4, "three bags and the manifest");
}

#[test]
fn scenes_that_are_there_are_kept_and_new_ones_added() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    succeed(simulate(output, &["--scenes", "1"]));
    let bag = output.join("scene_0000/scene_0000_0.mcap");
    let made = fs::metadata(&bag).unwrap().modified().unwrap();
    let said = succeed(simulate(output, &["--scenes", "2"]));
    assert!(said.contains("1 of 2 scenes are in"), "{said}");
    assert_eq!(fs::metadata(&bag).unwrap().modified().unwrap(), made);
    assert_eq!(manifest(output)["scenes"].as_array().unwrap().len(), 2);
}

#[test]
fn a_directory_of_other_scenes_is_left_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    succeed(simulate(output, &["--scenes", "1", "--seed", "1"]));
    let before = manifest(output);
    let said = fail(1, simulate(output, &["--scenes", "1", "--seed", "2"]));
    assert!(said.contains("\"seed\":1") && said.contains("\"seed\":2"), "{said}");
    assert_eq!(manifest(output), before);

    let foreign = output.join("foreign");
    fs::create_dir_all(foreign.join("scene_0000")).unwrap();
    let said = fail(1, simulate(&foreign, &["--scenes", "1"]));
    assert!(said.contains("a directory that the manifest does not have"), "{said}");
}

#[test]
fn an_unstable_request_is_refused_before_anything_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("unstable");
    let said = fail(1, simulate(&output, &["--substeps", "20"]));
    assert!(said.contains("scene 0: substeps: found 20, expected at least 153 a frame"), "{said}");
    assert!(!output.exists());
    fail(2, ["simulate", "--preset", "gas", "--output", "x"]);
}

#[test]
fn an_interrupt_keeps_what_is_finished_and_the_same_command_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    let folder = output.to_str().unwrap();
    let arguments = ["simulate", "--duration", "0.32", "--scenes", "30", "--output", folder];
    let mut process = Process::start(eddy().args(arguments).env("RAYON_NUM_THREADS", "2"));
    wait_for("a scene is finished", || output.join("manifest.json").exists().then_some(()));
    process.interrupt();
    assert_eq!(process.wait().code(), Some(1));
    assert!(!output.join(".incomplete").exists());
    let finished = manifest(output)["scenes"].as_array().unwrap().len();
    assert!((1..30).contains(&finished), "{finished}");
    assert_eq!(fs::read_dir(output).unwrap().count(), finished + 1, "bags and the manifest");
    let said = succeed(arguments);
    assert!(said.contains(&format!("{finished} of 30 scenes are in")), "{said}");
}
