use std::{
    fs,
    num::NonZeroUsize,
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
};

use anyhow::{Context as _, bail};
use eddy_frames::progress::{Progress, Silent};
use serde::{Deserialize, Serialize};
use tempfile::TempDir;

use super::{state::Sharing, *};

/// Writes texts to files; `fail` fails.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Texts {
    folder: PathBuf,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Text {
    file: String,
    text: String,
}

impl Job for Texts {
    type Work = Text;

    fn kind(&self, work: &Text) -> &'static str {
        if work.text == "end" { "end" } else { "part" }
    }

    fn run(&self, work: &Text, progress: &dyn Progress) -> anyhow::Result<Option<String>> {
        if progress.cancelled() {
            return Ok(None);
        }
        if work.text == "fail" && !self.folder.join("mended").exists() {
            bail!("it was told to fail");
        }
        let file = self.folder.join(&work.file);
        let before = fs::read_to_string(&file).unwrap_or_default();
        fs::write(&file, before + &work.text).context("cannot write")?;
        Ok(Some("written".to_owned()))
    }
}

/// Two parts and an end that needs both.
fn tasks(folder: &Path, texts: [&str; 2]) -> Vec<Task<Text>> {
    let cost = |seconds| Cost { seconds, cores: 1, memory: 10, gpus: 0 };
    let task = |name: &str, text: &str, inputs: &[&str]| Task {
        name: name.to_owned(),
        work: Text { file: name.to_owned(), text: text.to_owned() },
        inputs: inputs.iter().map(|input| folder.join(input)).collect(),
        outputs: vec![folder.join(name)],
        cost: cost(text.len() as f64),
    };
    vec![task("a", texts[0], &[]), task("b", texts[1], &[]), task("end", "end", &["a", "b"])]
}

fn plan(texts: [&str; 2]) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("plan.json");
    let job = Texts { folder: folder.path().to_owned() };
    Plan::new(job, tasks(folder.path(), texts)).save(&file).unwrap();
    (folder, file)
}

fn open(file: &Path) -> OpenPlan<Texts> {
    OpenPlan::read(file).unwrap()
}

fn error(file: &Path) -> String {
    OpenPlan::<Texts>::read(file).err().unwrap().to_string()
}

fn names(plan: &OpenPlan<Texts>) -> Vec<&'static str> {
    plan.states().unwrap().iter().map(TaskState::name).collect()
}

const TWO: NonZeroUsize = NonZeroUsize::new(2).unwrap();

#[test]
fn all_tasks_run_after_those_whose_outputs_they_read_and_once() {
    let (folder, file) = plan(["1", "22"]);
    let plan = open(&file);
    assert_eq!(names(&plan), ["ready", "ready", "waiting"]);
    plan.run_all(TWO, &Silent).unwrap();
    assert_eq!(names(&plan), ["done", "done", "done"]);
    plan.run_all(TWO, &Silent).unwrap();
    assert_eq!(plan.run_task(1, &Silent).unwrap(), Outcome::AlreadyDone);
    assert_eq!(fs::read_to_string(folder.path().join("b")).unwrap(), "22");
    // What was removed is written again.
    fs::remove_file(folder.path().join("b")).unwrap();
    assert_eq!(names(&plan), ["done", "ready", "done"]);
    assert_eq!(plan.run_task(1, &Silent).unwrap(), Outcome::Done("written".to_owned()));
}

#[test]
fn a_task_without_its_inputs_names_them_and_the_tasks_that_write_them() {
    let (folder, file) = plan(["1", "2"]);
    let plan = open(&file);
    plan.run_task(0, &Silent).unwrap();
    let error = plan.run_task(2, &Silent).unwrap_err().to_string();
    let missing = folder.path().join("b").display().to_string();
    let expected = format!("task 2, end: cannot start without {missing}, the output of task 1, b");
    assert_eq!(error, expected);
}

