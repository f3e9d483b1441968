//! A run that starts from the weights of a checkpoint.

use std::path::Path;

use eddy_dataset::{Dataset, Stream};
use eddy_frames::{Material, progress::Silent};
use eddy_inference::checkpoint::{Architecture, Checkpoint, Core, WeightFormat};
use eddy_learning::train::{Outcome, Run, TrainConfig, TrainError, train};

use super::{Lines, dataset, resume, run, settings, small, stream, write_bag};
use crate::support::{fail, succeed};

fn from(
    start: &Checkpoint,
    config: &TrainConfig,
    dataset: &Dataset,
    output: &Path,
) -> Result<Outcome, TrainError> {
    train(config, dataset, &Run { start: Some(start), ..settings(output, &Silent) })
}

/// Other streams on other scales, of other materials.
fn other() -> Dataset {
    let snow = |stream: Stream| Stream {
        material: stream.material.iter().map(|_| Material::Snow).collect(),
        ..stream
    };
    let mut other = dataset();
    other.train = (10..16).map(|id| snow(stream(id)).into()).collect();
    other.normalization.minimum[2] = -3.0;
    other.digest = "other".to_owned();
    other
}

#[test]
fn training_goes_on_from_the_weights_and_scales_of_the_checkpoint() {
    for (architecture, core, weights, average) in [
        (Architecture::Particle, Core::MinGru, WeightFormat::F32, 0.0),
        (Architecture::Particle, Core::MinGru, WeightFormat::F16, 0.9),
        (Architecture::Frame, Core::Gru, WeightFormat::F32, 0.0),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let [first, second] = ["first", "second"].map(|name| folder.path().join(name));
        let mut config = small(architecture, core);
        (config.optimizer.average, config.network.weights) = (average, weights);
        let start = run(&config, &dataset(), &first).unwrap().best.unwrap();

        let mut config = config.starting_from(&start.description);
        // Steps too short to see.
        (config.seed, config.epochs, config.optimizer.learning_rate) = (2, 1, 1e-9);
        config.network.weights = WeightFormat::F32;
        if average > 0.0 {
            // The average, too, begins at the weights: after one step it is no other.
            config.windows.per_epoch = config.windows.batch;
        }
        let outcome = from(&start, &config, &other(), &second).unwrap();
        let end = outcome.best.unwrap();
        for (name, before) in &start.tensors {
            let after = &end.tensors[name].values;
            let apart = before.values.iter().zip(after).map(|(a, b)| (a - b).abs());
            assert!(apart.fold(0.0, f32::max) < 1e-6, "{core:?}: {name}");
        }
        assert_ne!(start.tensors, end.tensors, "it was trained");
        assert_eq!(end.description.training.start, Some(start.digest()));
        assert!(outcome.epochs[0].weight_distance < 1e-6, "from the weights of the checkpoint");
        let [before, after] = [&start.description, &end.description];
        assert_eq!(after.normalization, before.normalization);
        assert_eq!(after.materials, [Material::Liquid, Material::Snow, Material::Rope]);
        let seen = |name: &str| after.training.seen.contains(name);
        assert!(before.training.seen.iter().all(seen), "evaluations leave them out");
        assert!(other().seen().unwrap().iter().all(|stream| seen(stream)));
        assert_eq!(after.data, "other");
    }
}

#[test]
fn the_run_says_how_good_the_checkpoint_is_and_whether_training_made_it_worse() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let mut config = small(Architecture::Particle, Core::MinGru);
    let start = run(&config, &dataset(), &path("start")).unwrap().best.unwrap();
    let loss = start.description.training.validation_loss;
    let worse = "no epoch is better than the checkpoint to start from";
    for (name, rate) in [("far", 0.3), ("on", 1e-3)] {
        let (output, lines) = (path(name), Lines::default());
        (config.epochs, config.optimizer.learning_rate) = (2, rate);
        let run = Run { start: Some(&start), ..settings(&output, &lines) };
        let best = train(&config, &dataset(), &run).unwrap().best.unwrap();
        let lines = lines.into_inner();
        let said = format!("the checkpoint to start from: validation {loss:.4}  skill ");
        assert!(lines[0].starts_with(&said), "{lines:?}");
        let is_worse = best.description.training.validation_loss >= loss;
        assert_eq!(is_worse, rate > 0.1, "{lines:?}");
        assert_eq!(
            lines.iter().filter(|line| line.starts_with(worse)).count(),
            usize::from(is_worse)
        );
    }
}

