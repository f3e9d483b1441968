//! `eddy-lab study`: each comparison from nothing to its report, with stops on the way.

use std::{fs, path::Path, time::SystemTime};

use eddy_evaluation::Report;
use tempfile::TempDir;

use crate::documented::root;
use crate::support::{Process, fail, is_a_page_of_its_own, succeed, talking_eddy as talking_lab};

/// Small enough for a test; three scenes of each preset.
const SETTINGS: &str = r#"
seeds = [1, 2]
cores = ["mingru", "gru", "mlp"]
windows = [1, 2]
density_weights = [0.001, 0.0]
activations = ["tanh", "elu"]
outputs = ["residual", "position"]
data_sets = [{ scenes = 3 }, { scenes = 4, same_bodies = true, order = "curve" }]
step_seconds = 0.01
step_frames = [2]

[data]
scenes = 3
test_scenes = 2
duration = 0.6

[training]
epochs = 2

[training.network]
encoder = 8
hidden = 16

[training.windows]
batch = 4
per_epoch = 8

[dense]
width = 8
epochs = 2
batch = 4
per_epoch = 8

[evaluation]
horizon = 5
starts = 1
"#;

struct Study {
    folder: TempDir,
}

impl Study {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("study.toml"), SETTINGS).unwrap();
        Self { folder }
    }

    fn arguments(&self, comparison: &str) -> Vec<String> {
        let path = |name: &str| self.folder.path().join(name).to_str().unwrap().to_owned();
        let words = ["study", comparison, "--config", &path("study.toml"), "--jobs", "2"];
        let words = words.map(str::to_owned).into_iter();
        words.chain(["--output".to_owned(), path("out")]).collect()
    }

    fn run(&self, comparison: &str) -> String {
        succeed(self.arguments(comparison))
    }

    fn read(&self, name: &str) -> String {
        fs::read_to_string(self.folder.path().join("out").join(name)).unwrap()
    }

    fn write(&self, name: &str, text: &str) {
        fs::write(self.folder.path().join("out").join(name), text).unwrap();
    }
}

fn changed(file: &Path) -> SystemTime {
    fs::metadata(file).unwrap().modified().unwrap()
}

#[test]
fn cores_are_trained_judged_and_reported_and_a_second_run_only_reports() {
    let study = Study::new();
    let printed = study.run("cores");
    assert!(printed.contains("fluid-3: Free rollouts"), "{printed}");
    let tables = study.read("cores/tables.md");
    for words in [
        "## fluid",
        "## multi-material",
        "## Training speed",
        "| mingru / gru |",
        "| gru / mingru |",
        "| linear fit |",
        "| time to loss ",
    ] {
        assert!(tables.contains(words), "{words}: {tables}");
    }
    is_a_page_of_its_own(&study.read("cores/report.html"));
    let report = study.folder.path().join("out/cores/fluid-3");
    let judged = Report::load(&report).unwrap();
    // Three cores with two seeds, then who learns nothing; of three scenes one judges.
    let names: Vec<&str> = judged.predictors.iter().map(|p| p.name.as_str()).collect();
    assert!(names[0].ends_with("mingru/seed-1") && names[5].ends_with("mlp/seed-2"), "{names:?}");
    assert_eq!((judged.streams, judged.horizon), (1, 5));
    assert!(judged.made.command.starts_with("eddy eval --checkpoint "), "{}", judged.made.command);

    let network = study.folder.path().join("out/runs/fluid-3/gru/seed-2/model.safetensors");
    let before = (changed(&network), changed(&report.join("report.json")));
    study.run("cores");
    assert_eq!((changed(&network), changed(&report.join("report.json"))), before);
    assert_eq!(study.read("cores/tables.md"), tables);
}

#[test]
fn what_was_trained_otherwise_or_is_damaged_is_not_taken_for_ours() {
    let study = Study::new();
    study.run("loss");
    let tables = study.read("loss/tables.md");
    assert!(tables.contains("| density weight 0 / density weight 0.001 |"), "{tables}");

    let file = study.folder.path().join("study.toml");
    fs::write(&file, SETTINGS.replace("hidden = 16", "hidden = 8")).unwrap();
    let error = fail(1, study.arguments("loss"));
    assert!(error.contains("trained.toml: result of a training with other settings"), "{error}");
    // The same networks are judged again where that is asked for otherwise.
    fs::write(&file, SETTINGS.replace("starts = 1", "starts = 2")).unwrap();
    study.run("loss");
    assert!(study.read("loss/tables.md").contains("1 scenes, 2 rollouts"));
    fs::write(&file, SETTINGS).unwrap();
    study.write("runs/fluid-3/mingru/seed-1/trained.toml", "epochs = 1");
    let error = fail(1, study.arguments("loss"));
    assert!(error.contains("trained.toml: found TOML parse error"), "{error}");
}

