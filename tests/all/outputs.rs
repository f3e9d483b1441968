//! Outputs that already exist: left as they are, or replaced by `--force` if they are of the same kind.

use std::{
    fs,
    path::{Path, PathBuf},
};

use eddy_bag::BagReader;
use tempfile::TempDir;

use crate::support::{Process, World, fail, simulate, succeed, talking_eddy, wait_for, word};

const SAMPLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/bags/sample");

struct Folder(TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn join(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn path(&self, name: &str) -> String {
        self.join(name).to_str().unwrap().to_owned()
    }

    /// The names in the folder, hidden ones too.
    fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.0.path()).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}

/// The words of a command, the last of which is its output.
fn to(words: &str, output: &str) -> Vec<String> {
    words.split(' ').map(str::to_owned).chain(["--output".to_owned(), output.to_owned()]).collect()
}

#[test]
fn every_command_leaves_an_existing_output_and_replaces_it_when_forced() {
    let folder = Folder::new();
    let truth = folder.path("truth");
    simulate(&folder.join("truth"), 1, 0.3);
    let scene = format!("{truth}/scene_0000");
    let arrays = folder.path("arrays.npz");
    succeed(to(&format!("bag export {scene} --format npz"), &arrays));
    let cases = [
        (format!("predict --input {scene}"), "bag"),
        (format!("bag cut {scene} --end 0.1"), "bag"),
        (format!("bag filter {scene} --topics /particles"), "bag"),
        (format!("bag merge {scene} {SAMPLE}"), "bag"),
        (format!("bag recover {scene}"), "bag"),
        (format!("bag export {scene} --cloud"), "bag"),
        (format!("bag export {scene} --format vtu"), "grids"),
        (format!("bag export {scene} --format csv"), "table.csv"),
        (format!("bag render {scene} --frames 1"), "picture.png"),
        (format!("bag import {arrays} --format npz"), "imported"),
    ];
    for (words, name) in cases {
        let output = folder.path(name);
        if !Path::new(&output).exists() {
            succeed(to(&words, &output));
        }
        let made = |path: &str| fs::symlink_metadata(path).unwrap().modified().unwrap();
        let before = made(&output);
        let message = fail(1, to(&words, &output));
        assert!(message.contains("already exists; choose another --output"), "{words}: {message}");
        assert_eq!(made(&output), before, "{words}");
        succeed(to(&words, &output).into_iter().chain(["--force".to_owned()]));
        assert_ne!(made(&output), before, "{words}");
    }
    assert!(folder.names().iter().all(|name| !name.starts_with('.')), "{:?}", folder.names());
}

#[test]
fn nothing_of_another_kind_is_ever_replaced() {
    let folder = Folder::new();
    let notes = folder.join("work/notes.txt");
    fs::create_dir(folder.join("work")).unwrap();
    fs::write(&notes, "mine").unwrap();
    fs::write(folder.join("work/a_0.mcap"), "").unwrap();
    fs::write(folder.join("thesis.pdf"), "mine").unwrap();
    std::os::unix::fs::symlink(folder.join("work"), folder.join("link")).unwrap();
    let cut = format!("bag cut {SAMPLE} --end 0.1 --force");
    for (words, name) in [
        (cut.as_str(), "work"),
        (&cut, "link"),
        (&cut, "thesis.pdf"),
        ("simulate --preset snowball --duration 0.016 --force", "work"),
        (&format!("bag render {SAMPLE} --force"), "work"),
        (&format!("bag export {SAMPLE} --format ply --force"), "work"),
    ] {
        let message = fail(1, to(words, &folder.path(name)));
        assert!(message.contains("--force replaces only "), "{words}: {message}");
        assert_eq!(fs::read_to_string(&notes).unwrap(), "mine");
    }
    assert_eq!(folder.names(), ["link", "thesis.pdf", "work"]);
}

#[test]
fn a_command_that_fails_gives_the_old_output_back() {
    let folder = Folder::new();
    let bag = folder.path("bag");
    succeed(to(&format!("bag cut {SAMPLE} --end 0.1"), &bag));
    let before = BagReader::open(&folder.join("bag")).unwrap().message_count();
    // Nothing is recorded so late.
    let message = fail(1, to(&format!("bag cut {SAMPLE} --start 1000 --force"), &bag));
    assert!(message.contains("found no messages"), "{message}");
    let message = fail(1, to(&format!("bag cut {bag} --end 0.05 --force"), &bag));
    assert!(message.contains("is also an input"), "{message}");
    assert_eq!(BagReader::open(&folder.join("bag")).unwrap().message_count(), before);
    assert_eq!(folder.names(), ["bag"]);
}

#[test]
fn a_recording_without_a_name_is_named_after_the_time() {
    let world = World::new("unnamed");
    let topics = format!("^{}/", world.prefix);
    let mut words = world.words("shm", "words");
    let record = || {
        let mut command = talking_eddy();
        command.args(["record", "--regex", &topics, "--from", "shm", "--max-messages", "1"]);
        command.current_dir(world.folder.path());
        Process::start_until(&mut command, "recording ")
    };
    // Within a second of each other.
    let mut recorders = [record(), record()];
    wait_for("both listen", || (words.subscribers() > 1).then_some(()));
    words.publish_cdr(&word("one")).unwrap();
    for recorder in &mut recorders {
        assert!(recorder.wait().success());
    }
    let entries = fs::read_dir(world.folder.path()).unwrap().map(|entry| entry.unwrap().path());
    let bags: Vec<PathBuf> = entries.collect();
    assert_eq!(bags.len(), 2, "{bags:?}");
    for bag in bags {
        let name = bag.file_name().unwrap().to_str().unwrap();
        let date = name.strip_prefix("eddy_").unwrap();
        assert!(date.starts_with("20") && date.as_bytes()[10] == b'-', "{name}");
        assert_eq!(BagReader::open(&bag).unwrap().message_count(), 1);
    }
}
