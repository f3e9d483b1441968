//! `eddy-lab plan`: the tasks of a data set, run by several processes that are killed and that get in each other's way.

use std::{collections::BTreeMap, fs, path::Path, process::Command};

use tempfile::TempDir;

use crate::support::{Process, fail, succeed, talking_eddy as talking_lab, wait_for};

/// A plan of scenes, and a folder for it.
struct Planned {
    folder: TempDir,
}

impl Planned {
    fn new(scenes: &str, duration: &str) -> Self {
        let planned = Self { folder: tempfile::tempdir().unwrap() };
        planned.write(scenes, duration, &[]);
        planned
    }

    fn write(&self, scenes: &str, duration: &str, more: &[&str]) {
        let (file, output) = (self.path("plan.json"), self.path("data"));
        let words = ["plan", "simulate", &file, "--output", &output];
        succeed([&words[..], &options(scenes, duration), more].concat());
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().unwrap().to_owned()
    }

    fn arguments(&self, more: &[&str]) -> Vec<String> {
        let words = ["plan".to_owned(), "run".to_owned(), self.path("plan.json")];
        words.into_iter().chain(more.iter().map(|&word| word.to_owned())).collect()
    }

    fn run(&self, more: &[&str]) {
        succeed(self.arguments(more));
    }

    fn fail(&self, more: &[&str]) -> String {
        fail(1, self.arguments(more))
    }

    fn list(&self, more: &[&str]) -> String {
        succeed([&["plan", "list", &self.path("plan.json")][..], more].concat())
    }

    /// The same scenes from `eddy simulate`.
    fn expected(&self, scenes: &str, duration: &str) -> BTreeMap<String, Vec<u8>> {
        let output = self.path("alone");
        let mut simulate = Command::new(crate::eddy());
        simulate.args(["--quiet", "simulate", "--output", &output]).args(options(scenes, duration));
        assert!(simulate.status().unwrap().success());
        contents(Path::new(&output))
    }

    fn data(&self) -> BTreeMap<String, Vec<u8>> {
        contents(&self.folder.path().join("data"))
    }
}

fn options<'a>(scenes: &'a str, duration: &'a str) -> [&'a str; 8] {
    ["--preset", "kinds", "--scenes", scenes, "--seed", "2", "--duration", duration]
}

/// All files of a folder with their bytes.
fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.to_owned()];
    while let Some(next) = open.pop() {
        for entry in fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().to_str().unwrap().to_owned();
                found.insert(name, fs::read(path).unwrap());
            }
        }
    }
    found
}

#[test]
fn tasks_of_several_processes_give_the_data_of_one_byte_for_byte() {
    let planned = Planned::new("5", "0.4");
    let arrays = planned.list(&["--arrays"]);
    assert!(arrays.starts_with("0 simulate 0 0-4 - 1 0 "), "{arrays}");
    assert!(arrays.contains("\n1 manifest 5 0 0 1 0 "), "{arrays}");
    let error = planned.fail(&["--task", "manifest"]);
    let words =
        "task 5, manifest: cannot start without data/scene_0000, the output of task 0, scene-0000";
    assert!(error.replace(&planned.path(""), "").contains(words), "{error}");
    planned.run(&["--task", "3", "scene-0001"]);
    let rows: serde_json::Value = serde_json::from_str(&planned.list(&["--json"])).unwrap();
    let states: Vec<_> = (0..6).map(|task| rows[task]["state"].as_str().unwrap()).collect();
    assert_eq!(states, ["ready", "done", "ready", "done", "ready", "waiting"]);
    assert!(planned.list(&["--arrays"]).starts_with("0 simulate 0 0,2,4 - "));
    planned.run(&["--jobs", "2"]);
    assert_eq!(planned.data(), planned.expected("5", "0.4"));
    assert!(planned.list(&[]).contains("6 of 6 tasks are done"));
    assert_eq!(planned.list(&["--arrays"]), "");
}