#[test]
fn a_failure_stops_only_the_tasks_that_need_it_and_is_counted() {
    let (folder, file) = plan(["fail", "2"]);
    let plan = open(&file);
    for failures in 1..=2 {
        let error = plan.run_all(TWO, &Silent).unwrap_err().to_string();
        assert!(
            error.starts_with("task 0, a: it was told to fail\n1 of 3 tasks are done"),
            "{error}"
        );
        let [
            TaskState::Failed { failures: counted, reason },
            TaskState::Done { .. },
            TaskState::Waiting,
        ] = &plan.states().unwrap()[..]
        else {
            panic!("{:?}", plan.states())
        };
        assert_eq!((*counted, reason.as_str()), (failures, "it was told to fail"));
    }
    fs::write(folder.path().join("mended"), "").unwrap();
    plan.run_all(TWO, &Silent).unwrap();
    assert_eq!(names(&plan), ["done"; 3]);
}

#[test]
fn a_task_and_a_plan_are_run_by_one_process_at_a_time() {
    let (folder, file) = plan(["1", "2"]);
    let plan = open(&file);
    let me = format!("process {} on ", std::process::id());
    {
        let _task = plan.state.lock_task("a").unwrap().unwrap();
        let error = plan.run_task(0, &Silent).unwrap_err().to_string();
        assert!(error.starts_with(&format!("task 0, a: is being run by {me}")), "{error}");
        assert_eq!(names(&plan)[0], "running");
        // Other tasks run at the same time.
        plan.run_task(1, &Silent).unwrap();
    }
    {
        let _all = plan.state.lock_plan(Sharing::Exclusive).unwrap().unwrap();
        for error in
            [plan.run_all(TWO, &Silent).unwrap_err(), plan.run_task(0, &Silent).unwrap_err()]
        {
            let error = error.to_string();
            assert!(error.contains(&format!("plan.json: is being run by {me}")), "{error}");
        }
    }
    {
        let _one = plan.state.lock_plan(Sharing::Shared).unwrap().unwrap();
        let error = plan.run_all(TWO, &Silent).unwrap_err().to_string();
        assert!(error.contains("other processes, which run single tasks"), "{error}");
        assert!(!folder.path().join("a").exists());
    }
    plan.run_all(TWO, &Silent).unwrap();
}

#[test]
fn plans_of_other_versions_are_rejected_by_field() {
    let (_folder, file) = plan(["1", "2"]);
    let text = fs::read_to_string(&file).unwrap();
    let version = format!("\"eddy\": \"{}\"", env!("CARGO_PKG_VERSION"));
    for (from, to, words) in [
        (
            "\"format\": 1",
            "\"format\": 2, \"new\": 1",
            "plan.json: format: found 2, expected 1: a plan is run by",
        ),
        (version.as_str(), "\"eddy\": \"9.0.0\"", "plan.json: eddy: found 9.0.0, expected "),
        (version.as_str(), "\"other\": 1", "plan.json: eddy: found nothing, expected "),
        (
            "\"tasks\"",
            "\"task\"",
            "plan.json: not a plan of this version of eddy: unknown field `task`",
        ),
    ] {
        assert!(text.contains(from), "{from}");
        fs::write(&file, text.replacen(from, to, 1)).unwrap();
        let error = error(&file);
        assert!(error.contains(words), "{error}");
    }
}

#[test]
fn contradictory_tasks_are_rejected() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("plan.json");
    let usual = tasks(folder.path(), ["1", "2"]);
    type Change = fn(&mut Vec<Task<Text>>);
    let cases: [(Change, &str); 4] = [
        (
            |tasks| tasks[1].name = "a".into(),
            "tasks[1].name: found a, expected a name that no other",
        ),
        (|tasks| tasks[1].name = "../a".into(), "tasks[1].name: found ../a, expected words"),
        (|tasks| tasks[1].outputs = tasks[0].outputs.clone(), "tasks[1].outputs: found "),
        (|tasks| tasks.swap(0, 2), "tasks[0].inputs: found "),
    ];
    for (change, words) in cases {
        let mut changed = usual.clone();
        change(&mut changed);
        let job = Texts { folder: folder.path().to_owned() };
        Plan::new(job, changed).save(&file).unwrap();
        let error = error(&file);
        assert!(error.contains(words), "{error}");
    }
}

