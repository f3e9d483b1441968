//! What a run learns, and what it keeps.

use std::fs;

use eddy_inference::checkpoint::{Architecture, Checkpoint, Core, FrameOutput};
use eddy_learning::train::{LossKind, METRICS_FILE, NoiseConfig, TrainConfig, train};
use eddy_settings::Overrides;

use super::{FRAMES, Lines, dataset, interrupted, run, settings, small, stream};

#[test]
fn every_network_learns_what_no_trivial_predictor_knows() {
    for architecture in [Architecture::Particle, Architecture::Frame] {
        for core in [Core::MinGru, Core::MinLstm] {
            let folder = tempfile::tempdir().unwrap();
            let mut config = small(architecture, core);
            config.epochs = 8;
            let outcome = run(&config, &dataset(), folder.path()).unwrap();
            let (first, last) = (outcome.epochs[0], outcome.epochs[7]);
            assert!(
                last.training_loss < 0.9 * first.training_loss,
                "{architecture:?} {core:?}: {first:?} {last:?}"
            );
            if architecture == Architecture::Particle {
                assert!(last.first_skill > 0.5, "{core:?}: {last:?}");
            }
        }
    }
}

#[test]
fn the_best_epoch_is_what_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let config = small(Architecture::Particle, Core::MinGru);
    let outcome = run(&config, &dataset(), folder.path()).unwrap();
    let kept = Checkpoint::load(folder.path()).unwrap();
    assert_eq!(Some(&kept), outcome.best.as_ref());
    let best = outcome
        .epochs
        .iter()
        .min_by(|a, b| a.validation_loss.total_cmp(&b.validation_loss))
        .unwrap();
    let summary = &kept.description.training;
    assert_eq!(summary.best_epoch, best.epoch);
    assert_eq!(summary.validation_loss, best.validation_loss);
    assert_eq!(summary.epochs, 4);
    let metrics = fs::read_to_string(folder.path().join("metrics.csv")).unwrap();
    assert_eq!(metrics.lines().count(), 5);
}

#[test]
fn the_same_seed_gives_the_same_weights_and_another_gives_others() {
    let digest = |seed: u64, dropout: f32| {
        let folder = tempfile::tempdir().unwrap();
        let mut config = small(Architecture::Particle, Core::MinLstm);
        config.epochs = 1;
        config.seed = seed;
        config.network.dropout = dropout;
        let best = run(&config, &dataset(), folder.path()).unwrap().best.unwrap();
        best.tensors["mixer.weight"].clone()
    };
    assert_eq!(digest(5, 0.2), digest(5, 0.2));
    assert_ne!(digest(5, 0.2), digest(6, 0.2));
}

#[test]
fn training_stops_when_validation_no_longer_gets_better() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.epochs = 50;
    config.windows.per_epoch = 8;
    config.optimizer.learning_rate = 1e-12;
    config.patience = 2;
    let outcome = run(&config, &dataset(), folder.path()).unwrap();
    let best = outcome.best.unwrap().description.training.best_epoch;
    assert!(outcome.epochs.len() < 50);
    assert_eq!(outcome.epochs.len() as u32, best + 2);
}

#[test]
fn a_loss_that_is_no_number_names_its_batch_and_keeps_the_best_and_the_last_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.loss.kind = LossKind::Mse;
    config.epochs = 200;
    config.windows.per_epoch = 8;
    config.patience = 200;
    config.seed = 2;
    // One of 204 windows is spoilt: sooner or later it is drawn.
    let mut spoilt = dataset();
    let mut stream = stream(2);
    stream.states[FRAMES - 1].velocity.fill([f32::NAN; 2]);
    spoilt.train[2] = stream.into();
    let message = run(&config, &spoilt, folder.path()).unwrap_err().to_string();
    assert!(message.contains(" 2:33"), "{message}");
    assert!(message.ends_with("loss: found NaN, expected a finite number"), "{message}");
    let epoch = message.strip_prefix("epoch ").unwrap().split(',').next().unwrap();
    let failed: u32 = epoch.parse().unwrap();
    assert!(failed > 1, "the first epoch was spoilt, nothing could be kept");
    let last = Checkpoint::load(&folder.path().join("last")).unwrap();
    assert_eq!(last.description.training.epochs, failed - 1);
    assert!(Checkpoint::load(folder.path()).unwrap().description.training.best_epoch < failed);
}