#[test]
fn a_study_that_was_stopped_goes_on() {
    let study = Study::new();
    let mut command = talking_lab();
    command.args(study.arguments("window"));
    // The first network's line: some are trained, others not.
    let mut process = Process::start_until(&mut command, "fluid-3 mingru");
    process.interrupt();
    assert!(!process.wait().success());
    assert!(!study.folder.path().join("out/window").exists());
    study.run("window");
    let tables = study.read("window/tables.md");
    assert!(tables.contains("| mingru, T = 2 / mingru, T = 1 |"), "{tables}");
}

#[test]
fn activations_have_learning_curves_that_a_seed_gives_again() {
    let study = Study::new();
    study.run("activations");
    let tables = study.read("activations/tables.md");
    for words in ["| tanh |", "| elu |", "| next frame = this frame |"] {
        assert!(tables.contains(words), "{words}: {tables}");
    }
    let [curve, other] = ["elu-1", "elu-2"].map(|name| format!("curves/fluid-3/{name}.toml"));
    let first = study.read(&curve);
    assert_ne!(first, study.read(&other));
    fs::remove_file(study.folder.path().join("out").join(&curve)).unwrap();
    study.run("activations");
    assert_eq!(study.read(&curve), first);
}

#[test]
fn outputs_and_scenes_are_compared() {
    let study = Study::new();
    study.run("output");
    let tables = study.read("output/tables.md");
    assert!(tables.contains("| mingru, position / mingru, residual |"), "{tables}");

    let printed = study.run("scenes");
    let tables = study.read("scenes/tables.md");
    let other = "fluid-4-same-bodies-curve";
    assert!(
        tables.contains("## fluid-3\n") && tables.contains(&format!("## {other}\n")),
        "{tables}"
    );
    assert!(printed.contains(other), "{printed}");
    let manifest = study.read(&format!("data/{other}/manifest.json"));
    assert!(manifest.contains("\"same_bodies\":true"), "{manifest}");
    // All are evaluated on the same scenes, but for the order of the particles.
    for (set, test) in [("fluid-3", "fluid-test-2"), (other, "fluid-test-2-curve")] {
        let report = Report::load(&study.folder.path().join("out/scenes").join(set)).unwrap();
        assert!(report.made.command.contains(&format!("data/{test} ")), "{}", report.made.command);
        assert_eq!(report.streams, 2);
    }
    // Other comparisons take the network from there.
    let network = study.folder.path().join("out/runs/fluid-3/mingru/seed-1/model.safetensors");
    let before = changed(&network);
    study.run("loss");
    assert_eq!(changed(&network), before);
}

#[test]
fn settings_that_cannot_be_used_are_refused_before_anything_is_written() {
    let study = Study::new();
    let file = study.folder.path().join("study.toml");
    for (line, words) in [
        ("seeds = [1, 1]", "seeds: found [1, 1], expected at least one, without duplicates"),
        ("windows = []", "windows: found [], expected at least one"),
        ("[data]\nscenes = 2", "data.scenes: found 2, expected at least 3"),
        ("[training]\narchitecture = \"particle\"", "expected frame: the paper's network"),
        ("[training.network]\nhidden = 0", "network.hidden: found 0, expected 1 to 65536"),
        ("[dense]\nwidth = 0", "dense.width: found 0, expected at least 1"),
        ("step_seconds = 0", "step_seconds: found 0, expected a positive number"),
        ("[judging]\nhorizon = 21", "evaluation.horizon: found 21, expected at most 20"),
        ("color = 1", "unknown field `color`"),
    ] {
        fs::write(&file, line).unwrap();
        let error = fail(1, study.arguments("cores"));
        assert!(error.contains(words), "{line}: {error}");
        assert!(!study.folder.path().join("out").exists(), "{line}");
    }
}

/// Interrupted during its simulation; the whole study would take an hour.
#[test]
fn the_papers_study_begins_with_the_settings_for_two_cores() {
    let folder = tempfile::tempdir().unwrap();
    let settings = root().join("launch_configs/study/two_cores.toml");
    let mut command = talking_lab();
    command.args(["study", "cores", "--paper", "--config", settings.to_str().unwrap()]);
    command.args(["--output", folder.path().to_str().unwrap()]);
    let mut study = Process::start_until(&mut command, "eddy simulate --preset fluid --scenes 60");
    study.interrupt();
    assert!(!study.wait().success());
}
