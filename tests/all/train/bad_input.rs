//! What training cannot work with is refused before work is lost: the file, the field, what was found
//! and what was expected.

use std::{
    fs,
    path::Path,
    sync::atomic::{AtomicUsize, Ordering},
};

use eddy_frames::progress::Silent;
use eddy_inference::checkpoint::{Architecture, Checkpoint, Core, Form, Pooling};
use eddy_learning::train::{Machine, Run, TrainConfig, train};

use super::{BeforeBatch, dataset, files, load, run, settings, small, stream, write_bag};
use crate::support::fail;

/// Fails if `message` lacks one of `words`.
fn says(message: &str, words: &[&str]) {
    for word in words {
        assert!(message.contains(word), "`{word}` is not in: {message}");
    }
}

#[test]
fn streams_shorter_than_a_window_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut short = dataset();
    short.train = short.train.iter().map(|stream| stream.cut(0..6).unwrap().into()).collect();
    let config = small(Architecture::Particle, Core::MinGru);
    let message = run(&config, &short, folder.path()).unwrap_err().to_string();
    let expected = "the longest has 6 frames, expected at least 7: 3 observed and 4 predicted";
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
fn validation_streams_shorter_than_a_rollout_are_refused_before_the_first_epoch() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.validation.horizon = 38;
    let message = run(&config, &dataset(), folder.path()).unwrap_err().to_string();
    let expected = "the longest has 40 frames, expected at least 41: 3 to observe and 38 to predict; \
         choose a shorter horizon or longer scenes (with these, --horizon 37 at most)";
    assert_eq!(message, format!("validation: streams: {expected}"));
    assert!(files(folder.path()).is_empty());
}

#[test]
fn a_number_that_is_no_setting_is_named() {
    let refused = |change: fn(&mut TrainConfig)| {
        let mut config = TrainConfig::defaults(Architecture::Particle);
        change(&mut config);
        config.check().unwrap_err().to_string()
    };
    says(&refused(|c| c.seed = u64::MAX), &["seed: found 18446744073709551615, expected at most"]);
    says(&refused(|c| c.optimizer.warm_up = 1.0), &["optimizer.warm_up: found 1, expected 0 to"]);
    says(&refused(|c| c.network.hidden = 1 << 20), &["network.hidden: found 1048576"]);
    says(&refused(|c| c.gravity[0] = f32::NAN), &["gravity: found [NaN, -9.8]"]);
    for rate in [f64::NAN, 0.0, 1e10] {
        let mut config = TrainConfig::defaults(Architecture::Particle);
        config.optimizer.learning_rate = rate;
        let expected =
            format!("optimizer.learning_rate: found {rate}, expected above 0, at most 10");
        assert_eq!(config.check().unwrap_err().to_string(), expected);
    }
    says(&refused(|c| c.network.layers = 1000), &["network.layers: found 1000, expected 1 to 64"]);
    let maps = |c: &mut TrainConfig| (c.loss.density_weight, c.loss.density_grid) = (1.0, 1 << 20);
    says(&refused(maps), &["loss.density_grid: found 1048576, expected 2 to 4096"]);
    let other_form = |c: &mut TrainConfig| (c.core, c.network.form) = (Core::Gru, Form::Log);
    says(&refused(other_form), &["network.form: found log, expected plain"]);
    let refusal = "network.normalize_gates: found false, expected true";
    says(&refused(|c| c.network.normalize_gates = false), &[refusal]);
    says(&refused(|c| c.network.frame.pooling = Pooling::Max), &["network.frame: found"]);
    let mut frame = TrainConfig::defaults(Architecture::Frame);
    frame.network.stiffness = true;
    let refusal = "network.stiffness: found true, expected false for the frame model";
    says(&frame.check().unwrap_err().to_string(), &[refusal]);
}

#[test]
fn a_stream_whose_stiffness_is_not_known_is_named_if_the_network_is_conditioned_on_it() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.network.stiffness = true;
    let mut known = dataset();
    for stream in known.train.iter_mut().chain(&mut known.validation) {
        stream.stiffness = Some(1e3);
    }
    let message = run(&config, &known, folder.path()).unwrap_err().to_string();
    let expected = "expected eddy_stiffness in custom_data of metadata.yaml, or manifest.json of `eddy simulate` with this scene beside the bag";
    assert_eq!(message, format!("analytic: stream 7: stiffness: found nothing, {expected}"));
    assert!(files(folder.path()).is_empty());
}

