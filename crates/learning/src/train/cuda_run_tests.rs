//! Whole runs on a device in the emulator: when they are saved, and that nothing of them is lost.

use std::{
    fs,
    path::Path,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU32, Ordering},
    },
    time::Duration,
};

use super::{
    Dependencies, Epoch, Machine, Outcome, Run, TrainConfig, TrainError, UnrollStage, cuda,
    cuda_tests::{self, streams},
    steps::Learner,
    train_with,
};
use crate::model::{Core, DeviceKind, GpuOptions};
use eddy_cuda::{device::Device, frame::Place, kernels::Constants};
use eddy_cuda_emulator::Emulator;
use eddy_dataset::Dataset;
use eddy_frames::progress::{Progress, Silent};
use eddy_inference::checkpoint::Description;

/// Five epochs of two batches of three windows; the unroll changes within the third.
fn config() -> TrainConfig {
    let mut config = cuda_tests::config(Core::MinGru);
    config.epochs = 5;
    config.patience = 100;
    config.windows.per_epoch = 6;
    config.unroll = [2, 3].map(|frames| UnrollStage { share: 0.5, frames }).to_vec();
    config.validation.horizon = 2;
    config.validation.starts = 1;
    config
}

fn dataset() -> Dataset {
    Dataset {
        train: streams(),
        validation: streams(),
        test: Vec::new(),
        normalization: cuda_tests::description(&config()).normalization,
        spacing: 0.1,
        digest: "streams of a test".to_owned(),
        skipped: Vec::new(),
    }
}

/// What tests vary in a run.
struct Options<'a> {
    device: DeviceKind,
    resume: bool,
    progress: &'a dyn Progress,
    on_epoch: &'a (dyn Fn(&Epoch) + Sync),
    clock: &'a dyn Fn() -> Duration,
}

impl Default for Options<'_> {
    /// A run in the emulator whose clock stands still, so that only its first epoch is saved at once.
    fn default() -> Self {
        Self {
            device: DeviceKind::Cuda(0),
            resume: false,
            progress: &Silent,
            on_epoch: &|_| (),
            clock: &|| Duration::ZERO,
        }
    }
}

fn run(config: &TrainConfig, output: &Path, options: &Options<'_>) -> Result<Outcome, TrainError> {
    let dataset = dataset();
    let run = Run {
        device: options.device,
        gpu: GpuOptions::default(),
        output,
        start: None,
        resume: options.resume,
        machine: Machine::UNLIMITED,
        command: "a test".to_owned(),
        progress: options.progress,
        on_epoch: options.on_epoch,
    };
    let learner = |description: &Description| {
        if !options.device.is_cuda() {
            return Ok(Learner::Burn);
        }
        let device = Arc::new(Emulator::new(&Constants::of(description)?)?);
        let devices = [(device as Arc<dyn Device>, Place::Device)];
        let learner = cuda::Learner::on(devices, description, &dataset.train)?;
        Ok(Learner::Cuda(Box::new(learner)))
    };
    train_with(config, &dataset, &run, &Dependencies { learner: &learner, clock: options.clock })
}

/// The number of epochs in the record of the last epoch.
fn epochs_saved(output: &Path) -> usize {
    let record = fs::read_to_string(output.join("last/resume.toml")).unwrap();
    record.matches("[[epochs]]").count()
}

#[test]
fn a_run_on_a_gpu_is_saved_at_most_every_ten_seconds_and_at_its_end() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("run");
    let config = TrainConfig { epochs: 9, ..config() };
    // An epoch takes four seconds.
    let done = AtomicU32::new(0);
    let saved = Mutex::new(Vec::new());
    let on_epoch = |epoch: &Epoch| {
        done.store(epoch.epoch, Ordering::Relaxed);
        saved.lock().unwrap().push(epochs_saved(&output));
    };
    let clock = || Duration::from_secs(4) * done.load(Ordering::Relaxed);
    let options = Options { on_epoch: &on_epoch, clock: &clock, ..Options::default() };
    run(&config, &output, &options).unwrap();
    // The first epoch ends at 0 s, the next save is due at 10 s: the epoch that ends at 12 s.
    assert_eq!(*saved.lock().unwrap(), [1, 1, 1, 4, 4, 4, 7, 7, 7]);
    assert_eq!(epochs_saved(&output), 9);
}

#[test]
fn a_run_through_burn_is_saved_after_every_epoch() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("run");
    let saved = Mutex::new(Vec::new());
    let on_epoch = |_: &Epoch| saved.lock().unwrap().push(epochs_saved(&output));
    let options = Options { device: DeviceKind::Flex, on_epoch: &on_epoch, ..Options::default() };
    run(&config(), &output, &options).unwrap();
    assert_eq!(*saved.lock().unwrap(), [1, 2, 3, 4, 5]);
}

#[test]
fn an_interrupted_run_resumes_from_its_last_epoch_with_the_same_bits() {
    /// Asks to stop after so many groups of batches: one in each epoch, two in the third, where the unroll changes.
    struct After(AtomicU32);
    impl Progress for After {
        fn cancelled(&self) -> bool {
            let one_less = |left: u32| left.checked_sub(1);
            self.0.fetch_update(Ordering::Relaxed, Ordering::Relaxed, one_less).is_err()
        }
    }
    let config = config();
    let folder = tempfile::tempdir().unwrap();
    let whole = folder.path().join("whole");
    run(&config, &whole, &Options::default()).unwrap();
    for (groups, epochs) in [(1, 1), (2, 2), (3, 2), (4, 3), (5, 4)] {
        let parts = folder.path().join(format!("after {groups}"));
        let progress = After(AtomicU32::new(groups));
        let first =
            run(&config, &parts, &Options { progress: &progress, ..Options::default() }).unwrap();
        assert!(first.interrupted);
        assert_eq!([first.epochs.len(), epochs_saved(&parts)], [epochs; 2]);
        run(&config, &parts, &Options { resume: true, ..Options::default() }).unwrap();
        for file in [
            "model.toml",
            "model.safetensors",
            "metrics.csv",
            "last/model.toml",
            "last/model.safetensors",
            "last/resume.safetensors",
        ] {
            let [found, expected] =
                [&parts, &whole].map(|output| fs::read(output.join(file)).unwrap());
            assert!(found == expected, "stopped after {groups} groups: {file} differs");
        }
    }
}

#[test]
fn a_run_that_fails_keeps_its_last_epoch() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("run");
    let mut config = config();
    // The rate rises until the network diverges.
    (config.epochs, config.optimizer.learning_rate, config.optimizer.warm_up) = (100, 10.0, 0.9);
    let epoch = match run(&config, &output, &Options::default()).unwrap_err() {
        TrainError::NotFinite { epoch, .. } | TrainError::GradientNotFinite { epoch, .. } => epoch,
        other => panic!("{other}"),
    };
    assert!(epoch > 2, "epoch {epoch}: the first epoch is saved in any case");
    assert_eq!(epochs_saved(&output), epoch as usize - 1);
}
