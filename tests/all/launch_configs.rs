//! Runs the files in `launch_configs/`; `scenes.rs` runs those in `launch_configs/scenes`, the tests of `eddy-lab` those in
//! `launch_configs/study`, and `tests/cluster/run` those in `launch_configs/cluster`.

use std::{collections::BTreeSet, fs, os::unix::fs::symlink, path::Path};

use eddy_bag::BagReader;
use eddy_inference::checkpoint::{Checkpoint, layout::particle_features};
use eddy_node::launch::Plan;
use eddy_settings as config;

use crate::{
    support::{Process, succeed, talking_eddy, unique},
    train::{stream, write_bag},
};

fn file(name: &str) -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("launch_configs");
    folder.join(name).to_str().unwrap().to_owned()
}

/// One test for each file.
macro_rules! files {
    ($($test:ident: $name:literal => $run:expr,)*) => {
        $(#[test]
        fn $test() {
            $run($name);
        })*

        const FILES: &[&str] = &[$($name),*];
    };
}

files! {
    the_node_runs_with_its_settings: "node/lookahead.toml" => node,
    the_tools_of_a_robot_are_followed: "tools/robot.toml" => tools,
    the_paper_s_network_is_trained_with_its_settings: "train/frame.toml" => |name| train(name, "frame min"),
    the_paper_s_mingru_is_trained_with_its_settings: "train/frame_mingru.toml" => |name| {
        train(name, "frame min");
    },
    soft_matter_is_trained_with_its_settings: "train/soft.toml" => |name| train_particles(name, &[]),
    soft_matter_is_trained_at_once_with_its_settings: "train/soft_once.toml" => |name| {
        train_particles(name, &[]);
    },
    soft_matter_is_trained_further_with_its_settings: "train/soft_long.toml" => |name| {
        train_from_soft_matter(name);
    },
    any_stiffness_is_trained_with_its_settings: "train/any_stiffness.toml" => |name| {
        train_from_soft_matter(name);
    },
    replay_node_and_record_run_from_one_file: "launch/replay_node_record.toml" => |name| {
        launch(name, "-", "launched", &[("/particles", 20), ("/prediction", 10)]);
    },
    a_robot_with_parameters_and_clouds_runs_from_one_file: "launch/robot1_clouds.toml" => |name| {
        let topics = [
            ("/robot1/particles", 20),
            ("/robot1/particles/cloud", 1),
            ("/robot1/prediction", 10),
            ("/robot1/prediction/cloud", 1),
        ];
        launch(name, "-", "robot1", &topics);
    },
    two_nodes_in_a_row_run_from_one_file: "launch/chain_shm.toml" => |name| {
        let topics = [("/chain/truth", 20), ("/chain/near", 10), ("/chain/far", 1)];
        launch(name, "chain", "chain", &topics);
    },
    a_free_run_at_the_pace_of_a_clock_runs_from_one_file: "launch/free_run_clock.toml" => |name| {
        // The first five frames give at most three predictions.
        let topics = [("/free_run/particles", 20), ("/free_run/prediction", 10)];
        launch(name, "free_run", "free_run", &topics);
    },
}

fn tools(name: &str) {
    let mut command = talking_eddy();
    let input = format!("shm:/{}/particles", unique("launch"));
    command.args(["tools", &file(name), "--input", &input]);
    let mut follower = Process::start_until(&mut command, "2 tools beside shm:");
    follower.interrupt();
    assert!(follower.wait().success());
}

fn node(name: &str) {
    let prefix = unique("launch");
    let mut command = talking_eddy();
    command.args(["node", "--config", &file(name)]);
    command.args(["--input", &format!("shm:/{prefix}/particles")]);
    command.args(["--output", &format!("shm:/{prefix}/prediction")]);
    let mut node = Process::start_until(&mut command, "predicting shm:");
    node.interrupt();
    assert!(node.wait().success());
}

/// Begins a training on a small bag.
fn train(name: &str, network: &str) {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    write_bag(&bag, &(0..6).map(stream).collect::<Vec<_>>());
    begin_training(name, &bag, network, &[]);
}

/// Begins a training from a network that does not know the stiffness: the shipped one for soft matter, without that input.
fn train_from_soft_matter(name: &str) {
    let mut soft = Checkpoint::shipped().unwrap().at_stiffness(1e3);
    let place = particle_features(&soft.description) - 1;
    for layer in ["encoder.0.weight", "context.weight"] {
        let matrix = soft.tensors.get_mut(layer).unwrap();
        let columns = matrix.shape[1];
        let rows = matrix.values.chunks(columns);
        matrix.values = rows.flat_map(|row| [&row[..place], &row[place + 1..]].concat()).collect();
        matrix.shape[1] = columns - 1;
    }
    (soft.description.stiffness, soft.description.assumed_stiffness) = (false, None);
    let folder = tempfile::tempdir().unwrap();
    soft.save(folder.path()).unwrap();
    train_particles(name, &["--from", folder.path().to_str().unwrap()]);
}

/// Begins a training on small scenes of 75 frames, more than those of its longest windows, each with a stiffness.
fn train_particles(name: &str, start: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let bags = folder.path().join("bags");
    let scenes = ["simulate", "--preset", "kinds", "--particles", "250", "--scenes", "5"];
    let more = ["--duration", "1.2", "--stiffness", "300..3e3", "--output", bags.to_str().unwrap()];
    succeed([&scenes[..], &more].concat());
    begin_training(name, &bags, "particle min", start);
}

/// Trains until it says which network: to the end it would take days.
fn begin_training(name: &str, data: &Path, network: &str, start: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let mut command = talking_eddy();
    command.args(["train", "--config", &file(name), "--data", data.to_str().unwrap()]);
    command.args(["--output", folder.path().join("model").to_str().unwrap()]).args(start);
    let mut training = Process::start_until(&mut command, network);
    training.interrupt();
    training.wait();
    let said = training.rest();
    assert!(said.contains("interrupted: "), "{said}");
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
    let plan = folder.path().join("plan.toml");
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

/// Files that a launch file passes to its processes count as run.
#[test]
fn every_file_is_run_by_a_test() {
    let mut run: BTreeSet<String> = FILES.iter().map(|name| (*name).to_owned()).collect();
    for name in FILES {
        let text = fs::read_to_string(file(name)).unwrap();
        let Ok(plan) = config::parse::<Plan>(Path::new(name), &text) else { continue };
        let arguments = plan.process.iter().flat_map(|process| &process.run);
        let handed = arguments.filter_map(|argument| argument.strip_prefix("launch_configs/"));
        run.extend(handed.map(str::to_owned));
    }
    let names = |folder: &str| -> Vec<String> {
        let entries = fs::read_dir(file(folder)).unwrap();
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
    };
    let folders =
        names("").into_iter().filter(|name| !["cluster", "scenes", "study"].contains(&&**name));
    let in_folder = |folder: String| {
        let files = names(&folder).into_iter();
        files.map(move |name| format!("{folder}/{name}")).collect::<Vec<_>>()
    };
    let found: BTreeSet<_> = folders.flat_map(in_folder).collect();
    assert_eq!(found, run);
}
