use std::{
    fs,
    num::NonZeroUsize,
    path::Path,
    sync::{
        Mutex,
        atomic::{AtomicBool, Ordering},
    },
    time::SystemTime,
};

use super::*;
use eddy_evaluation::Report;
use eddy_frames::progress::Progress;
use eddy_inference::checkpoint::Core;
use eddy_learning::model::{DeviceKind, Precision};

/// Small enough for a test: three scenes, two networks of two epochs, or two learning curves.
pub(crate) fn request(comparison: Comparison, output: &Path) -> StudyRequest {
    let mut study = StudyConfig::quick();
    study.seeds = vec![1, 2];
    (study.data.scenes, study.data.duration) = (3, Some(0.4));
    study.data.presets.truncate(1);
    study.cores = vec![Core::MinGru];
    study.density_weights = vec![0.0];
    (study.dense.width, study.dense.epochs) = (8, 2);
    (study.dense.batch, study.dense.per_epoch) = (4, 8);
    study.activations.truncate(1);
    let training = &mut study.training;
    (training.network.encoder, training.network.hidden) = (8, 16);
    (training.windows.batch, training.windows.per_epoch, training.epochs) = (4, 8, 2);
    (study.evaluation.horizon, study.evaluation.starts) = (3, 1);
    (study.step_frames, study.step_seconds) = (vec![2], 0.01);
    let (output, device) = (output.to_owned(), DeviceKind::Flex);
    let (jobs, gpus, precision) = (NonZeroUsize::MIN, NonZeroUsize::MIN, Precision::default());
    StudyRequest { comparison, study, output, jobs, device, gpus, precision }
}

/// Collects messages; cancels after the first that contains the given text.
#[derive(Default)]
struct Lines {
    cancel_at: Option<&'static str>,
    told: Mutex<Vec<String>>,
    cancelled: AtomicBool,
}

impl Lines {
    fn until(words: &'static str) -> Self {
        Self { cancel_at: Some(words), ..Self::default() }
    }

    /// How many lines contain the words.
    fn count(&self, words: &str) -> usize {
        self.told.lock().unwrap().iter().filter(|line| line.contains(words)).count()
    }
}

impl Progress for Lines {
    fn message(&self, line: &str) {
        self.told.lock().unwrap().push(line.to_owned());
        if self.cancel_at.is_some_and(|words| line.contains(words)) {
            self.cancelled.store(true, Ordering::Relaxed);
        }
    }

    fn cancelled(&self) -> bool {
        self.cancelled.load(Ordering::Relaxed)
    }
}

fn changed(file: &Path) -> SystemTime {
    fs::metadata(file).unwrap().modified().unwrap()
}

#[test]
fn a_cancelled_study_resumes_without_repeating_finished_parts() {
    let folder = tempfile::tempdir().unwrap();
    let request = request(Comparison::Loss, folder.path());
    let first = Lines::until("seed 1: 2 epochs in");
    let error = run(&request, &first).unwrap_err();
    assert!(error.to_string().contains("interrupted"), "{error}");
    assert_eq!(first.count("epochs in"), 1);
    let folders = Folders::new(folder.path());
    assert!(!folders.report(Comparison::Loss).exists());
    let name = &Comparison::Loss.variants(&request.study)[0].name;
    let [network, other] =
        [1, 2].map(|seed| folders.run("fluid-3", name, seed).join("trained.toml"));
    let before = changed(&network);
    assert!(!other.exists());

    let second = Lines::default();
    let outcome = run(&request, &second).unwrap();
    assert_eq!((second.count("seed 1:"), second.count("seed 2: 2 epochs in")), (0, 1));
    assert_eq!(changed(&network), before);
    assert!(outcome.page.exists());
    assert_eq!(outcome.summaries.len(), 1);

    // Nothing is simulated, trained or evaluated again.
    let folder = folders.evaluation(Comparison::Loss, "fluid-3");
    let before = changed(&folder.join("report.json"));
    let third = Lines::default();
    run(&request, &third).unwrap();
    assert_eq!(third.count("3 of 3 scenes are already in"), 1);
    assert_eq!((third.count("epochs in"), third.count("eddy eval")), (0, 0));
    assert_eq!(changed(&folder.join("report.json")), before);
}

#[test]
fn the_evaluation_of_a_study_records_the_equivalent_command() {
    let folder = tempfile::tempdir().unwrap();
    let request = request(Comparison::Loss, folder.path());
    let lines = Lines::default();
    run(&request, &lines).unwrap();
    let report = Folders::new(folder.path()).evaluation(Comparison::Loss, "fluid-3");
    let command = Report::load(&report).unwrap().made.command;
    let root = folder.path().display();
    let networks =
        ["seed-1", "seed-2"].map(|seed| format!("{root}/runs/fluid-3/mingru-density-0/{seed}"));
    let expected = format!(
        "eddy eval --checkpoint {} {} --data {root}/data/fluid-3 --horizon 3 --starts 1 --join-late --output {root}/loss/fluid-3",
        networks[0], networks[1]
    );
    assert_eq!(command, expected);
    assert_eq!(lines.count(&command), 1);
    // Another number of rollouts is evaluated again.
    let mut more = request;
    more.study.evaluation.starts = 2;
    let lines = Lines::default();
    run(&more, &lines).unwrap();
    assert_eq!((lines.count("epochs in"), lines.count("--starts 2")), (0, 1));
}

#[test]
fn existing_learning_curves_are_not_computed_again() {
    let folder = tempfile::tempdir().unwrap();
    let request = request(Comparison::Activations, folder.path());
    let first = Lines::until("seed 1: validation loss");
    run(&request, &first).unwrap_err();
    let second = Lines::default();
    run(&request, &second).unwrap();
    let loss = ": validation loss";
    assert_eq!((first.count(loss), second.count(loss)), (1, 1));
}

#[test]
fn an_invalid_request_is_rejected_before_anything_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("out");
    let usual = request(Comparison::Loss, &output);
    let mut unknown = usual.clone();
    unknown.study.data.presets = vec!["gas".to_owned()];
    let mut narrow = usual.clone();
    narrow.study.training.network.hidden = 0;
    let mut elsewhere = request(Comparison::Activations, &output);
    elsewhere.device = DeviceKind::Ndarray;
    let mut two_gpus = usual;
    two_gpus.gpus = NonZeroUsize::new(2).unwrap();
    for (request, words) in [
        (unknown, "data.presets: found gas, expected multi-material, fluid, stiff or kinds"),
        (narrow, "network.hidden: found 0, expected 1 to 65536"),
        (two_gpus, "--gpus: found 2 with --device flex, expected --device cuda"),
        (elsewhere, "--device: found ndarray, expected flex or cuda"),
    ] {
        let error = run(&request, &Lines::default()).unwrap_err();
        assert!(error.to_string().contains(words), "{error}");
        assert!(!output.exists());
    }
}
