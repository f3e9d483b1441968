//! A run that stopped goes on as if it had not.

use std::{fs, num::NonZeroUsize, path::Path};

use eddy_dataset::Dataset;
use eddy_inference::checkpoint::{Architecture, Checkpoint, Core, WeightFormat};
use eddy_inference::engine::Surrogate;
use eddy_learning::train::{OptimizerKind, Schedule, TrainConfig, UnrollStage, rollout_loss};

use super::{DT, dataset, files, interrupted, resume, run, small, stream, write_bag};
use crate::support::{Process, eddy, succeed, talking_eddy, wait_for};

/// What must be the same in one go and in several.
const OUTCOME: [&str; 6] = [
    "model.toml",
    "model.safetensors",
    "metrics.csv",
    "last/model.toml",
    "last/model.safetensors",
    "last/resume.safetensors",
];

/// Compares two outputs byte by byte.
fn same(once: &Path, in_parts: &Path) {
    for file in OUTCOME {
        let (once, in_parts) = (once.join(file), in_parts.join(file));
        assert!(fs::read(once).unwrap() == fs::read(in_parts).unwrap(), "{file} differs");
    }
}

/// Four epochs with dropout; the length of the unroll changes within the second.
fn eventful(architecture: Architecture, core: Core) -> TrainConfig {
    let mut config = small(architecture, core);
    config.windows.per_epoch = 64;
    config.network.dropout = 0.2;
    config.unroll =
        vec![UnrollStage { share: 0.4, frames: 2 }, UnrollStage { share: 0.6, frames: 4 }];
    config
}

#[test]
fn a_run_in_parts_gives_the_bits_of_a_run_in_one() {
    let mut dataset = dataset();
    let Dataset { train, validation, test, .. } = &mut dataset;
    for (number, stream) in train.iter_mut().chain(validation).chain(test).enumerate() {
        stream.stiffness = Some([1e3, 2e4, 1e5][number % 3]);
    }
    // No stream is near the last stiffness: its weights are never changed.
    let knots = &[1e3, 1e5, 1e7];
    for (architecture, core, stiffness_knots, weights, optimizer) in [
        (Architecture::Particle, Core::MinGru, None, WeightFormat::F32, OptimizerKind::Muon),
        (Architecture::Particle, Core::Lstm, Some(&[][..]), WeightFormat::F16, OptimizerKind::Adam),
        (Architecture::Particle, Core::MinGru, Some(knots), WeightFormat::F16, OptimizerKind::Muon),
        (Architecture::Frame, Core::MinLstm, None, WeightFormat::F16, OptimizerKind::Adam),
        (Architecture::Frame, Core::Mlp, None, WeightFormat::F32, OptimizerKind::Muon),
    ] {
        let mut config = eventful(architecture, core);
        (config.network.weights, config.optimizer.kind) = (weights, optimizer);
        config.network.stiffness = stiffness_knots.is_some();
        config.network.stiffness_knots = stiffness_knots.unwrap_or_default().to_vec();
        let (once, in_parts) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let whole = run(&config, &dataset, once.path()).unwrap();
        let first = interrupted(&config, &dataset, in_parts.path(), config.batches() + 5);
        assert_eq!((first.epochs.len(), first.interrupted), (1, true));
        let rest = resume(&config, &dataset, in_parts.path()).unwrap();
        assert_eq!(rest.epochs, whole.epochs, "{architecture:?} {core:?}");
        assert_eq!(rest.best, whole.best);
        same(once.path(), in_parts.path());
        let format = |folder: &Path| Checkpoint::load(folder).unwrap().description.weights;
        let both = [format(once.path()), format(&once.path().join("last"))];
        assert_eq!(both, [weights, WeightFormat::F32]);
    }
}

