//! The settings in `launch_configs/` are what the program takes.

use std::{
    io::{BufRead, BufReader},
    path::Path,
    process::{Command, Stdio},
};

use crate::support::{fail, unique};

fn file(name: &str) -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("launch_configs");
    folder.join(name).to_str().unwrap().to_owned()
}

#[test]
fn the_node_runs_with_its_settings() {
    let prefix = unique("launch");
    let mut node = Command::new(env!("CARGO_BIN_EXE_eddy"))
        .args(["node", "--config", &file("node_lookahead.toml")])
        .args(["--input", &format!("shm:/{prefix}/particles")])
        .args(["--output", &format!("shm:/{prefix}/prediction")])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut printed = BufReader::new(node.stdout.take().unwrap());
    let mut line = String::new();
    printed.read_line(&mut line).unwrap();
    assert!(line.starts_with("predicting shm:"), "{line}");
    let id = node.id().to_string();
    assert!(Command::new("kill").args(["-INT", &id]).status().unwrap().success());
    assert!(node.wait().unwrap().success());
}

#[test]
fn training_takes_its_settings() {
    // Settings are read before the data, so the data is what is missing.
    let message = fail(
        1,
        [
            "train",
            "--config",
            &file("train_frame.toml"),
            "--data",
            "/no/bags/here",
            "--output",
            "/no/output/here",
        ],
    );
    assert!(message.contains("/no/bags/here"), "{message}");
}
