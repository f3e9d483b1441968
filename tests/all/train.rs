//! Training on trajectories that can be written down.

use std::{fs, path::Path};

use eddy::{
    checkpoint::{Architecture, Checkpoint, Core, Normalization},
    dataset::{Dataset, State, Stream},
    frame::{Domain, Material, Stamp},
    model::DeviceKind,
    train::{Outcome, Run, Stage, TrainConfig, TrainError, train},
};

const DT: f32 = 0.016;
const FRAMES: usize = 40;
const PARTICLES: usize = 24;

/// Particles that fall through something thick: v' = (1 - drag) v + g dt, x' = x + v' dt, with more drag
/// for rope. No trivial predictor knows of the drag.
fn stream(id: u64) -> Stream {
    let place = |i: usize, step: f32| (0.37 * (i as f32 + 1.0) + step * id as f32).fract();
    let mut position: Vec<[f32; 2]> =
        (0..PARTICLES).map(|i| [0.2 + 0.6 * place(i, 0.11), 0.6 + 0.3 * place(i, 0.23)]).collect();
    let mut velocity: Vec<[f32; 2]> =
        (0..PARTICLES).map(|i| [place(i, 0.31) - 0.5, place(i, 0.43) - 0.5]).collect();
    let material: Vec<_> = (0..PARTICLES)
        .map(|i| if i % 2 == 0 { Material::Liquid } else { Material::Rope })
        .collect();
    let states = (0..FRAMES).map(|_| {
        let state = State { position: position.clone(), velocity: velocity.clone() };
        for i in 0..PARTICLES {
            let left = if material[i] == Material::Rope { 0.7 } else { 0.9 };
            velocity[i] = [left * velocity[i][0], left * velocity[i][1] - 9.8 * DT];
            position[i] =
                [position[i][0] + velocity[i][0] * DT, position[i][1] + velocity[i][1] * DT];
        }
        state
    });
    let states = states.collect();
    Stream {
        id,
        source: "analytic".into(),
        dt: DT,
        domain: Domain::UNIT,
        material,
        first_sequence: 0,
        first_stamp: Stamp(0),
        states,
    }
}

fn dataset() -> Dataset {
    Dataset {
        train: (0..6).map(stream).collect(),
        validation: vec![stream(6)],
        test: vec![stream(7)],
        normalization: Normalization {
            minimum: [0.0, 0.0, -1.0, -1.5],
            maximum: [1.0, 1.0, 1.0, 0.5],
            mean: [0.5, 0.5, 0.0, -0.7],
            standard_deviation: [0.2, 0.2, 0.2, 0.5],
        },
        digest: "analytic".to_owned(),
    }
}

/// A network and a run small enough for a test.
fn small(architecture: Architecture, core: Core) -> TrainConfig {
    let mut config = TrainConfig::defaults(architecture);
    config.core = core;
    config.epochs = 4;
    config.network.encoder = 16;
    config.network.hidden = 12;
    config.windows.batch = 8;
    config.windows.per_epoch = 256;
    config.windows.particles = 8;
    config.optimizer.learning_rate = 5e-3;
    config.validation.horizon = 8;
    if architecture == Architecture::Particle {
        config.unroll = vec![Stage { share: 1.0, frames: 4 }];
    }
    config
}

fn run(config: &TrainConfig, dataset: &Dataset, output: &Path) -> Result<Outcome, TrainError> {
    let run = Run {
        device: DeviceKind::Flex,
        output,
        command: "a test".to_owned(),
        quiet: true,
        interrupted: &|| false,
    };
    train(config, dataset, &run)
}

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
fn a_loss_that_is_no_number_names_its_batch_and_keeps_the_last_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.epochs = 1;
    run(&config, &dataset(), folder.path()).unwrap();
    let before = Checkpoint::load(folder.path()).unwrap();

    let mut spoilt = dataset();
    for state in spoilt.train.iter_mut().flat_map(|stream| &mut stream.states) {
        state.velocity.fill([f32::NAN; 2]);
    }
    let message = run(&config, &spoilt, folder.path()).unwrap_err().to_string();
    assert!(message.starts_with("epoch 1, batch 1 (windows "), "{message}");
    assert!(message.ends_with("loss: found NaN, expected a finite number"), "{message}");
    assert_eq!(Checkpoint::load(folder.path()).unwrap(), before);
}

#[test]
fn an_interrupted_run_keeps_the_best_checkpoint_so_far() {
    let folder = tempfile::tempdir().unwrap();
    let config = small(Architecture::Particle, Core::MinGru);
    let batches = std::cell::Cell::new(0);
    let interrupted = || {
        batches.set(batches.get() + 1);
        batches.get() > config.batches() + 3
    };
    let run = Run {
        device: DeviceKind::Flex,
        output: folder.path(),
        command: "a test".to_owned(),
        quiet: true,
        interrupted: &interrupted,
    };
    let outcome = train(&config, &dataset(), &run).unwrap();
    assert!(outcome.interrupted);
    assert_eq!(outcome.epochs.len(), 1);
    assert_eq!(Checkpoint::load(folder.path()).unwrap().description.training.best_epoch, 1);
}

#[test]
fn streams_shorter_than_a_window_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut short = dataset();
    for stream in &mut short.train {
        stream.states.truncate(8);
    }
    let config = small(Architecture::Particle, Core::MinGru);
    let message = run(&config, &short, folder.path()).unwrap_err().to_string();
    let expected = "the longest has 8 frames, expected at least 9: 5 observed and 4 predicted";
    assert_eq!(message, format!("training streams: {expected}"));
}

#[test]
fn the_frame_model_refuses_streams_with_other_numbers_of_particles() {
    let folder = tempfile::tempdir().unwrap();
    let mut mixed = dataset();
    mixed.train[2].material.pop();
    let config = small(Architecture::Frame, Core::MinGru);
    let message = run(&config, &mixed, folder.path()).unwrap_err().to_string();
    assert!(message.contains("stream 2: particles: found 23, expected 24"), "{message}");
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