#[test]
fn its_defaults_are_the_network_and_a_fifth_of_the_learning_rate() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = small(Architecture::Particle, Core::Lstm);
    config.network.channels = vec![4, 5];
    config.windows.warm_up = 4;
    config.gravity = [0.0, -1.6];
    config.epochs = 1;
    let start = run(&config, &dataset(), &folder.path().join("first")).unwrap().best.unwrap();
    let defaults = TrainConfig::defaults(Architecture::Frame);
    let found = defaults.clone().starting_from(&start.description);
    let rate = 0.2 * defaults.optimizer.learning_rate;
    assert_eq!((found.architecture, found.core), (config.architecture, config.core));
    config.network.dropout = defaults.network.dropout;
    assert_eq!(found.network, config.network);
    assert_eq!((found.windows.warm_up, found.gravity), (4, config.gravity));
    assert_eq!(found.optimizer.learning_rate, rate);
}

#[test]
fn a_run_is_not_resumed_with_another_start() {
    let folder = tempfile::tempdir().unwrap();
    let [first, second] = ["first", "second"].map(|name| folder.path().join(name));
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.epochs = 1;
    let start = run(&config, &dataset(), &first).unwrap().best.unwrap();
    from(&start, &config, &dataset(), &second).unwrap();
    config.epochs = 2;
    let error = resume(&config, &dataset(), &second).unwrap_err().to_string();
    let expected = format!(
        "{}: --from: found random weights, expected {} as in the run to resume",
        second.join("last/resume.toml").display(),
        start.digest()
    );
    assert_eq!(error, expected);
    let again = Run { resume: true, start: Some(&start), ..settings(&second, &Silent) };
    assert_eq!(train(&config, &dataset(), &again).unwrap().epochs.len(), 2);
}

#[test]
fn the_command_says_in_what_a_network_differs() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let streams: Vec<Stream> = (0..6).map(stream).collect();
    write_bag(path("bag").as_ref(), &streams);
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.epochs = 1;
    run(&config, &dataset(), path("start").as_ref()).unwrap();
    let (data, start) = (path("bag"), path("start"));
    let of = |output: &str| {
        ["train", "--data", &data, "--from", &start, "--epochs", "1", "--output", &path(output)]
            .map(str::to_owned)
    };
    let settings = path("settings.toml");
    std::fs::write(&settings, "[windows]\nper_epoch = 16\n").unwrap();
    let with = |more: &[&str], output: &str| {
        let more = more.iter().copied().map(str::to_owned);
        of(output).into_iter().chain(more).collect::<Vec<_>>()
    };
    succeed(with(&["--config", &settings], "on"));
    let [on, before] = ["on", "start"].map(|name| Checkpoint::load(path(name).as_ref()).unwrap());
    assert_eq!(on.description.training.start, Some(before.digest()));

    let differs = "as in the checkpoint that training starts from";
    for (more, found) in [
        (vec!["--core", "gru"], "core: found \"gru\", expected \"mingru\""),
        (vec!["--architecture", "frame"], "architecture: found \"frame\", expected \"particle\""),
    ] {
        let error = fail(1, with(&more, "off"));
        assert!(error.contains(&format!("{start}: {found} {differs}")), "{error}");
    }
    let error = fail(2, with(&["--recipe", "paper"], "off"));
    let expected = "recipe: found paper with a checkpoint to start from, expected default";
    assert!(error.contains(expected), "{error}");
    std::fs::write(&settings, "[network]\nhidden = 5\n").unwrap();
    let error = fail(1, with(&["--config", &settings], "off"));
    assert!(error.contains(&format!("network.hidden: found 5, expected 12 {differs}")), "{error}");
    assert!(!Path::new(&path("off")).exists());
}

#[test]
fn data_that_the_checkpoint_would_not_accept_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = small(Architecture::Frame, Core::Mlp);
    config.epochs = 1;
    let start = run(&config, &dataset(), &folder.path().join("start")).unwrap().best.unwrap();
    let changed = |change: &dyn Fn(&mut Stream)| {
        let with = |id| {
            let mut stream = stream(id);
            change(&mut stream);
            stream.into()
        };
        let (train, [validation, test]) =
            ((0..6).map(with).collect(), [6, 7].map(|id| vec![with(id)]));
        Dataset { train, validation, test, ..dataset() }
    };
    let fewer = |stream: &mut Stream| {
        stream.material.truncate(20);
        for state in &mut stream.states {
            state.position.truncate(20);
            state.velocity.truncate(20);
        }
    };
    for (data, expected) in [
        (changed(&|stream| stream.dt = 0.008), "frame interval (s): found 0.008, expected 0.016"),
        (changed(&fewer), "particles: found 20, expected 24"),
        (changed(&|stream| stream.domain.upper[0] = 2.0), "domain: found "),
    ] {
        let error = from(&start, &config, &data, &folder.path().join("other")).unwrap_err();
        let error = error.to_string();
        let end = "as in the checkpoint that training starts from";
        assert!(error.starts_with(expected) && error.ends_with(end), "{error}");
    }
}
