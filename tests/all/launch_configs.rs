//! The settings in `launch_configs/` are what the program takes.

use std::{fs, os::unix::fs::symlink, path::Path};

use crate::support::{Process, fail, succeed, talking_eddy, unique};

fn file(name: &str) -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("launch_configs");
    folder.join(name).to_str().unwrap().to_owned()
}

#[test]
fn the_node_runs_with_its_settings() {
    let prefix = unique("launch");
    let mut command = talking_eddy();
    command.args(["node", "--config", &file("node_lookahead.toml")]);
    command.args(["--input", &format!("shm:/{prefix}/particles")]);
    command.args(["--output", &format!("shm:/{prefix}/prediction")]);
    let mut node = Process::start_until(&mut command, "predicting shm:");
    node.interrupt();
    assert!(node.wait().success());
}

#[test]
fn training_takes_its_settings() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("model").display().to_string();
    for settings in ["train_frame.toml", "train_frame_mingru.toml"] {
        // Settings are read before the data, so the data is what is missing.
        let config = file(settings);
        let arguments =
            ["train", "--config", &config, "--data", "/no/bags/here", "--output", &output];
        let message = fail(1, arguments);
        assert!(message.contains("/no/bags/here"), "{settings}: {message}");
    }
}

#[test]
fn replay_node_and_record_run_from_one_file() {
    let folder = tempfile::tempdir().unwrap();
    let bags = folder.path().join("bags");
    fs::create_dir(&bags).unwrap();
    let sample = Path::new(env!("CARGO_MANIFEST_DIR")).join("bags/sample");
    symlink(sample, bags.join("sample")).unwrap();
    let mut command = talking_eddy();
    command.args(["launch", &file("replay_node_record.toml")]).current_dir(folder.path());
    // Nobody else is in this domain, whatever runs beside this test.
    command.env("ROS_DOMAIN_ID", (1 + std::process::id() % 232).to_string());
    let output = command.output().unwrap();
    let printed = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{printed}{}", String::from_utf8_lossy(&output.stderr));
    assert!(printed.contains("[replay] has ended"), "{printed}");

    let recorded = succeed(["bag", "info", bags.join("launched").to_str().unwrap()]);
    for topic in ["/particles", "/prediction"] {
        assert!(recorded.contains(topic), "{recorded}");
    }
}