#[test]
fn another_plan_under_the_same_name_has_other_states() {
    let (folder, file) = plan(["1", "2"]);
    open(&file).run_all(TWO, &Silent).unwrap();
    let job = Texts { folder: folder.path().to_owned() };
    Plan::new(job, tasks(folder.path(), ["1", "3"])).save(&file).unwrap();
    assert_eq!(names(&open(&file)), ["ready"; 3]);
}

/// Cancels after the first task.
#[derive(Default)]
struct Once(AtomicBool);

impl Progress for Once {
    fn advance(&self, _: u64) {
        self.0.store(true, Ordering::Relaxed);
    }

    fn cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

#[test]
fn an_interrupted_plan_resumes() {
    let (_folder, file) = plan(["1", "2"]);
    let plan = open(&file);
    let error = plan.run_all(NonZeroUsize::MIN, &Once::default()).unwrap_err().to_string();
    assert!(error.starts_with("interrupted: 1 of 3 tasks are done"), "{error}");
    plan.run_all(NonZeroUsize::MIN, &Silent).unwrap();
}

#[test]
fn arrays_have_the_tasks_that_are_not_done_and_their_largest_cost() {
    let (_folder, file) = plan(["1", "22"]);
    let plan = open(&file);
    let arrays = plan.arrays(&plan.states().unwrap());
    let found: Vec<_> =
        arrays.iter().map(|a| (a.kind, a.first, a.indices.as_str(), &a.after[..])).collect();
    assert_eq!(found, [("part", 0, "0-1", &[][..]), ("end", 2, "0", &[0][..])]);
    assert_eq!(arrays[0].cost.seconds, 2.0);
    plan.run_task(0, &Silent).unwrap();
    let arrays = plan.arrays(&plan.states().unwrap());
    assert_eq!((arrays[0].first, arrays[0].indices.as_str(), arrays[1].after.len()), (1, "0", 1));
}

#[test]
fn tasks_are_found_by_number_and_name() {
    let (_folder, file) = plan(["1", "2"]);
    let plan = open(&file);
    assert_eq!((plan.find("2").unwrap(), plan.find("b").unwrap()), (2, 1));
    let error = plan.find("ends").unwrap_err().to_string();
    assert!(
        error.contains("found ends, expected a name") && error.ends_with("did you mean end?"),
        "{error}"
    );
    assert!(plan.find("3").is_err());
}

#[test]
fn paths_start_in_the_folder_in_which_the_plan_was_written_wherever_it_is_mounted() {
    let (folder, file) = plan(["1", "2"]);
    let inside = folder.path().join("plans/deep/plan.json");
    let job = Texts { folder: folder.path().to_owned() };
    let new = || Plan::new(job.clone(), tasks(folder.path(), ["1", "2"]));
    new().starting_in(folder.path(), &inside).save(&inside).unwrap();
    assert_eq!(open(&inside).directory().unwrap(), folder.path().canonicalize().unwrap());
    fs::rename(folder.path().join("plans"), folder.path().join("moved")).unwrap();
    let moved = open(&folder.path().join("moved/deep/plan.json"));
    assert_eq!(moved.directory().unwrap(), folder.path().canonicalize().unwrap());
    new().starting_in(&folder.path().join("gone"), &file).save(&file).unwrap();
    let error = open(&file).directory().unwrap_err().to_string();
    assert!(
        error.contains("plan.json: directory: found ") && error.contains("expected the folder"),
        "{error}"
    );
}
