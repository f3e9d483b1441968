//! Simulate, train, judge and predict, in one sitting.

use std::fs;

use eddy_inference::checkpoint::Checkpoint;

use crate::support::{simulate, succeed, talking_eddy};

#[test]
fn ground_truth_becomes_a_surrogate_that_is_judged_and_predicts() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    simulate(folder.path().join("mm").as_path(), 3, 0.8);

    fs::write(path("train.toml"), "windows.per_epoch = 512\n").unwrap();
    let (data, model, config) = (path("mm"), path("model"), path("train.toml"));
    let train =
        ["train", "--data", &data, "--output", &model, "--epochs", "3", "--config", &config];
    let trained = talking_eddy().args(train).output().unwrap();
    assert!(trained.status.success(), "{}", String::from_utf8_lossy(&trained.stderr));
    let trained = String::from_utf8(trained.stdout).unwrap();
    let tested = trained.lines().find(|line| line.contains(": test (1 stream)"));
    let tested = tested.unwrap_or_else(|| panic!("no test part: {trained}"));
    let losses = training_losses(&fs::read_to_string(path("model/metrics.csv")).unwrap());
    assert_eq!(losses.len(), 3);
    assert!(losses[2] < losses[0], "the training loss rose: {losses:?}");

    let seen = Checkpoint::load(path("model").as_ref()).unwrap().description.training.seen;
    assert_eq!(seen.iter().count(), 2, "fitted to one stream, chosen by another");

    let report = path("report");
    let judge = ["eval", "--checkpoint", &model, "--data", &data, "--output", &report];
    let printed = succeed(judge.iter().chain(&["--horizon", "20"]));
    assert!(printed.contains("only its test part is evaluated"), "{printed}");
    assert!(printed.contains("ballistic with walls"), "{printed}");
    let json: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(path("report/report.json")).unwrap()).unwrap();
    assert_eq!(json["predictors"][0]["position_rmse"].as_array().unwrap().len(), 20);
    let skill = |ahead: usize| json["predictors"][0]["skill"][ahead - 1].as_f64().unwrap();
    let same = format!("skill {:+.2} at frame 1, {:+.2} at frame 20", skill(1), skill(20));
    assert!(tested.starts_with(&same), "{tested} is not {same}");
    // Six of the seven starts have twenty true frames: curves end before.
    let complete = json["complete"].as_u64().unwrap();
    assert!((1..20).contains(&complete), "{complete}");
    let page = fs::read_to_string(path("report/report.html")).unwrap();
    assert!(page.contains(&format!("Mean curves end at frame {complete}, ")));

    let (bag, first, second) = (path("mm/scene_0002"), path("first"), path("second"));
    succeed(["predict", "--checkpoint", &model, "--input", &bag, "--output", &first]);
    let second_run = ["predict", "--checkpoint", &model, "--input", &bag, "--output", &second];
    succeed(second_run.iter().chain(&["--threads", "3"]));
    assert_eq!(
        fs::read(path("first/first_0.mcap")).unwrap(),
        fs::read(path("second/second_0.mcap")).unwrap()
    );
}

/// The column `training_loss`, one number an epoch.
fn training_losses(csv: &str) -> Vec<f64> {
    let mut lines = csv.lines();
    let column = lines.next().unwrap().split(',').position(|c| c == "training_loss").unwrap();
    lines.map(|line| line.split(',').nth(column).unwrap().parse().unwrap()).collect()
}