#[test]
fn what_is_published_is_what_was_validated() {
    let mut losses = Vec::new();
    for weights in [WeightFormat::F32, WeightFormat::F16] {
        let folder = tempfile::tempdir().unwrap();
        let mut config = small(Architecture::Particle, Core::MinGru);
        (config.epochs, config.network.weights) = (1, weights);
        let [epoch] = run(&config, &dataset(), folder.path()).unwrap().epochs[..] else {
            panic!("more than one epoch")
        };
        let best = Checkpoint::load(folder.path()).unwrap();
        let surrogate = Surrogate::load(&best, NonZeroUsize::new(1)).unwrap();
        let streams = dataset().validation;
        let loss = rollout_loss(&surrogate, &config.validation, &streams).unwrap();
        assert_eq!(loss, epoch.validation_loss, "{weights:?}");
        losses.push(loss);
    }
    assert!(losses[0] != losses[1], "rounding changes nothing: {losses:?}");
}

#[test]
fn more_epochs_of_a_constant_schedule_are_those_of_a_longer_run() {
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.windows.per_epoch = 64;
    config.optimizer.schedule = Schedule::Constant;
    let (once, in_parts) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let whole = run(&config, &dataset(), once.path()).unwrap();
    let short = TrainConfig { epochs: 2, ..config.clone() };
    run(&short, &dataset(), in_parts.path()).unwrap();
    assert_eq!(resume(&config, &dataset(), in_parts.path()).unwrap().epochs, whole.epochs);
    same(once.path(), in_parts.path());
}

#[test]
fn a_run_that_is_done_stays_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.epochs = 2;
    let done = run(&config, &dataset(), folder.path()).unwrap();
    let kept = |name: &str| fs::read(folder.path().join(name)).unwrap();
    let before = OUTCOME.map(kept);
    let again = resume(&config, &dataset(), folder.path()).unwrap();
    assert_eq!((again.epochs, again.best), (done.epochs, done.best));
    assert!(OUTCOME.map(kept) == before);
}

#[test]
fn a_run_that_stopped_early_stays_so_until_it_is_given_more_patience() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = small(Architecture::Particle, Core::MinGru);
    (config.epochs, config.patience, config.windows.per_epoch) = (9, 2, 8);
    config.optimizer.learning_rate = 1e-12;
    let epochs = run(&config, &dataset(), folder.path()).unwrap().epochs.len();
    assert!(epochs < 9, "it was to stop early");
    assert_eq!(resume(&config, &dataset(), folder.path()).unwrap().epochs.len(), epochs);
    config.patience = 3;
    let more = resume(&config, &dataset(), folder.path()).unwrap().epochs;
    assert!(more.len() > epochs);
    let best = more.iter().rfind(|epoch| epoch.best).unwrap().epoch;
    assert_eq!(more.len() as u32, (best + 3).min(9));
}

#[test]
fn to_resume_what_has_not_begun_begins_it() {
    let (once, resumed) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.epochs = 1;
    run(&config, &dataset(), once.path()).unwrap();
    interrupted(&config, &dataset(), resumed.path(), 3);
    resume(&config, &dataset(), resumed.path()).unwrap();
    same(once.path(), resumed.path());
}

#[test]
fn a_folder_that_was_renamed_by_half_is_found() {
    let config = eventful(Architecture::Particle, Core::MinGru);
    let (once, cut) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    run(&config, &dataset(), once.path()).unwrap();
    interrupted(&config, &dataset(), cut.path(), 2 * config.batches());
    let place = |name: &str| cut.path().join(name);
    // The state between the two renames: the new folder is whole, the old one is out of the way.
    fs::rename(place("last"), place("last.new")).unwrap();
    fs::create_dir(place("last.old")).unwrap();
    resume(&config, &dataset(), cut.path()).unwrap();
    same(once.path(), cut.path());
    assert!(!place("last.old").exists() && !place("last.new").exists());
}

/// Fails unless going on is refused with these words and leaves every file as it is.
fn refused(output: &Path, resume: impl FnOnce() -> String, words: &[&str]) {
    let before = files(output);
    let message = resume();
    for word in words {
        assert!(message.contains(word), "`{word}` is not in: {message}");
    }
    assert!(files(output) == before, "something was changed");
}