#[test]
fn noise_that_overflows_ends_with_the_batch_named() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = small(Architecture::Frame, Core::MinLstm);
    config.windows.noise = NoiseConfig { position: 0.0, velocity: f32::MAX, share: 1.0 };
    let message = run(&config, &dataset(), folder.path()).unwrap_err().to_string();
    assert!(message.starts_with("epoch 1, batch "), "{message}");
    assert!(message.contains("expected a finite number"), "{message}");
}

#[test]
fn weights_that_hardly_move_are_said_after_the_first_epoch_and_in_the_metrics() {
    let metrics = |epsilon: f32| {
        let folder = tempfile::tempdir().unwrap();
        let mut config = small(Architecture::Frame, Core::MinGru);
        config.epochs = 2;
        config.optimizer.epsilon = epsilon;
        let lines = Lines::default();
        let outcome = train(&config, &dataset(), &settings(folder.path(), &lines)).unwrap();
        let last = outcome.epochs[1];
        let table = fs::read_to_string(folder.path().join(METRICS_FILE)).unwrap();
        assert!(
            table.lines().next().unwrap().ends_with(",weight_distance,epsilon_share"),
            "{table}"
        );
        let row = format!(",{:.4e},{:.4}", last.weight_distance, last.epsilon_share);
        assert!(table.trim_end().ends_with(&row), "{row}: {table}");
        let lines = lines.into_inner();
        let said = lines.iter().filter(|line| line.contains("the weights hardly move")).count();
        (last.weight_distance, last.epsilon_share, said)
    };
    let (far, little, silent) = metrics(1e-8);
    let (near, most, said) = metrics(1e3);
    assert!(far > 0.05 && near < 1e-3, "{far} and {near} from the start");
    assert!(little < 0.5 && most > 0.99, "{little} and {most} of the steps lost");
    assert_eq!((silent, said), (0, 1));
}

#[test]
fn an_interrupted_run_keeps_the_best_and_the_last_epoch() {
    let folder = tempfile::tempdir().unwrap();
    let config = small(Architecture::Particle, Core::MinGru);
    let outcome = interrupted(&config, &dataset(), folder.path(), config.batches() + 3);
    assert!(outcome.interrupted);
    assert_eq!(outcome.epochs.len(), 1);
    for kept in [folder.path(), &folder.path().join("last")] {
        assert_eq!(Checkpoint::load(kept).unwrap().description.training.best_epoch, 1);
    }
}

#[test]
fn settings_in_a_file_are_read_as_they_were_written() {
    for output in FrameOutput::ALL {
        let mut config = TrainConfig::paper();
        config.network.frame.output = output;
        let file = Overrides::parse("a.toml".as_ref(), &toml::to_string(&config).unwrap()).unwrap();
        let defaults = TrainConfig::defaults(Architecture::Frame);
        assert_ne!(config, defaults);
        assert_eq!(file.over(&defaults).unwrap(), config, "{}", output.name());
    }
}

#[test]
fn settings_out_of_range_are_named() {
    let mut config = TrainConfig::defaults(Architecture::Particle);
    config.network.dropout = 1.0;
    let message = config.check().unwrap_err().to_string();
    assert_eq!(message, "network.dropout: found 1, expected 0 to below 1");
    for architecture in [Architecture::Particle, Architecture::Frame] {
        TrainConfig::defaults(architecture).check().unwrap();
    }
}
