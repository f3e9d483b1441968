//! The settings in `launch_configs/` are what the program takes.

use std::{fs, os::unix::fs::symlink, path::Path};

use eddy::bag::BagReader;

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

/// Runs a launch file in a folder of its own, which holds what the repository has, until it has ended by itself.
/// On shared memory topics begin with `place`, which becomes one that nobody else uses. What it records must have
/// at least so many messages on these topics.
fn launch(name: &str, place: &str, bag: &str, topics: &[(&str, u64)]) {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folder = tempfile::tempdir().unwrap();
    let bags = folder.path().join("bags");
    fs::create_dir(&bags).unwrap();
    symlink(repository.join("bags/sample"), bags.join("sample")).unwrap();
    symlink(repository.join("launch_configs"), folder.path().join("launch_configs")).unwrap();
    let plan = folder.path().join(name);
    let text = fs::read_to_string(file(name)).unwrap();
    let (ours, theirs) = (format!("/{place}/"), format!("/{}/", unique(place)));
    fs::write(&plan, text.replace(&ours, &theirs)).unwrap();

    let mut command = talking_eddy();
    command.args(["launch", plan.to_str().unwrap()]).current_dir(folder.path());
    // Nobody else is in this domain, whatever runs beside this test.
    command.env("ROS_DOMAIN_ID", (1 + std::process::id() % 232).to_string());
    let output = command.output().unwrap();
    let printed = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{printed}{}", String::from_utf8_lossy(&output.stderr));
    assert!(printed.contains("[replay] has ended"), "{printed}");

    let recorded = BagReader::open(&bags.join(bag)).unwrap();
    for (topic, least) in topics {
        let name = topic.replace(&ours, &theirs);
        let found = recorded.topics().iter().find(|info| info.name == name);
        assert!(
            found.is_some_and(|info| info.message_count >= *least),
            "{topic}: {:?}",
            recorded.topics()
        );
    }
}

#[test]
fn replay_node_and_record_run_from_one_file() {
    launch("replay_node_record.toml", "-", "launched", &[("/particles", 20), ("/prediction", 10)]);
}

#[test]
fn a_robot_with_parameters_and_clouds_runs_from_one_file() {
    let topics = [
        ("/robot1/particles", 20),
        ("/robot1/particles/cloud", 1),
        ("/robot1/prediction", 10),
        ("/robot1/prediction/cloud", 1),
    ];
    launch("robot1_clouds.toml", "-", "robot1", &topics);
}

#[test]
fn two_nodes_in_a_row_run_from_one_file() {
    let topics = [("/chain/truth", 20), ("/chain/near", 10), ("/chain/far", 1)];
    launch("chain_shm.toml", "chain", "chain", &topics);
}

#[test]
fn a_free_run_at_the_pace_of_a_clock_runs_from_one_file() {
    // Of the first five frames come no more than three predictions.
    let topics = [("/free_run/particles", 20), ("/free_run/prediction", 10)];
    launch("free_run_clock.toml", "free_run", "free_run", &topics);
}

#[test]
fn every_launch_file_is_run_by_a_test() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let tests = fs::read_to_string(folder.join("tests/all/launch_configs.rs")).unwrap();
    for entry in fs::read_dir(folder.join("launch_configs")).unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        let mentioned = [&tests[..], include_str!("../../launch_configs/robot1_clouds.toml")];
        let tested = name == "scenes" || mentioned.iter().any(|text| text.contains(&name));
        assert!(tested, "{name} is run by no test");
    }
}