#[test]
fn another_run_is_refused_by_what_differs() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.epochs = 2;
    run(&config, &dataset(), output).unwrap();
    let with = |change: fn(&mut TrainConfig)| {
        let mut other = config.clone();
        change(&mut other);
        move || resume(&other, &dataset(), output).unwrap_err().to_string()
    };
    let file = "last/resume.toml: ";
    refused(output, with(|c| c.seed = 7), &[file, "seed: found 7, expected 1"]);
    refused(output, with(|c| c.core = Core::Gru), &["core: found \"gru\", expected \"mingru\""]);
    refused(
        output,
        with(|c| c.windows.batch = 4),
        &["windows.batch: found 4, expected 8 as in the run to resume"],
    );
    refused(
        output,
        || {
            let frame = small(Architecture::Frame, Core::MinGru);
            resume(&frame, &dataset(), output).unwrap_err().to_string()
        },
        &["architecture: found \"frame\", expected \"particle\""],
    );
    refused(output, with(|c| c.epochs = 1), &["epochs: found 1, expected at least 2"]);
    let other_data = || {
        let mut other = dataset();
        other.digest = "another".to_owned();
        resume(&config, &other, output).unwrap_err().to_string()
    };
    refused(output, other_data, &[file, "data: found another, expected analytic"]);
}

#[test]
fn a_folder_that_holds_a_run_is_not_written_over() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.epochs = 1;
    run(&config, &dataset(), output).unwrap();
    let again = || run(&config, &dataset(), output).unwrap_err().to_string();
    refused(output, again, &["found a run", "--resume"]);
    fs::remove_dir_all(output.join("last")).unwrap();
    refused(output, again, &["found a checkpoint", "expected a folder without a run"]);
    let go_on = || resume(&config, &dataset(), output).unwrap_err().to_string();
    refused(output, go_on, &["last", "found a checkpoint but no such folder"]);
}

#[test]
fn a_best_epoch_that_was_not_yet_in_its_place_is_put_there() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    let mut config = small(Architecture::Particle, Core::MinGru);
    (config.epochs, config.network.weights) = (2, WeightFormat::F16);
    let outcome = run(&config, &dataset(), output).unwrap();
    assert!(outcome.epochs[1].best, "another epoch than the last is the best");
    let paths = ["model.toml", "model.safetensors"].map(|name| output.join(name));
    let whole = paths.each_ref().map(|path| fs::read(path).unwrap());
    let restored = || {
        resume(&config, &dataset(), output).unwrap();
        assert!(paths.each_ref().map(|path| fs::read(path).unwrap()) == whole);
    };
    for path in &paths {
        fs::remove_file(path).unwrap();
    }
    restored();
    let text = String::from_utf8(whole[0].clone()).unwrap();
    fs::write(&paths[0], text.replace("best_epoch = 2", "best_epoch = 1")).unwrap();
    restored();
}

#[test]
fn what_is_damaged_or_newer_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.epochs = 2;
    run(&config, &dataset(), output).unwrap();
    let damaged = |file: &str, damage: &dyn Fn(&[u8]) -> Vec<u8>, words: &[&str]| {
        let path = output.join(file);
        let whole = fs::read(&path).unwrap();
        fs::write(&path, damage(&whole)).unwrap();
        let go_on = || resume(&config, &dataset(), output).unwrap_err().to_string();
        refused(output, go_on, &[&[file], words].concat());
        fs::write(&path, whole).unwrap();
    };
    let replaced = |from: &'static str, to: &'static str| {
        move |bytes: &[u8]| {
            let text = std::str::from_utf8(bytes).unwrap();
            assert!(text.contains(from), "{text}");
            text.replacen(from, to, 1).into_bytes()
        }
    };
    let half = |bytes: &[u8]| bytes[..bytes.len() / 2].to_vec();
    let flipped = |bytes: &[u8]| {
        let mut bytes = bytes.to_vec();
        let last = bytes.len() - 2;
        bytes[last] ^= 1;
        bytes
    };
    let newer = replaced("format_version = 2", "format_version = 99");
    damaged("last/resume.toml", &newer, &["format_version: found 99, expected 2"]);
    let newer = replaced("format_version = 2", "format_version = 99");
    damaged("last/model.toml", &newer, &["format_version: found 99, expected 1 to 3"]);
    damaged("model.toml", &newer, &["format_version: found 99, expected 1 to 3"]);
    damaged("last/resume.toml", &half, &["record: found", "expected the record of a run"]);
    damaged("last/resume.toml", &replaced("samples", "sample"), &["sample"]);
    damaged("last/resume.toml", &replaced("key = \"", "key = \"x"), &["64 hexadecimal digits"]);
    damaged("last/resume.safetensors", &half, &["expected a complete safetensors file"]);
    damaged("last/resume.safetensors", &flipped, &["checksum: found"]);
    damaged("last/model.safetensors", &flipped, &["checksum: found"]);
    damaged("model.safetensors", &half, &["expected a complete safetensors file"]);
    fs::remove_file(output.join("last/resume.safetensors")).unwrap();
    let go_on = || resume(&config, &dataset(), output).unwrap_err().to_string();
    refused(output, go_on, &["last/resume.safetensors"]);
}