#[test]
fn a_feature_that_never_changes_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let mut still = dataset();
    (still.normalization.minimum[2], still.normalization.maximum[2]) = (0.5, 0.5);
    let config = small(Architecture::Frame, Core::MinGru);
    let message = run(&config, &still, folder.path()).unwrap_err().to_string();
    let expected = "nothing moves horizontally in these streams, so that a network cannot learn it: vx: found 0.5 everywhere, \
         expected at least two different values; record longer, or add a scene with such motion";
    assert_eq!(message, format!("training streams: {expected}"));
    assert!(files(folder.path()).is_empty());
}

#[test]
fn an_unknown_core_or_option_is_named_with_those_there_are() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    write_bag(&folder.path().join("bag"), &[0, 1, 2].map(stream));
    let (data, output) = (path("bag"), path("model"));
    let begin = ["train", "--data", &data, "--output", &output];
    let usage = |more: &[&str]| fail(2, [&begin[..], more].concat());
    says(&usage(&["--core", "transformer"]), &["transformer", "mingru", "minlstm", "gru", "mlp"]);
    says(&usage(&["--architecture", "graph"]), &["graph", "frame", "particle"]);
    says(&usage(&["--recipe", "secret"]), &["secret", "default", "paper"]);
    let both = ["--recipe", "paper", "--architecture", "particle"];
    says(&usage(&both), &["--recipe: found paper for architecture particle"]);
    says(&usage(&["--learning-rate", "1"]), &["--learning-rate"]);
    says(&usage(&["--seed", "-1"]), &["-1"]);

    let file = path("train.toml");
    let config = |text: &str| {
        fs::write(&file, text).unwrap();
        fail(1, [&begin[..], &["--config", &file]].concat())
    };
    says(&config("core = \"transformer\""), &["train.toml", "transformer", "mingru"]);
    says(&config("[network]\nwidth = 3"), &["train.toml", "width", "hidden"]);
    says(&config("[optimizer]\nschedule = \"linear\""), &["train.toml", "linear", "cosine"]);
    says(&config("[network.frame]\npooling = \"sum\""), &["train.toml", "sum", "mean+max"]);
    says(&config("epochs = 0"), &["train.toml", "epochs: found 0, expected at least 1"]);
    says(&config("epochs = -3"), &["train.toml", "-3"]);
    says(&fail(2, [&begin[..], &["--memory", "0"]].concat()), &["--memory: found 0"]);
    assert!(!Path::new(&output).exists(), "something was begun");
}

#[test]
fn bags_that_do_not_belong_together_are_refused_by_what_differs() {
    let folder = tempfile::tempdir().unwrap();
    let mut faster = stream(3);
    faster.dt = 0.008;
    write_bag(&folder.path().join("a"), &[0, 1, 2].map(stream));
    write_bag(&folder.path().join("b"), &[faster]);
    let data = [folder.path().to_owned()];
    for memory in [u64::MAX, 1] {
        let message = load(&data, memory).unwrap_err().to_string();
        says(&message, &["/b: stream 3, frame 0: dt: found 0.008 s, expected 0.016 s"]);
    }

    let mut smaller = stream(3);
    smaller.material.pop();
    for state in &mut smaller.states {
        state.position.pop();
        state.velocity.pop();
    }
    fs::remove_dir_all(folder.path().join("b")).unwrap();
    write_bag(&folder.path().join("b"), &[smaller]);
    let (data, output) = (folder.path().to_str().unwrap(), folder.path().join("model"));
    let frame = ["train", "--data", data, "--architecture", "frame", "--output"];
    let message = fail(1, frame.into_iter().chain([output.to_str().unwrap()]));
    says(&message, &["/b: stream 3: particles: found 23, expected 24"]);
    assert!(!output.exists());
}

