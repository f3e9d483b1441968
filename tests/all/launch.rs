//! `eddy launch`: several processes from one file.

use std::{fs, path::Path, process::Command};

use crate::support::{Process, fail, succeed, talking_eddy, unique, wait_for};

/// Writes a launch file and returns its path.
fn plan(folder: &Path, text: &str) -> String {
    let file = folder.join("plan.toml");
    fs::write(&file, text).unwrap();
    file.display().to_string()
}

fn node(prefix: &str) -> String {
    format!(
        "[[process]]\nname = 'node'\nrun = ['node', '--input', 'shm:/{prefix}/particles', '--output', 'shm:/{prefix}/prediction']\n"
    )
}

/// The numbers of processes that have this word among their arguments.
fn running(word: &str) -> Vec<String> {
    let arguments = |id: &str| fs::read(format!("/proc/{id}/cmdline")).unwrap_or_default();
    fs::read_dir("/proc")
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|id| String::from_utf8_lossy(&arguments(id)).contains(word))
        .collect()
}

#[test]
fn what_is_killed_is_started_again_and_all_end_with_the_launch() {
    let folder = tempfile::tempdir().unwrap();
    let prefix = unique("again");
    let file = plan(folder.path(), &format!("restart.delay = 0.05\n{}", node(&prefix)));
    let mut launch =
        Process::start_until(talking_eddy().args(["launch", &file]), "[node] predicting");
    let first = running(&prefix);
    assert_eq!(first.len(), 1, "{first:?}");
    assert!(Command::new("kill").args(["-KILL", &first[0]]).status().unwrap().success());
    let second =
        wait_for("the node runs again", || running(&prefix).into_iter().find(|id| *id != first[0]));
    launch.interrupt();
    assert!(launch.wait().success());
    assert!(!running(&prefix).contains(&second), "{second} outlived its launch");
    let printed = launch.rest();
    assert!(printed.contains("[node] signal: 9 (SIGKILL), restarting in 0.1 s"), "{printed}");
    assert!(printed.ends_with("all processes ended: 1 restarts, 0 killed\n"), "{printed}");
}

#[test]
fn a_launch_that_is_killed_takes_its_processes_along() {
    let folder = tempfile::tempdir().unwrap();
    let prefix = unique("along");
    let file = plan(folder.path(), &node(&prefix));
    let launch = Process::start_until(talking_eddy().args(["launch", &file]), "[node] predicting");
    assert_eq!(running(&prefix).len(), 1);
    launch.kill();
    wait_for("the node ends", || running(&prefix).is_empty().then_some(()));
}

#[test]
fn what_fails_too_often_ends_the_launch_with_its_name() {
    let folder = tempfile::tempdir().unwrap();
    let prefix = unique("often");
    let text = format!(
        "restart = {{ delay = 0.01, limit = 2 }}\n{}[[process]]\nname = 'lost'\nrun = ['replay', '/no/bag/here']\n",
        node(&prefix)
    );
    let message = fail(1, ["launch", &plan(folder.path(), &text)]);
    assert!(
        message.contains("lost: failed again after 2 consecutive restarts: exit status: 1"),
        "{message}"
    );
    assert!(running(&prefix).is_empty());
}

#[test]
fn wrong_usage_is_not_tried_again() {
    let folder = tempfile::tempdir().unwrap();
    let text = "[[process]]\nname = 'odd'\nrun = ['nod']\n";
    let message = fail(1, ["launch", &plan(folder.path(), text)]);
    assert!(message.contains("odd: wrong usage (exit code 2)"), "{message}");
}

#[test]
fn a_process_may_end_all_others_when_it_is_done() {
    let folder = tempfile::tempdir().unwrap();
    let prefix = unique("done");
    let text = format!(
        "{}[[process]]\nname = 'short'\nrun = ['bag', 'info', 'bags/sample']\non_exit = 'shutdown'\n",
        node(&prefix)
    );
    succeed(["launch", &plan(folder.path(), &text)]);
    assert!(running(&prefix).is_empty());
}

#[test]
fn a_plan_that_makes_no_sense_is_refused_by_file_and_field() {
    let folder = tempfile::tempdir().unwrap();
    for (text, expected) in [
        ("process = []", "plan.toml: process: found none, expected at least one [[process]]"),
        ("[[process]]\nname = 'a'\nrun = ['node']\nretsart = true", "unknown field `retsart`"),
        ("[[process]\n", "plan.toml: "),
    ] {
        let message = fail(1, ["launch", &plan(folder.path(), text)]);
        assert!(message.contains(expected), "{message}");
    }
}

#[test]
fn who_does_not_end_well_is_the_error() {
    let folder = tempfile::tempdir().unwrap();
    let prefix = unique("badly");
    let text = format!("grace = 0.0\n{}", node(&prefix));
    let mut launch = Process::start_until(
        talking_eddy().args(["launch", &plan(folder.path(), &text)]),
        "[node] predicting",
    );
    launch.interrupt();
    assert_eq!(launch.wait().code(), Some(1));
    assert!(running(&prefix).is_empty());
}

#[test]
fn a_signal_to_all_at_once_ends_them_well() {
    let folder = tempfile::tempdir().unwrap();
    let prefix = unique("all");
    let file = plan(folder.path(), &node(&prefix));
    let mut launch =
        Process::start_until(talking_eddy().args(["launch", &file]), "[node] predicting");
    // As a service manager does: who was started first, then who started it.
    for id in running(&prefix).iter().chain([&launch.id().to_string()]) {
        assert!(Command::new("kill").args(["-TERM", id]).status().unwrap().success());
    }
    assert!(launch.wait().success());
    assert!(launch.rest().contains("[node] 0 received"), "the node's own last line");
}

#[test]
fn a_launch_that_nobody_listens_to_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let prefix = unique("deaf");
    let file = plan(folder.path(), &format!("restart.delay = 0.0\n{}", node(&prefix)));
    let command = format!("exec '{}' launch '{file}' | head -n 1", env!("CARGO_BIN_EXE_eddy"));
    let mut shell =
        Process::start_until(Command::new("sh").args(["-c", &command]), "[node] predicting");
    let first = wait_for("the node runs", || running(&prefix).pop());
    assert!(Command::new("kill").args(["-KILL", &first]).status().unwrap().success());
    // What is said of this reaches nobody.
    wait_for("the node runs again", || running(&prefix).into_iter().find(|id| *id != first));
    let launch = running(&file).pop().unwrap();
    assert!(Command::new("kill").args(["-INT", &launch]).status().unwrap().success());
    wait_for("all have ended", || running(&prefix).is_empty().then_some(()));
    assert!(shell.wait().success());
}