#[test]
fn a_process_that_is_killed_within_an_epoch_goes_on_to_the_same_bits() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    write_bag(&folder.path().join("bag"), &[0, 1, 2].map(stream));
    fs::write(
        path("train.toml"),
        "windows.per_epoch = 512\noptimizer.average = 0.9\nvalidation.horizon = 8\nnetwork.dropout = 0.1\nunroll = [{ share = 1.0, frames = 4 }]\n",
    )
    .unwrap();
    let (data, settings) = (path("bag"), path("train.toml"));
    let arguments = |output: &str| {
        ["train", "--data", &data, "--config", &settings, "--epochs", "4", "--output", output]
            .map(str::to_owned)
    };
    succeed(arguments(&path("once")));

    let killed = path("killed");
    let mut process = Process::start(eddy().args(arguments(&killed)));
    // The row of an epoch is the last that is written at its end: from then on the next one runs.
    wait_for("an epoch is done", || {
        let metrics = fs::read_to_string(Path::new(&killed).join("metrics.csv")).ok()?;
        (metrics.lines().count() > 1).then_some(())
    });
    assert!(process.is_running(), "the run was over before it could be killed");
    process.kill();
    let last = Checkpoint::load(&Path::new(&killed).join("last")).unwrap().description;
    assert!(last.training.epochs < 4, "the run was over before it could be killed");
    assert_eq!(last.dt, DT);

    succeed(arguments(&killed).into_iter().chain(["--resume".to_owned()]));
    // The command line is part of the description, and the two outputs have two names.
    for file in OUTCOME.iter().filter(|file| !file.ends_with("model.toml")) {
        let read = |output: &str| fs::read(Path::new(&path(output)).join(file)).unwrap();
        assert!(read("once") == read("killed"), "{file} differs");
    }
}

#[test]
fn a_process_that_is_interrupted_ends_well_and_says_how_to_go_on() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    write_bag(&folder.path().join("bag"), &[0, 1, 2].map(stream));
    fs::write(
        path("train.toml"),
        "windows.per_epoch = 512\noptimizer.average = 0.9\nvalidation.horizon = 8\nunroll = [{ share = 1.0, frames = 4 }]\n",
    )
    .unwrap();
    let mut command = talking_eddy();
    command.args(["train", "--data", &path("bag"), "--config", &path("train.toml")]);
    command.args(["--epochs", "100000", "--output", &path("model")]);
    let mut process = Process::start(&mut command);
    let last = folder.path().join("model/last/resume.toml");
    wait_for("an epoch is done", || last.exists().then_some(()));
    process.interrupt();
    assert!(process.wait().success());
    let printed = process.rest();
    assert!(printed.contains("interrupted: "), "{printed}");
    assert!(printed.contains("resume:   the same command with --resume"), "{printed}");
    let epochs = |folder: &Path| Checkpoint::load(folder).unwrap().description.training.epochs;
    let (best, last) = (folder.path().join("model"), folder.path().join("model/last"));
    assert_eq!(epochs(&best), epochs(&last), "both tell how many epochs were done");
}
