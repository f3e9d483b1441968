//! The settings in `launch_configs/` are what the program takes.

use std::path::Path;

use crate::support::{Process, fail, talking_eddy, unique};

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