#[test]
fn one_stream_is_too_few_to_split() {
    let folder = tempfile::tempdir().unwrap();
    write_bag(&folder.path().join("lone"), &[stream(0)]);
    let message = load(&[folder.path().join("lone")], u64::MAX).unwrap_err().to_string();
    says(&message, &["lone: number of streams: found 1, expected at least 2"]);
}

#[test]
fn a_folder_that_cannot_be_written_to_is_refused_before_the_data_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    fs::write(&file, "not a folder").unwrap();
    let output = file.join("model");
    let output = output.to_str().unwrap();
    // The data is not there either, but the folder is looked at first.
    let message = fail(1, ["train", "--data", "/no/bags/here", "--output", output]);
    says(&message, &["file/model", "Not a directory"]);
}

#[test]
fn a_full_disk_is_noticed_at_the_start() {
    let folder = tempfile::tempdir().unwrap();
    let config = small(Architecture::Particle, Core::MinGru);
    let machine = Machine { disk: 1000, ..Machine::UNLIMITED };
    let run = Run { machine, ..settings(folder.path(), &Silent) };
    let message = train(&config, &dataset(), &run).unwrap_err().to_string();
    says(&message, &["disk: found 1000 B free, expected at least", "KiB"]);
    assert!(files(folder.path()).is_empty());
}

#[test]
#[cfg(target_os = "linux")]
fn a_disk_that_fills_up_on_the_way_leaves_what_was_there() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = small(Architecture::Particle, Core::MinGru);
    config.epochs = 8;
    let incoming = folder.path().join("model.safetensors.new");
    let batches = AtomicUsize::new(0);
    // From the second epoch on, whatever is written to the new checkpoint meets a full disk.
    let fills_up = BeforeBatch(|| {
        if batches.fetch_add(1, Ordering::Relaxed) == config.batches() {
            std::os::unix::fs::symlink("/dev/full", &incoming).unwrap();
        }
        false
    });
    let message =
        train(&config, &dataset(), &settings(folder.path(), &fills_up)).unwrap_err().to_string();
    says(&message, &["model.safetensors.new", "No space left on device"]);
    let kept = Checkpoint::load(folder.path()).unwrap();
    let last = Checkpoint::load(&folder.path().join("last")).unwrap();
    assert_eq!(kept.description.training.best_epoch, 1);
    assert!(last.description.training.epochs >= 1);

    fs::remove_file(&incoming).unwrap();
    let done = super::resume(&config, &dataset(), folder.path()).unwrap();
    assert_eq!(done.epochs.len(), 8);
}

#[test]
fn a_network_that_does_not_fit_into_memory_is_refused_with_the_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let config = small(Architecture::Frame, Core::MinGru);
    let machine = Machine { memory: 1 << 16, ..Machine::UNLIMITED };
    let run = Run { machine, ..settings(folder.path(), &Silent) };
    let message = train(&config, &dataset(), &run).unwrap_err().to_string();
    says(&message, &["memory: found at least", "needed", "at most the 64.00 KiB that are free"]);
    assert!(files(folder.path()).is_empty());

    // A batch of so many windows that their bytes are no number any more.
    let mut config = config;
    config.windows.batch = usize::MAX / 2;
    let machine = Machine { memory: 1 << 40, ..Machine::UNLIMITED };
    let run = Run { machine, ..settings(folder.path(), &Silent) };
    let message = train(&config, &dataset(), &run).unwrap_err().to_string();
    says(&message, &["memory: found at least", "at most the 1.00 TiB that are free"]);

    // The real machine, and a network of 170 billion numbers.
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    write_bag(&folder.path().join("bag"), &[0, 1, 2].map(stream));
    fs::write(
        path("train.toml"),
        "[network]\nhidden = 65536\nlayers = 20\n[validation]\nhorizon = 8\n",
    )
    .unwrap();
    let message = fail(
        1,
        [
            "train",
            "--data",
            &path("bag"),
            "--config",
            &path("train.toml"),
            "--output",
            &path("model"),
        ],
    );
    says(&message, &["memory: found at least", "TiB needed", "that are free"]);
    assert!(!Path::new(&path("model")).exists());
}
