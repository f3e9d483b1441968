//! Several seeds in one command.

use std::{fs, path::Path};

use super::{stream, write_bag};
use crate::support::{eddy, fail, succeed, talking_eddy};

const SETTINGS: &str =
    "windows.per_epoch = 128\nvalidation.horizon = 8\nunroll = [{ share = 1.0, frames = 4 }]\n";

#[test]
fn each_seed_has_a_run_and_a_table_compares_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    write_bag(&folder.path().join("bag"), &[0, 1, 2].map(stream));
    fs::write(path("train.toml"), SETTINGS).unwrap();
    let (data, settings) = (path("bag"), path("train.toml"));
    let train = |output: &str, seeds: &[&str]| {
        let arguments =
            ["train", "--data", &data, "--config", &settings, "--epochs", "2", "--output", output];
        [&arguments[..], &["--seed"], seeds]
            .concat()
            .into_iter()
            .map(str::to_owned)
            .collect::<Vec<_>>()
    };
    let (all, one) = (path("all"), path("one"));
    let printed = succeed(train(&all, &["3", "1", "2"]));
    let words = ["seed", "mean", "standard deviation", "best", "validation loss", "skill at 8"];
    for word in words {
        assert!(printed.contains(word), "`{word}` is not in: {printed}");
    }
    let losses: Vec<f64> = [3, 1, 2].map(|seed| loss(&format!("{all}/seed-{seed}"))).to_vec();
    let mean = losses.iter().sum::<f64>() / 3.0;
    let squares: f64 = losses.iter().map(|loss| (loss - mean).powi(2)).sum();
    let line = |name: &str| printed.lines().find(|line| line.contains(name)).unwrap().to_owned();
    assert!(line(" mean").contains(&format!("{mean:.4}")), "{printed}");
    assert!(line("deviation").contains(&format!("{:.4}", (squares / 2.0).sqrt())), "{printed}");

    succeed(train(&one, &["2"]));
    let weights = |folder: &str| fs::read(Path::new(folder).join("model.safetensors")).unwrap();
    assert!(weights(&one) == weights(&format!("{all}/seed-2")), "a seed depends on its company");

    let message = fail(2, train(&path("twice"), &["4", "4"]));
    assert!(message.contains("--seed: found 4 twice"), "{message}");
    assert!(!Path::new(&path("twice")).exists());
}

/// The best validation loss, from the checkpoint.
fn loss(output: &str) -> f64 {
    let checkpoint = eddy_inference::checkpoint::Checkpoint::load(output.as_ref()).unwrap();
    checkpoint.description.training.validation_loss
}

#[test]
fn the_summary_says_what_came_out_and_how_to_go_on() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    write_bag(&folder.path().join("bag"), &[0, 1, 2].map(stream));
    fs::write(path("train.toml"), SETTINGS).unwrap();
    let mut command = talking_eddy();
    command.args(["train", "--data", &path("bag"), "--config", &path("train.toml")]);
    command.args(["--epochs", "2", "--output", &path("model"), "--memory", "0.00001"]);
    let output = command.output().unwrap();
    let (printed, lines) =
        (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    assert!(output.status.success(), "{lines}");
    for words in [
        "particle mingru: 1 stream for training, 1 for validation, 1 for testing",
        "frames stay on disk",
        "done: 2 epochs, 256 samples in ",
        "best: epoch ",
        "best trivial predictor",
        "last epoch in last/",
        &format!("evaluate: eddy eval --checkpoint {}", path("model")),
    ] {
        assert!(printed.contains(words), "`{words}` is not in: {printed}");
    }
    assert_eq!(printed.lines().filter(|line| line.starts_with("epoch")).count(), 2, "{printed}");

    // The streams are shorter than the default horizon of an evaluation.
    let evaluate = printed.lines().find_map(|line| line.strip_prefix("evaluate: eddy ")).unwrap();
    let run = || eddy().args(evaluate.split(' ')).current_dir(&folder).output().unwrap();
    let output = run();
    assert!(output.status.success(), "{evaluate}: {output:?}");
    assert!(folder.path().join("reports/model/report.json").exists());
}