#[test]
fn a_process_that_is_killed_and_a_second_one_at_the_same_time_do_no_harm() {
    // Long enough to be killed in the middle.
    let planned = Planned::new("2", "40");
    let start = |more: &[&str]| {
        let mut command = talking_lab();
        command.args(planned.arguments(more));
        let process = Process::start(&mut command);
        let lock = planned.path(if more.is_empty() {
            "plan.state/lock"
        } else {
            "plan.state/scene-0000.lock"
        });
        // The file of a process that was killed is still there.
        let id = process.id().to_string();
        let holds = || fs::read_to_string(&lock).is_ok_and(|text| text.contains(&id)).then_some(());
        wait_for("it has started", holds);
        process
    };
    let process = start(&["--task", "0"]);
    let id = format!("process {} on ", process.id());
    let error = planned.fail(&["--task", "0"]);
    assert!(error.contains(&format!("task 0, scene-0000: is being run by {id}")), "{error}");
    let error = planned.fail(&[]);
    assert!(
        error.contains("plan.json: is being run by other processes, which run single"),
        "{error}"
    );
    assert!(planned.list(&[]).contains("running"));
    process.kill();

    let process = start(&[]);
    let id = format!("process {} on ", process.id());
    for more in [&["--jobs", "2"][..], &["--task", "1"]] {
        let error = planned.fail(more);
        assert!(error.contains(&format!("plan.json: is being run by {id}")), "{error}");
    }
    process.kill();
    assert!(!planned.folder.path().join("data/scene_0000").exists());

    let mut process = start(&[]);
    wait_for("a task is running", || planned.list(&[]).contains("running").then_some(()));
    process.interrupt();
    assert!(!process.wait().success());
    assert!(planned.list(&[]).contains("0 of 3 tasks are done"));
    // Shorter ones under the same name are other tasks in another directory.
    fs::remove_dir_all(planned.path("data")).unwrap();
    planned.write("2", "0.4", &["--force"]);
    planned.run(&[]);
    assert_eq!(planned.data(), planned.expected("2", "0.4"));
}

#[test]
fn plans_that_cannot_be_used_are_rejected_in_one_sentence() {
    let planned = Planned::new("2", "0.4");
    let file = planned.path("plan.json");
    let text = fs::read_to_string(&file).unwrap();
    let list = || fail(1, ["plan", "list", &file]);
    for (from, to, words) in [
        (
            "\"eddy\": \"",
            "\"eddy\": \"9.",
            "plan.json: eddy: found 9.0.1.0, expected 0.1.0: a plan is run by",
        ),
        (
            "\"format\": 1",
            "\"format\": 7",
            "plan.json: format: found 7, expected 1: a plan is run by",
        ),
        ("\"directory\": \"", "\"directory\": \"/gone", "plan.json: directory: found /gone"),
        ("scene-0001", "scene-0000", "plan.json: tasks[1].name: found scene-0000, expected a name"),
    ] {
        assert!(text.contains(from), "{from}");
        fs::write(&file, text.replacen(from, to, 1)).unwrap();
        let error = list();
        assert!(error.contains(words), "{error}");
        assert_eq!(error.lines().count(), 1, "{error}");
    }
    fs::write(&file, &text).unwrap();
    let error = planned.fail(&["--task", "scene-001"]);
    assert!(error.contains("--task: found scene-001, expected a name"), "{error}");
    assert!(error.contains("did you mean scene-0001?"), "{error}");
    let output = planned.path("data");
    let again = ["plan", "simulate", &file, "--output", &output];
    assert!(fail(1, again).contains("plan.json: already exists; choose another name"));
    let error = fail(
        2,
        [
            "plan", "simulate", "new.json", "--output", &output, "--preset", "fountain",
            "--scenes", "2",
        ],
    );
    assert!(error.contains("--scenes: found 2, expected 1: a scene file"), "{error}");
    // Scenes of another request are already there.
    planned.run(&[]);
    planned.write("2", "0.6", &["--force"]);
    let error = planned.fail(&["--task", "0"]);
    assert!(error.contains("settings.duration 0.4 instead of 0.6"), "{error}");
}
